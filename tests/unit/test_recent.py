"""How the line stands as the newest telemetry has it: what no device told in time, and no frame, is not seen."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.core.signals import Quality
from gateway.core.states import LoopState
from gateway.core.telemetry import frame_dtype
from gateway.supervisor.recent import STANDING_S, WINDOW_S, Recent
from safety.probation import look_at
from tests.closed_loop.conftest import demo_line

LINE = demo_line()
N, PERIOD_S = LINE.n, LINE.control.period_s
FRAMES, WINDOW = round(STANDING_S / PERIOD_S), round(WINDOW_S / PERIOD_S)
SWINGS = 2  #: the span (from 0) that does
EACH = np.array([span.control == "tension" for span in LINE.spans])


def frames(swing_n: float = 12.0, count: int = FRAMES) -> np.ndarray:
    """In RUN at the recipe's set-points."""
    rows, k = np.zeros(count, frame_dtype(N)), np.arange(count)
    rows["state"], rows["time_s"], rows["sequence"] = LoopState.RUN, 100.0 + PERIOD_S * k, k
    rows["tension_setpoint_n"] = rows["tension_n"] = LINE.recipes[0].tension_n
    rows["tension_n"][:, SWINGS] += swing_n * np.sin(2.0 * np.pi * PERIOD_S * k)
    return rows


def taken(rows: np.ndarray) -> Recent:
    recent = Recent(N, PERIOD_S)
    for row in rows:
        recent.take(row.tobytes())
    return recent


def look(rows: np.ndarray):
    now = taken(rows).standing()
    assert now is not None
    return look_at(now, None, LINE.gate, EACH)


@settings(max_examples=25)
@given(st.sets(st.integers(0, WINDOW - 1), max_size=round(0.1 * WINDOW)), st.booleans())
def test_a_swing_is_seen_through_late_samples(late: set[int], all_cells: bool) -> None:
    rows = frames()
    for k in late:  # the value that was told last stays in the frame
        cells = slice(None) if all_cells else SWINGS
        rows["tension_quality"][FRAMES - WINDOW + k, cells] = Quality.STALE
        rows["tension_n"][FRAMES - WINDOW + k, cells] = rows["tension_n"][FRAMES - WINDOW + k - 1, cells]
    assert "tension 3 swings by" in look(rows).against


def test_a_load_cell_that_tells_the_same_again_and_again_does_not_stand() -> None:
    rows = frames()
    rows["tension_quality"][:, SWINGS] = Quality.STALE
    rows["tension_n"][:, SWINGS] = LINE.recipes[0].tension_n[SWINGS]
    found = look(rows)
    assert not found.against and [one.number for one in found.unseen] == [SWINGS + 1] and not found.good


def test_a_torque_that_was_held_is_no_change_that_was_seen() -> None:
    rows = frames(swing_n=0.0)
    rows["torque_nm"][:, 0] = 6.0 * (-1.0) ** np.arange(FRAMES)
    held = np.arange(FRAMES) % 3 == 0
    for k in np.flatnonzero(held)[1:]:
        rows["torque_nm"][k] = rows["torque_nm"][k - 1]
    rows["held"][held] = 1
    assert look(rows).against.startswith("torque 1 chatters by 12.00 Nm")
    rows["held"] = 1
    assert {one.what for one in look(rows).unseen} == {"torque"} and not look(rows).good


@pytest.mark.parametrize(("lost", "good"), [(0.1, True), (0.25, False)])
def test_frames_that_were_lost_were_not_seen(lost: float, good: bool) -> None:
    rows = frames(swing_n=0.0, count=2 * FRAMES)
    rng = np.random.default_rng(1)
    gone = rng.choice(WINDOW - 1, round(lost * WINDOW), replace=False) + len(rows) - WINDOW
    assert look(np.delete(rows, gone)).good is good


@pytest.mark.parametrize("every", [2, 10, 90, 400])
def test_a_line_of_which_hardly_a_frame_came_is_not_said_to_stand_nor_to_move(every: int) -> None:
    recent = taken(frames(swing_n=0.0, count=3 * FRAMES)[::every])
    assert not recent.stands()
    now = recent.standing()
    assert now is not None and (now.tension_seen <= 1.0 / every + 1.0 / WINDOW).all()
    assert len(look_at(now, None, LINE.gate, EACH).unseen) >= np.count_nonzero(EACH)


def test_a_move_is_seen_in_the_frames_that_came() -> None:
    rows = frames(swing_n=0.0, count=3 * FRAMES)
    rows["tension_setpoint_n"][-100:] += 1.0
    assert taken(rows[::10]).standing() is None


def test_before_it_was_looked_at_for_long_enough_nothing_is_said() -> None:
    rows = frames(swing_n=0.0, count=FRAMES)
    assert taken(rows[:-1]).standing() is None and taken(np.delete(rows, slice(1, -1))).standing() is not None


def test_lost_frames_do_not_make_two_changes_one() -> None:
    rows = frames(swing_n=0.0, count=2 * FRAMES)
    rows["torque_nm"][:, 0] = 1000.0 * np.arange(len(rows))
    now = taken(np.delete(rows, [len(rows) - 20])).standing()
    assert now is not None and now.chatter_nm[0] == pytest.approx(1000.0)


@pytest.mark.parametrize("name", ["tension_setpoint_n", "speed_setpoint_m_per_s"])
def test_a_set_point_that_is_no_number_does_not_stand(name: str) -> None:
    rows = frames(swing_n=0.0)
    rows[name][-7] = np.nan
    assert not taken(rows).stands()


def test_a_sample_that_is_no_number_was_not_seen_whatever_its_quality() -> None:
    rows = frames()
    rows["tension_n"][-WINDOW::10] = np.nan
    assert "tension 3 swings by" in look(rows).against
    rows["tension_n"][-WINDOW:] = np.nan
    assert len(look(rows).unseen) == np.count_nonzero(EACH)


def test_the_newest_frame_and_how_long_the_line_ran_are_forgotten() -> None:
    recent = taken(frames())
    assert recent.newest_s == pytest.approx(100.0 + (FRAMES - 1) * PERIOD_S)
    assert recent.ran_s == pytest.approx(STANDING_S)
    recent.forget()
    assert recent.newest_s is None and recent.ran_s == 0.0 and recent.standing() is None
