"""Load cells that show one value are told from coarse ones, without a loop."""

import numpy as np
import pytest

from gateway.core.signals import Inputs
from safety.actions import Action, Finding, found
from safety.stuck import LEARNT_REVERSALS, SILENT_PERIODS, Cell, StuckLimits, StuckState, find_stuck, stuck_limits
from tests.closed_loop.conftest import demo_line

LINE = demo_line()


def test_cells_of_tension_spans_are_judged_after_the_time_of_the_lines_file() -> None:
    limits = stuck_limits(LINE)
    assert limits.measured.tolist() == [span.control == "tension" for span in LINE.spans]
    assert limits.stuck_periods == round(LINE.limits.stuck_s / LINE.control.period_s)
    slow = LINE.model_copy(update={"limits": LINE.limits.model_copy(update={"stuck_s": 1e-3})})
    assert stuck_limits(slow).stuck_periods == 1


STUCK = StuckLimits(np.array([True, True, False]), stuck_periods=5)


def stuck_after(tensions: list[tuple[float, float, float]], alive: bool = True) -> tuple[StuckState, list[Finding]]:
    state, inputs = StuckState(), Inputs(3)
    stuck: list[Finding] = []
    for k, values in enumerate(tensions):
        for i, value in enumerate(values):
            inputs.tension.put(i, value, 0.0)
            inputs.speed.put(i, 0.05 + (1e-4 * (k % 2) if alive else 0.0), 0.0)
        findings = find_stuck(STUCK, state, inputs)
        stuck += findings
    return state, stuck


def noisy(count: int) -> list[tuple[float, float, float]]:
    """Fine cells: 0.01 N a count, noise of 0.1 N."""
    samples = np.round(np.random.default_rng(2).normal(30.0, 0.1, (count, 3)) / 0.01) * 0.01
    return [(float(a), float(b), float(c)) for a, b, c in samples]


def test_a_cell_that_stands_still_while_rollers_move_is_stuck_after_its_time() -> None:
    still = [(40.0 + 0.1 * k, 31.0, 30.0 + 0.1 * k) for k in range(6)]
    assert not stuck_after(noisy(300) + still[:5])[0].stuck.any()
    state, stuck = stuck_after(noisy(300) + still)
    assert list(state.stuck) == [False, True, False], "span 3 is not controlled by its cell"
    assert stuck == [found("load-cell-stuck", Action.STOP, span=2, tension_n=31.0, in_a_row=5)]


def test_a_fine_cell_that_shows_one_value_is_silent_until_it_shows_another() -> None:
    still = [(40.0 + 0.1 * k, 31.0, 31.0) for k in range(SILENT_PERIODS + 1)]
    assert stuck_after(noisy(300) + still[:-1])[0].silent == []
    assert stuck_after(noisy(300) + still)[0].silent == [1]
    assert stuck_after([*noisy(300), *still, (40.0, 31.1, 31.0)])[0].silent == []


@pytest.mark.slow
@pytest.mark.parametrize("repeats", [2, 5, 9, 20])
def test_an_amplifier_slower_than_the_loop_is_never_silent(repeats: int) -> None:
    assert not any(
        stuck_after([sample for sample in noisy(100) for _ in range(repeats)][:count])[0].silent
        for count in range(60 * repeats, 100 * repeats)
    )


def test_a_cell_is_judged_only_after_it_has_been_learnt() -> None:
    assert not stuck_after(noisy(LEARNT_REVERSALS - 5) + [(30.0, 30.0, 30.0)] * 50)[0].stuck.any()


@pytest.mark.parametrize("noise_n", [0.02, 0.03, 0.05])
def test_a_healthy_cell_with_a_coarse_resolution_is_not_stuck(noise_n: float) -> None:
    """0.1 N a count, a filter of 10 Hz: the same count may come for seconds."""
    rng, filtered = np.random.default_rng(1), np.zeros(3)
    tensions: list[tuple[float, float, float]] = []
    for noise in rng.normal(0.0, noise_n, (30_000, 3)):
        filtered += 0.47 * (noise - filtered)
        one, two, three = np.round((30.0 + filtered) / 0.1) * 0.1
        tensions.append((one, two, three))
    assert stuck_after(tensions)[1] == [], "five minutes"


def test_a_sample_that_did_not_come_tells_nothing_of_its_cell() -> None:
    state, inputs = StuckState(), Inputs(3)
    values = noisy(300) + [(31.0, 31.0, 31.0)] * 12
    for k, row in enumerate(values):
        for i, value in enumerate(row):
            inputs.speed.put(i, 0.05 + 1e-4 * (k % 2), 0.0)
            if k >= 300 and k % 2:
                inputs.tension.miss(i)
            else:
                inputs.tension.put(i, value, 0.0)
        find_stuck(STUCK, state, inputs)
        assert list(state.stuck) == [k >= 310, k >= 310, False], "every other sample: the sixth like it is the eleventh"


@pytest.mark.parametrize(("count_n", "step_n"), [(0.02, 5.0), (0.01, 2.0), (0.02, 10.0), (0.1, 20.0)])
def test_a_ramp_does_not_teach_that_a_quiet_coarse_cell_is_fine(count_n: float, step_n: float) -> None:
    """The set-point moves by 20 N/s; then the cell shows one count for long."""
    rng = np.random.default_rng(3)
    true_n = 30.0 + np.minimum(0.2 * np.arange(2000), step_n)
    for _ in range(3):
        cells = np.round((true_n[:, None] + rng.normal(0.0, 0.1 * count_n, (2000, 3))) / count_n) * count_n
        assert stuck_after([(float(a), float(b), float(c)) for a, b, c in cells])[1] == []


def test_a_line_on_which_nothing_moves_tells_nothing() -> None:
    assert not stuck_after(noisy(300) + [(30.0, 30.0, 30.0)] * 200, alive=False)[0].stuck.any()


def changed(*changes_n: float) -> Cell:
    cell = Cell(30.0)
    for change_n in changes_n:
        cell.change(change_n)
    return cell


def test_only_a_change_against_the_one_before_teaches() -> None:
    assert changed(0.1).reversals == 0, "the first change of all turns nothing round"
    assert changed(0.1, 0.2, 0.1, -0.3, -0.1, 0.2).reversals == 2
    cell = changed(0.1, -0.3, -0.05, 0.2)
    assert (cell.smallest_n, cell.usual_n) == (0.2, pytest.approx(0.25)), "of -0.3 and 0.2: -0.05 turned nothing round"


def test_a_cell_is_fine_from_three_counts_on_and_once_it_is_learnt() -> None:
    def turning(second_n: float, rest_n: float, reversals: int) -> Cell:
        sizes = np.array([1.0, second_n, *[rest_n] * (reversals - 2)])
        return changed(1.0, *(sizes * (-1.0) ** np.arange(1, reversals + 1)).tolist())

    three = turning(5.0, 3.0, LEARNT_REVERSALS)
    assert (three.reversals, three.smallest_n, three.usual_n) == (LEARNT_REVERSALS, 1.0, 3.0)
    assert three.fine() and not turning(5.0, 3.0, LEARNT_REVERSALS - 1).fine()
    assert not turning(5.0, 2.999, LEARNT_REVERSALS).fine()
