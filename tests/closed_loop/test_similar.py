"""Lines that differ in nothing but their size do the same thing: no constant of one line is in the loop.

Scaled by powers of two, every digit of every torque stays: a number of newtons, metres or seconds that is nobody's
shows as a difference. From the foil of 0.1 N to the laminator of 10 kN.
"""

from functools import cache
from typing import Any

import numpy as np
import pytest

from gateway.control.design import design_lqi, task_of
from gateway.core.controller_laws import LqiConfig
from gateway.core.line import Line, Parameter
from gateway.core.messages import SetSpeed, SetTension, Stop
from gateway.core.signals import DriveState
from gateway.core.states import Phase
from gateway.loop.commands import carry_out
from gateway.loop.machine import to_phase
from tests.closed_loop.conftest import demo_line
from tests.closed_loop.similar_line import Change, SimilarLoop
from tests.support.similar import Similar

SPANS, AT = 3, 150  #: the period in which something happens
PERIODS, OF_A_START, OF_A_BREAK = 500, 1000, 1050
SIZES = {
    "foil of 0.1 N": Similar(force=2.0**-9),
    "laminator of 15 kN": Similar(force=2.0**8),
    "8 m/s": Similar(length=2.0**6),
    "eight times as fast": Similar(time=2.0**-3),
    "laminator, long, slow": Similar(2.0**7, 2.0**4, 2.0),
}


def nothing(k: int, loop: SimilarLoop) -> None: ...


def torn_tension(k: int, loop: SimilarLoop) -> None:
    if k in (AT, AT + 40):
        loop.inputs.tension.value[1] = 11.0 * loop.size.of("_n")


def torn_tensions(k: int, loop: SimilarLoop) -> None:
    if k in (AT, AT + 2, AT + 4):
        loop.inputs.tension.value[1] = 55.0 * loop.size.of("_n")


def growing_tensions(k: int, loop: SimilarLoop) -> None:
    """Words torn by more and more: the first that is not used, and all after it, tell where the bound is."""
    if k >= AT and (k - AT) % 15 == 0:
        loop.inputs.tension.value[1] += 0.5 * 1.15 ** ((k - AT) / 15) * loop.size.of("_n")


def growing_speeds(k: int, loop: SimilarLoop) -> None:
    if k >= AT and (k - AT) % 5 == 0:
        loop.inputs.speed.value[1] += 5e-4 * 1.1 ** ((k - AT) / 5) * loop.size.of("_m_per_s")


def torn_torque(k: int, loop: SimilarLoop) -> None:
    if k == AT:
        loop.inputs.torque.value[0] = -50.0 * loop.size.of("_nm")


def unit_changed(k: int, loop: SimilarLoop) -> None:
    if k >= AT:
        loop.inputs.tension.value[2] *= 0.5


def jump(k: int, loop: SimilarLoop) -> None:
    if k in (AT, AT + 30):
        loop.inputs.speed.value[1] += 0.05 * loop.size.of("_m_per_s")


def unwinder(k: int, loop: SimilarLoop) -> None:
    if k >= AT:
        loop.inputs.unwind_speed.value[0] = 0.05 * loop.size.of("_m_per_s")


def stuck(k: int, loop: SimilarLoop) -> None:
    if k >= AT:
        loop.inputs.tension.value[0] = 28.0 * loop.size.of("_n")


def frozen(k: int, loop: SimilarLoop) -> None:
    if k >= 300:  # its jitter must be known
        loop.inputs.speed.value[0] = 0.0105 * loop.size.of("_m_per_s")


def web_break(k: int, loop: SimilarLoop) -> None:
    if k == AT:
        loop.plant.broken = 1


def drive_lost(k: int, loop: SimilarLoop) -> None:
    if k >= AT:
        loop.plant.lost = 1
        loop.inputs.drive_state[1] = DriveState.FAULT


def too_tight(k: int, loop: SimilarLoop) -> None:
    if AT <= k < AT + 200:  # a cell that shows less and less: control pulls more and more, then it tells the truth
        loop.inputs.tension.value[1] -= (k - AT) * 0.15 * loop.size.of("_n")


def emergency_stop(k: int, loop: SimilarLoop) -> None:
    if k == AT:
        loop.plant.emergency_stop = True


def operators_day(k: int, loop: SimilarLoop) -> None:
    """A step of a tension, a step of the speed, a ramp, a stop."""
    force, speed = loop.size.of("_n"), loop.size.of("_m_per_s")
    commands = {
        AT: SetTension(span=2, tension_n=45.0 * force, step=True),
        AT + 20: SetTension(span=3, tension_n=30.0 * force, step=True),
        AT + 40: SetSpeed(speed_m_per_s=0.06 * speed, step=True),
        AT + 140: SetSpeed(speed_m_per_s=0.09 * speed),
        AT + 160: SetTension(span=1, tension_n=35.0 * force),
        AT + 240: Stop(),
    }
    if k in commands:
        assert carry_out(loop.cycle, commands[k], loop.now_s, None).ok


def from_standstill(k: int, loop: SimilarLoop) -> None:
    cycle, way = loop.cycle, {2: Phase.ARMING, 20: Phase.ENABLING}
    if k in way:
        cycle.change(to_phase(cycle.machine, way[k], loop.now_s))


CHANGES = [
    nothing, growing_tensions, growing_speeds, torn_tension, torn_tensions, torn_torque,
    unit_changed, jump, unwinder, stuck, frozen, web_break,
    drive_lost, too_tight, emergency_stop, operators_day, from_standstill,
]  # fmt: skip


def drawn(seed: int) -> Line:
    """The demonstration line with other rollers, spans and web: other dimensionless numbers."""
    line, rng = demo_line(SPANS), np.random.default_rng(seed)

    def times(parameter: Parameter, most: float) -> Parameter:
        return parameter.model_copy(update={"value": parameter.value * float(np.exp(rng.uniform(-most, most)))})

    rollers = [
        roller.model_copy(
            update={"inertia_kg_m2": times(roller.inertia_kg_m2, 1.0), "radius_m": times(roller.radius_m, 0.2),
                    "friction_nms_per_rad": times(roller.friction_nms_per_rad, 0.3)}
        )
        for roller in line.rollers
    ]  # fmt: skip
    spans = [span.model_copy(update={"length_m": times(span.length_m, 0.7)}) for span in line.spans]
    web = line.web.model_copy(update={"stiffness_n": times(line.web.stiffness_n, 0.5)})
    return line.model_copy(update={"rollers": rollers, "spans": spans, "web": web})


@cache
def of_file() -> tuple[Line, LqiConfig]:
    """The demonstration line of some spans, quick enough for its samples to be judged; and a law for it."""
    line = Similar().line(demo_line(SPANS))
    return line, design_lqi(task_of(line))


def ran(size: Similar, index: int) -> SimilarLoop:
    line, config = of_file()
    loop = SimilarLoop(size.line(line), size.lqi(config), size, CHANGES[index])
    return loop.run(OF_A_START) if CHANGES[index] is from_standstill else loop.in_production().run(PERIODS)


class Calm(np.random.Generator):
    """Nothing shakes the line any more: what is braked comes to rest."""

    def __init__(self) -> None:
        super().__init__(np.random.PCG64(1))

    def standard_normal(self, size: Any = None, dtype: Any = None, out: Any = None) -> Any:
        return np.zeros(() if size is None else size)


@cache
def braked() -> tuple[Line, LqiConfig]:
    """The same, whose drives may brake."""
    line, config = of_file()
    brake = {"braking_torque_nm": 2.0, "braking_power_w": 2.0, "braking_energy_j": 50.0}
    drives = [drive.model_copy(update=brake) for drive in line.drives]
    return line.model_copy(update={"drives": drives}), config


@pytest.mark.parametrize("span", [0, 1])
def test_a_web_that_breaks_is_braked_alike_whatever_its_size(span: int) -> None:
    def breaks(k: int, loop: SimilarLoop) -> None:
        if k == AT:
            loop.plant.broken, loop.plant.rng = span, Calm()

    line, config = braked()
    one, *others = (
        SimilarLoop(size.line(line), size.lqi(config), size, breaks).in_production().run(OF_A_BREAK)
        for size in (Similar(), *SIZES.values())
    )
    assert [phase for _, _, phase in one.told if phase == "BRAKING"] and one.told[-1][2] == "OFF", one.told
    for other in others:
        assert other.told == one.told
        assert np.array_equal(np.array(other.torques) / other.size.of("_nm"), np.array(one.torques))
        assert np.array_equal(np.array(other.tensions) / other.size.of("_n"), np.array(one.tensions))


@cache
def ran_as_in_the_file(index: int) -> SimilarLoop:
    return ran(Similar(), index)


@pytest.mark.parametrize("index", range(len(CHANGES)), ids=[change.__name__ for change in CHANGES])
def test_a_line_of_any_size_does_the_same(index: int) -> None:
    one = ran_as_in_the_file(index)
    for name, size in SIZES.items():
        other = ran(size, index)
        assert other.told == one.told, name
        assert np.array_equal(np.array(other.torques) / size.of("_nm"), np.array(one.torques)), name
        assert np.array_equal(np.array(other.tensions) / size.of("_n"), np.array(one.tensions)), name


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_so_do_lines_that_are_drawn(seed: int) -> None:
    line = Similar().line(drawn(seed))
    config = design_lqi(task_of(line))
    for change in (operators_day, torn_tensions):
        one, *others = (
            SimilarLoop(size.line(line), size.lqi(config), size, change).in_production().run(300)
            for size in (Similar(), *list(SIZES.values())[::2])
        )
        for other in others:
            assert other.told == one.told
            assert np.array_equal(np.array(other.torques) / other.size.of("_nm"), np.array(one.torques))


@pytest.mark.parametrize(
    ("change", "codes", "within"),
    [
        (nothing, None, 0), (operators_day, None, 0), (from_standstill, None, 0),
        (torn_tension, "value-impossible", 1), (torn_tensions, "value-impossible", 4),
        (unit_changed, "signals-missing", 3), (jump, "encoder-jump", 30), (stuck, "load-cell-stuck", 110),
        (web_break, "web-break", 5), (drive_lost, "drive-state", 1), (emergency_stop, "emergency-stop", 1),
    ],
)  # fmt: skip
def test_what_is_found_and_when(change, codes: str | None, within: int) -> None:
    """So that lines which all do nothing are not taken for alike."""
    told = ran_as_in_the_file(CHANGES.index(change)).told
    if codes is None:
        assert not [one for one in told if one[1]]
        assert change is not from_standstill or told[-1][2] == "RUNNING"
    else:
        assert [k for k, found, _ in told if codes in found.split(",")][-1] <= AT + max(within, 40), told
        assert [k for k, found, _ in told if codes in found.split(",")][0] <= AT + within, told


@pytest.mark.parametrize("seed", range(4, 7))
def test_a_healthy_line_loses_no_sample_and_a_torn_word_moves_nothing(seed: int) -> None:
    """Start, steps, grade changes and stop of lines that are drawn; then words torn at random, one at a time."""
    line, rng = Similar().line(drawn(seed)), np.random.default_rng(seed)
    config, size = design_lqi(task_of(line)), Similar()
    for change in (from_standstill, operators_day):
        loop = SimilarLoop(line, config, size, change)
        told = (loop if change is from_standstill else loop.in_production()).run(OF_A_START).told
        assert not [one for one in told if one[1]]

    def torn(k: int, loop: SimilarLoop) -> None:
        if k % 60 == 59:
            loop.inputs.tension.value[int(rng.integers(SPANS))] = rng.uniform(-60.0, 60.0)

    def moved_n(change: Change) -> float:
        loop = SimilarLoop(line, config, size, change).in_production().run(1500)
        assert loop.cycle.machine.phase is Phase.RUNNING
        return float(np.abs(np.array(loop.tensions) - line.recipes[0].tension_n).max())

    # 25 words that are off by some 40 N: what is left of them is what noise might have done.
    assert moved_n(torn) < moved_n(nothing) + 0.5
