"""Assessment of data: every way in which they are bad is named and refused, and good data are not."""

import os
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from gateway.core.recording import Recording
from gateway.identification.alignment import aligned
from gateway.identification.assess_excitation import Wanted
from gateway.identification.assessment import assess
from gateway.identification.findings import Severity
from sim_plant.plant import Plant
from tests.bench.control_plants import scaled
from tests.closed_loop.recorded import demonstration_line, per_roller, real_plant, recorded, without
from tests.closed_loop.spoiled import (
    doubled,
    frozen,
    joined,
    repeated,
    shifted,
    stuck_with_noise,
    swapped,
    times,
    unwinder_swapped,
)

LINE = demonstration_line()
#: R2RGATE_SEEDS=6 runs the whole campaign, which takes some ten minutes.
SEEDS = range(int(os.environ.get("R2RGATE_SEEDS", "1")))
T, V, U = "tension_n", "speed_m_per_s", "torque_nm"
V0, SETPOINT = "unwind_speed_m_per_s", "tension_setpoint_n"
TOLERANCE = {"stiffness_n": 0.3, "inertia_kg_m2": 0.3, "length_m": 0.3, "radius_m": 0.2, "friction_nms_per_rad": 0.75}

Spoil = Callable[[Recording, int], Recording]


@cache
def good(seed: int) -> Recording:
    return recorded(real_plant(), seed)


@cache
def still(seed: int) -> Recording:
    return recorded(real_plant(), seed, amplitude_n=0.0)


def plant_within_tolerances(seed: int) -> Plant:
    """S_sim with each parameter anywhere in its range, as far as the drives can hold it at 0.05 m/s."""
    generator = np.random.default_rng(500 + seed)
    base = real_plant("s_sim")
    base = base.model_copy(update={"rollers": base.rollers.model_copy(update={"disturbance_m_per_s2": 5e-2})})
    while True:
        plant = scaled(base, {name: float(generator.uniform(1.0 - t, 1.0 + t)) for name, t in TOLERANCE.items()})
        p = plant.parameters()
        if (p.friction_nms_per_rad * 0.05 / p.radius_m <= 35.0).all():
            return plant


@cache
def of_another_line(seed: int) -> Recording:
    """As S_real, but for a product that is stiffer by a quarter."""
    return recorded(scaled(real_plant(), {"stiffness_n": 1.25}), 70 + seed)


SWAPPED: dict[str, tuple[Spoil, str]] = {
    "neighbouring tensions": (lambda r, s: swapped(r, T, s, s + 1), "tension_{0}_n and tension_{1}_n"),
    "speeds": (lambda r, s: swapped(r, V, s, s + 1), "speed_{0}_m_per_s and speed_{1}_m_per_s"),
    "torques": (lambda r, s: swapped(r, U, s, s + 1), "torque_{0}_nm and torque_{1}_nm"),
    "unwinder": (lambda r, s: unwinder_swapped(r, s), "unwind_speed_m_per_s and speed_{0}_m_per_s"),
}


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", SWAPPED)
def test_exchanged_channels_are_named(kind: str, seed: int):
    spoil, where = SWAPPED[kind]
    found = assess(spoil(good(seed), seed), LINE)
    assert [(f.kind, f.where) for f in found.refusals] == [("swapped", where.format(seed + 1, seed + 2))]


@pytest.mark.parametrize("seed", SEEDS)
def test_two_exchanges_at_once_are_both_named(seed: int):
    found = assess(swapped(swapped(good(seed), T, 0, 3), U, 1, 5), LINE)
    assert {f.where for f in found.refusals} == {"tension_1_n and tension_4_n", "torque_2_nm and torque_6_nm"}


FROZEN: dict[str, tuple[Spoil, str]] = {
    "tension for good": (lambda r, s: frozen(r, T, s, 200), "tension_{}_n"),
    "tension for 0.2 s": (lambda r, s: frozen(r, T, s, 200, 220), "tension_{}_n"),
    "speed": (lambda r, s: frozen(r, V, s, 200, 230), "speed_{}_m_per_s"),
    "torque": (lambda r, s: frozen(r, U, s, 100, 200), "torque_{}_nm"),
    "tension, with noise": (lambda r, s: stuck_with_noise(r, T, s, 0.1, s), "tension_{}_n"),
    "speed, with noise": (lambda r, s: stuck_with_noise(r, V, s, 1e-4, s), "speed_{}_m_per_s"),
}


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", FROZEN)
def test_a_sensor_that_is_stuck_is_named(kind: str, seed: int):
    spoil, where = FROZEN[kind]
    found = assess(spoil(good(seed), seed), LINE)
    assert [f.kind for f in found.refusals] == ["frozen"]
    assert found.refusals[0].where.startswith(where.format(seed + 1))


def both(recording: Recording, factor: float, *columns: int) -> Recording:
    """A logger that shows tensions and set-points in the same unit."""
    return times(times(recording, T, factor, *columns), SETPOINT, factor, *columns)


UNITS: dict[str, tuple[Spoil, str, str]] = {
    "one tension in lbf": (lambda r, s: times(r, T, 1 / 4.44822, s), "tension_{}_n", "lbf"),
    "one tension in kN": (lambda r, s: times(r, T, 1e-3, s), "tension_{}_n", "kN"),
    "one tension and its set-point in kgf": (lambda r, s: both(r, 1 / 9.80665, s), "tension_{}_n", "kgf"),
    "one tension and its set-point in mN": (lambda r, s: both(r, 1e3, s), "tension_{}_n", "mN"),
    "all tensions in kgf": (lambda r, s: both(r, 1 / 9.80665), "all tensions", "kgf"),
    "all tensions in lbf": (lambda r, s: both(r, 1 / 4.44822), "all tensions", "lbf"),
    "all tensions in kN": (lambda r, s: both(r, 1e-3), "all tensions", "kN"),
    "all tensions tenfold": (lambda r, s: both(r, 10.0), "all tensions", "tenths of N"),
    "one speed in mm/s": (lambda r, s: times(r, V, 1e3, s), "speed_{}_m_per_s", "mm/s"),
    "one speed in m/min": (lambda r, s: times(r, V, 60.0, s), "speed_{}_m_per_s", "m/min"),
    "one speed in rpm": (lambda r, s: times(r, V, 60 / (2 * np.pi * 0.04), s), "speed_{}_m_per_s", "rpm"),
    "one speed in rad/s": (lambda r, s: times(r, V, 1 / 0.04, s), "speed_{}_m_per_s", "rad/s"),
    "v0 in m/min": (lambda r, s: times(r, V0, 60.0), V0, "m/min"),
    "all speeds in mm/s": (lambda r, s: times(times(r, V, 1e3), V0, 1e3), "all speeds", "mm/s"),
    "one torque in per mille": (lambda r, s: times(r, U, 1e3 / 60, s), "torque_{}_nm", "Nm"),
    "one torque as a part": (lambda r, s: times(r, U, 1 / 60, s), "torque_{}_nm", "parts of the rated torque"),
    "one torque in kgf m": (lambda r, s: times(r, U, 1 / 9.80665, s), "torque_{}_nm", "kgf m"),
    "all torques in daNm": (lambda r, s: times(r, U, 0.1), "all torques", "daNm"),
    "all torques in Ncm": (lambda r, s: times(r, U, 100.0), "torque_1_nm", "Nm"),
    "time in ms": (lambda r, s: replace(r, time_s=1e3 * r.time_s), "time_s", "ms"),
}


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", UNITS)
def test_a_wrong_unit_is_named(kind: str, seed: int):
    spoil, where, unit = UNITS[kind]
    found = assess(spoil(good(seed), seed), LINE)
    assert not found.usable
    assert any(
        f.kind == "unit" and f.where == where.format(seed + 1) and unit in f.mend + f.what for f in found.refusals
    ), [str(f) for f in found.refusals]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("channel", "name"), [(T, "tension_{}_n"), (V, "speed_{}_m_per_s"), (U, "torque_{}_nm")])
def test_a_wrong_sign_is_named(channel: str, name: str, seed: int):
    found = assess(times(good(seed), channel, -1.0, seed), LINE)
    assert any(f.where == name.format(seed + 1) and "sign" in f.what + f.mend for f in found.refusals)


def out_of_order(recording: Recording) -> Recording:
    time_s = recording.time_s.copy()
    time_s[300:] -= 3.0
    return replace(recording, time_s=time_s)


def trembling(recording: Recording, seed: int) -> Recording:
    off = 0.4 * recording.period_s * np.random.default_rng(seed).uniform(-1.0, 1.0, recording.samples)
    return replace(recording, time_s=recording.time_s + off)


def uncontrolled(recording: Recording) -> Recording:
    return replace(recording, controlled=np.zeros_like(recording.controlled))


OTHERS: dict[str, tuple[Spoil, str]] = {
    "many lost": (lambda r, s: without(r, 200, 230 + s), "gap"),
    "time that goes back": (lambda r, s: out_of_order(r), "time order"),
    "samples twice": (lambda r, s: doubled(r, 100, 1 + s), "duplicate"),
    "samples repeated": (lambda r, s: repeated(r, 10), "duplicate"),
    "every second sample": (lambda r, s: without_every_second(r), "period"),
    "jitter": (lambda r, s: trembling(r, s), "jitter"),
    "no excitation": (lambda r, s: still(s), "excitation"),
    "not under control": (lambda r, s: uncontrolled(r), "short"),
    "half a second": (lambda r, s: r.part(0, 50), "short"),
    "two lines, one after the other": (lambda r, s: joined(r, of_another_line(s), 200 + 50 * s), "mixed"),
    "torques of another day": (lambda r, s: replace(r, torque_nm=good(s + 1).torque_nm), "mixed"),
    "tensions of another line": (lambda r, s: replace(r, tension_n=of_another_line(s).tension_n), "mixed"),
    "a tension late": (lambda r, s: shifted(r, T, s, 1), "offset"),
    "all tensions late": (lambda r, s: shifted(r, T, -1, 1), "offset"),
    "torques that act before they are sent": (lambda r, s: shifted(r, U, -1, 1), "offset"),
    "a load cell that is not recorded": (lambda r, s: times(r, T, np.nan, s), "unknown"),
    "torque noise in place of torque": (lambda r, s: stuck_with_noise(r, U, s, 5.0, s), "unexplained"),
}


def without_every_second(recording: Recording) -> Recording:
    for k in range(recording.samples - 2, 0, -2):
        recording = without(recording, k, k + 1)
    return recording


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", OTHERS)
def test_what_else_is_bad_is_named(kind: str, seed: int):
    spoil, word = OTHERS[kind]
    found = assess(spoil(good(seed), seed), LINE)
    assert not found.usable and word in found.kinds(), [str(f) for f in found.findings]


def test_another_lines_recording_is_refused():
    three = recorded(real_plant().model_copy(update={"spans": 3}), 0, duration_s=0.2, line=demonstration_line(3))
    found = assess(three, LINE)
    assert [f.kind for f in found.refusals] == ["spans"] and "3 spans" in str(found.refusals[0])


def test_without_excitation_it_says_how_much_and_by_which_experiment():
    found = assess(still(0), LINE)
    stiff = next(f for f in found.refusals if f.where == "EA/L")
    assert stiff.limit < stiff.value == found.predicted["stiffness_per_length"]
    assert "+-2 N" in stiff.experiment and "for 5 s" in stiff.experiment
    assert any(f.kind == "one speed" and f.severity is Severity.WARNING for f in found.findings)


def test_an_experiment_that_was_short_of_it_is_asked_for_longer():
    found = assess(good(0), LINE, Wanted(radius_per_inertia=0.001))
    asked = next(f for f in found.refusals if f.kind == "excitation")
    assert "for 2" in asked.experiment or "for 3" in asked.experiment  # 5 s and an interval of twice what is wanted
    assert asked.value == found.predicted["radius_per_inertia"] > 0.001


GOOD: dict[str, Callable[[int], Recording]] = {
    "S_real": lambda seed: recorded(real_plant(), 200 + seed),
    "S_real at two speeds": lambda seed: recorded(real_plant(), 200 + seed, speeds_m_per_s=(0.05, 0.1)),
    "within the tolerances": lambda seed: recorded(plant_within_tolerances(seed), 200 + seed),
    "rollers that differ": lambda seed: recorded(per_roller(real_plant(), 0.1, seed), 200 + seed),
    "realistic": lambda seed: recorded(real_plant("realistic"), 200 + seed),
}


@pytest.mark.parametrize("kind", GOOD)
def test_good_data_are_not_refused(kind: str):
    for seed in range(2 * len(SEEDS)):
        found = assess(GOOD[kind](seed), LINE)
        assert found.usable, (seed, [str(f) for f in found.refusals])
        assert {f.kind for f in found.findings} <= {"offset", "weak", "one speed"}
        assert found.predicted["stiffness_per_length"] < 0.01 and found.predicted["radius_per_inertia"] < 0.01


def test_the_predicted_intervals_hold():
    """EA/L, R/J and f/J of S_real, each equation by itself, against the truth."""
    inside = []
    for seed in range(6):
        for fit in assess(recorded(real_plant(), 300 + seed), LINE).fits:
            truth = [2200.0 / 1.2] if fit.kind == "span" else [0.035, 15.0]
            for k, true in enumerate(truth):
                inside.append(abs(fit.coefficients[k] - true) < 1.96 * np.sqrt(fit.covariance[k, k]))
    assert len(inside) == 6 * 18 and np.mean(inside) > 0.85


def test_the_lag_and_filter_of_a_realistic_line_are_told_not_refused():
    found = assess(recorded(real_plant("realistic"), 1), LINE)
    offsets = {f.where: f for f in found.findings if f.kind == "offset"}
    assert found.usable and {"tension_6_n", "torque_5_nm"} <= set(offsets)
    assert offsets["torque_5_nm"].value == pytest.approx(-0.003, abs=1e-3)
    assert "lag" in offsets["torque_5_nm"].mend


def test_what_was_late_is_usable_when_it_has_been_mended():
    late = assess(shifted(good(0), T, -1, 1), LINE)
    assert late.kinds() == {"offset"}
    measured = [a for a in late.alignments if not a.channel.startswith("torque")]
    mended = aligned(shifted(good(0), T, -1, 1), measured, least_s=1e-3)
    assert assess(mended, LINE).usable


def test_the_pieces_on_both_sides_of_a_gap_are_used_together():
    found = assess(without(good(0), 200, 205), LINE)
    assert found.usable and [f.severity for f in found.findings if f.kind == "gap"] == [Severity.WARNING]


def test_a_draw_span_needs_no_load_cell():
    spans = [s.model_copy(update={"control": "draw"}) if i == 2 else s for i, s in enumerate(LINE.spans)]
    found = assess(times(good(0), T, np.nan, 2), LINE.model_copy(update={"spans": spans}))
    assert found.usable and not any(f.kind == "unknown" for f in found.findings)
