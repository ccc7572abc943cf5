"""Time offsets between channels: found within their intervals, and mended."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from gateway.cli.identify_align import without_offsets
from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.identification.alignment import Alignment, aligned, estimate_alignment
from gateway.identification.assessment import assess
from gateway.identification.findings import Severity
from tests.closed_loop.recorded import demonstration_line, real_plant, recorded, without
from tests.closed_loop.spoiled import shifted

LINE = demonstration_line()
PERIOD_S = LINE.control.period_s


@cache
def good(seed: int) -> Recording:
    return recorded(real_plant(), seed)


@cache
def filtered(seed: int, corner_hz: float) -> Recording:
    """Load cells behind a low pass, which is a delay to what is much slower."""
    plant = real_plant()
    sensors = plant.sensors.model_copy(update={"tension_corner_hz": corner_hz})
    return recorded(plant.model_copy(update={"sensors": sensors}), seed)


def offsets(recording: Recording) -> dict[str, Alignment]:
    return {alignment.channel: alignment for alignment in estimate_alignment(recording, LINE)}


def test_what_is_aligned_is_said_to_be_so():
    inside, widths = [], []
    for seed in range(8):
        for alignment in offsets(good(seed)).values():
            if alignment.known and not alignment.reference:
                inside.append(alignment.low_s <= 0.0 <= alignment.high_s)
                widths.append(alignment.high_s - alignment.low_s)
    assert len(inside) == 8 * 17
    assert np.mean(inside) >= 0.9  # of 95 %; channels of one recording are not independent
    assert np.median(widths) < 1.5e-3 and max(widths) < 3e-3


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("column", [0, 2, 5])
def test_a_tension_late_by_a_period_is_found(seed: int, column: int):
    found = offsets(shifted(good(seed), "tension_n", column, 1))
    late = found[f"tension_{column + 1}_n"]
    assert late.low_s - 5e-4 < PERIOD_S < late.high_s + 5e-4
    others = [a for name, a in found.items() if a.known and name != late.channel]
    assert all(abs(a.offset_s) < 2e-3 for a in others)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("column", [0, 3])
def test_a_speed_late_by_a_period_is_found(seed: int, column: int):
    late = offsets(shifted(good(seed), "speed_m_per_s", column, 1))[f"speed_{column + 1}_m_per_s"]
    assert late.low_s - 5e-4 < PERIOD_S < late.high_s + 5e-4


@pytest.mark.parametrize("corner_hz", [120.0, 60.0, 30.0])
def test_the_delay_of_a_load_cells_filter_is_found(corner_hz: float):
    held = np.exp(-2.0 * np.pi * corner_hz * 1e-3)  # the simulated filter goes in steps of 1 ms
    delay_s = 1e-3 * held / (1.0 - held)
    found = []
    for seed in range(3):
        cells = [a for name, a in offsets(filtered(seed, corner_hz)).items() if name.startswith("tension")]
        assert all(a.low_s - 5e-4 < delay_s < a.high_s + 5e-4 for a in cells)
        found += [a.offset_s for a in cells]
    assert np.mean(found) == pytest.approx(delay_s, abs=3e-4)


@pytest.mark.parametrize("lag_s", [0.002, 0.005])
def test_the_lag_of_the_drives_torque_is_found(lag_s: float):
    plant = real_plant()
    plant = plant.model_copy(update={"drives": plant.drives.model_copy(update={"torque_lag_s": lag_s})})
    torques = [a for name, a in offsets(recorded(plant, 1)).items() if name.startswith("torque")]
    # a pure delay that comes nearest to an exponential within a period: a little less than its time constant
    assert np.mean([a.offset_s for a in torques]) == pytest.approx(-0.9 * lag_s, abs=5e-4)


@pytest.mark.parametrize("latency_s", [0.006, 0.015, 0.020])
def test_a_latency_that_the_lines_file_has_wrong_is_found(latency_s: float):
    other = LINE.model_copy(update={"control": LINE.control.model_copy(update={"latency_s": latency_s})})
    found = {a.channel: a for a in estimate_alignment(recorded(real_plant(), 2, line=other), LINE)}
    beyond_s = np.mean([a.offset_s for name, a in found.items() if name.startswith("torque")])
    assert -beyond_s == pytest.approx(latency_s - LINE.control.latency_s, abs=5e-4)


def test_without_movement_nothing_is_said():
    found = offsets(recorded(real_plant(), 0, amplitude_n=0.0))
    assert len(found) == 19 and not any(a.known and not a.reference for a in found.values())


def test_a_span_without_a_load_cell_divides_the_line_and_its_channel_is_left_out():
    tension = good(0).tension_n.copy()
    tension[:, 2] = np.nan
    found = offsets(replace(good(0), tension_n=tension))
    assert "tension_3_n" not in found and len(found) == 18
    assert sum(a.reference for a in found.values()) == 2
    assert all(abs(a.offset_s) < 2e-3 for a in found.values())


def test_the_step_of_the_unwinder_is_placed_within_a_period():
    found = offsets(recorded(real_plant(), 0, speeds_m_per_s=(0.05, 0.1)))["unwind_speed_m_per_s"]
    assert found.known and found.low_s < 0.0 < found.high_s and found.high_s - found.low_s > PERIOD_S


def test_an_unwinder_that_is_late_is_found():
    steps = recorded(real_plant(), 0, speeds_m_per_s=(0.05, 0.1))
    found = offsets(shifted(steps, "unwind_speed_m_per_s", -1, 2))["unwind_speed_m_per_s"]
    assert found.low_s < 2 * PERIOD_S < found.high_s and found.low_s > 0.0


def test_what_is_late_is_mended():
    late = shifted(shifted(good(0), "tension_n", 1, 1), "speed_m_per_s", 4, -1)
    found = estimate_alignment(late, LINE)
    measured = [a for a in found if not a.channel.startswith("torque")]
    again = {a.channel: a for a in estimate_alignment(aligned(late, measured, 1e-3), LINE)}
    assert max(abs(a.offset_s) for a in again.values()) < 1e-3


def test_whole_periods_are_moved_exactly_and_the_ends_are_not_known():
    recording = good(0)
    late = Alignment("tension_2_n", 2 * PERIOD_S, 0.0, 0.1)
    moved = aligned(recording, [late])
    assert np.array_equal(moved.tension_n[:-3, 1], recording.tension_n[2:-1, 1])
    assert np.isnan(moved.tension_n[-2:, 1]).all()
    assert np.array_equal(np.delete(moved.tension_n, 1, axis=1), np.delete(recording.tension_n, 1, axis=1))
    assert moved.speed_m_per_s is recording.speed_m_per_s


def test_a_fraction_costs_noise_as_is_said():
    white = np.random.default_rng(0).standard_normal((20000, 1))
    line = recorded(real_plant(), 0, duration_s=0.2)
    time_s = PERIOD_S * np.arange(20000)
    noise = replace(line, time_s=time_s, tension_n=white)
    moved = aligned(noise, [Alignment("tension_1_n", 0.25 * PERIOD_S, 0.0, 0.1)]).tension_n[:-1, 0]
    assert np.std(moved) == pytest.approx(np.sqrt(1 - 0.5 + 0.125), rel=0.03)
    hum = np.sin(2.0 * np.pi * 20.0 * time_s)[:, None]
    half = aligned(replace(noise, tension_n=hum), [Alignment("tension_1_n", 0.5 * PERIOD_S, 0.0, 0.1)])
    assert np.std(half.tension_n[:-1, 0]) / np.std(hum) == pytest.approx(np.cos(np.pi * 20.0 * PERIOD_S), rel=1e-3)


def test_beside_a_gap_nothing_is_moved_into_it():
    recording = good(0)
    order = np.r_[0:100, 110:500]
    gap = replace(recording.part(0, 490), time_s=recording.time_s[order], tension_n=recording.tension_n[order])
    moved = aligned(gap, [Alignment("tension_1_n", 0.5 * PERIOD_S, 0.0, 0.1)])
    assert np.flatnonzero(np.isnan(moved.tension_n[:, 0])).tolist() == [99, 489]


# Lines of other periods


def of_period(period_s: float) -> Line:
    """With drives that move their torque as far in a period: at short ones noise alone would take a slow one's rate."""
    control = LINE.control.model_copy(update={"period_s": period_s, "latency_s": period_s})
    rate = LINE.limits.torque_rate_nm_per_s * PERIOD_S / period_s
    limits = LINE.limits.model_copy(update={"torque_rate_nm_per_s": rate})
    return LINE.model_copy(update={"control": control, "limits": limits})


FAST = of_period(0.002)


@cache
def fast() -> Recording:
    return recorded(real_plant(), 3, 2.0, line=FAST)


def late_by(recording: Recording, channel: str, late_s: float) -> Recording:
    """Between samples in straight lines."""
    return aligned(recording, [Alignment(channel, -late_s, -late_s, -late_s)])


def test_a_line_of_2_ms_knows_its_offsets_to_a_part_of_its_period():
    found = [a for a in estimate_alignment(fast(), FAST) if a.known and not a.reference]
    assert len(found) == 17
    assert np.mean([a.low_s <= 0.0 <= a.high_s for a in found]) >= 0.9
    assert max(a.high_s - a.low_s for a in found) < 1e-3


@pytest.mark.parametrize(
    ("line", "data", "late_s", "said"),
    [
        (FAST, fast, 0.0, None),
        (FAST, fast, 0.6e-3, Severity.WARNING),
        (FAST, fast, 1.6e-3, Severity.REFUSAL),  # of which a line of 10 ms would only warn
        (LINE, lambda: good(3), 2.5e-3, Severity.WARNING),
        (LINE, lambda: good(3), 6e-3, Severity.REFUSAL),
    ],
)
def test_what_a_model_bears_of_an_offset_goes_with_the_period(line, data, late_s, said):
    found = assess(late_by(data(), "tension_3_n", late_s), line)
    of_it = [f.severity for f in found.findings if f.kind == "offset" and f.where == "tension_3_n"]
    assert of_it == ([] if said is None else [said])


def test_what_is_late_by_a_part_of_a_short_period_is_taken_out():
    moved = without_offsets(late_by(fast(), "tension_3_n", 1.6e-3), FAST)
    assert [delay.channel for delay in moved.delays] == ["tension_3_n"]
    assert moved.delays[0].late_s == pytest.approx(1.6e-3, abs=4e-4)


def test_stretches_of_a_short_period_that_no_window_fits_in_tell_nothing():
    """Of 0.14 s, which has room for the window of changes at 10 ms, but not for its many samples at 2 ms."""
    short = fast()
    for begin in range(short.samples - 80, 0, -80):
        short = without(short, begin, begin + 10)
    found = assess(short, FAST)
    assert "short" in found.kinds() and not found.fits
