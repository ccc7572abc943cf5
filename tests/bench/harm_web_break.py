"""Web breaks at any speed, on lines of any size with reels of up to 76 kg m2: who is hurt by what the loop does then?

`draw` makes a line, its truth and a break of a number; `judge` runs it in stepped time, and says what the recorder at
the drives and the web saw. By itself: `python -m tests.bench.harm_web_break --draws 100`.

The physics allows no stop that is quicker than a drive's braking torque and power slow its roller down: the bound of
10 s holds for what can stop within it by the simulated line's own figures.
"""

import tomllib
from argparse import ArgumentParser
from dataclasses import dataclass
from math import inf, log
from typing import Any

import numpy as np

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.line import Line
from gateway.core.line_template import line_template
from gateway.core.signals import FloatArray
from gateway.core.states import LoopState, Phase
from sim_plant.faults.parse import parse_fault
from sim_plant.faults.stepped import injector_of
from sim_plant.plant import Plant, plant_of

AT_REST_S = 10.0  #: after a web break
FIRST_REACTION_PERIODS = 5
RESTS = 0.01  #: of the greatest speed: what is slower rests
HEAVIEST_KG_M2, FASTEST_M_PER_S = 76.0, 8.0
TOLERANCE = {"radius_m": 0.05, "inertia_kg_m2": 0.15, "friction_nms_per_rad": 0.4, "stiffness_n": 0.2, "length_m": 0.1}
RAN_S = 1.5  #: before the break, at least


@dataclass(frozen=True)
class Break:
    """A line, its truth, and the break of a web on it."""

    number: int
    line: Line
    plant: Plant
    tension_n: FloatArray  #: (n,)
    speed_m_per_s: float
    span: int  #: from 1
    at_s: float


@dataclass(frozen=True)
class Judged:
    """What came of a break, by the recorder and the true line."""

    number: int
    rule: str  #: that found it
    reaction_s: float  #: to the first command that is not tension control's
    rest_s: float  #: until the last roller rests; inf: not within the time that was waited
    possible_s: float  #: the least time that brakes and friction allow, by the truth
    unsafe: dict[str, int]  #: torque beyond limit or rate, torque while not enabled; and the three below
    note: str

    @property
    def slow(self) -> bool:
        """Whether it came to rest too late, though it could have been in time."""
        return self.rest_s > AT_REST_S and self.possible_s <= 0.8 * AT_REST_S


def draw(number: int) -> Break:
    """The break of a number: sizes over decades, every parameter anywhere in its tolerance."""
    dice = np.random.default_rng([31, 2, number])

    def over(low: float, high: float) -> float:
        return float(np.exp(dice.uniform(log(low), log(high))))

    n = int(dice.integers(2, 7))
    fastest = over(0.3, FASTEST_M_PER_S)
    tension = np.array([over(0.7, 1.4) for _ in range(n)]) * over(20.0, 300.0)
    stiffness = float(tension.mean()) / over(1e-3, 6e-3)
    length = np.array([over(0.6, 2.5) for _ in range(n)])
    # Rollers that the web swings with, slowly enough for a loop of 10 ms: what is lighter it carries along.
    omega = over(4.0, 20.0)
    radius = np.array([over(0.05, 0.2) for _ in range(n)])
    mass = 2.0 * stiffness / length / (omega * np.array([over(0.7, 1.4) for _ in range(n)])) ** 2
    radius[-1] = over(0.2, 0.5)
    mass[-1] *= over(1.0, 8.0)
    inertia = np.minimum(mass * radius**2, HEAVIEST_KG_M2)
    if number % 4 == 0:
        inertia[-1] = HEAVIEST_KG_M2
    friction = inertia / np.array([over(3.0, 100.0) for _ in range(n)])
    tension_max, tension_min = 2.0 * float(tension.max()), 0.15 * float(tension.min())
    slowing = fastest / over(6.0, 9.0)
    needed = inertia / radius * slowing * over(1.0, 1.6) * 1.5
    holds = friction * fastest / radius + radius * tension_max
    torque = 1.3 * float(np.max(holds + needed))
    power = needed * fastest / radius * over(0.9, 2.0)
    line = _line(n, fastest, tension, tension_min, tension_max, stiffness, length, radius, inertia, friction, torque)
    drives = [
        drive.model_copy(update={"braking_torque_nm": float(needed[i]), "braking_power_w": float(power[i])})
        for i, drive in enumerate(line.drives)
    ]
    line = line.model_copy(update={"drives": drives})
    speed = float(dice.uniform(0.1, 0.95)) * fastest

    def true(name: str, values: FloatArray) -> list[float]:
        return (values * (1.0 + 0.8 * TOLERANCE[name] * dice.uniform(-1.0, 1.0, n))).tolist()

    document: dict[str, Any] = {
        "format": 1,
        "name": f"break-{number}",
        "spans": n,
        "web": {"stiffness_n": true("stiffness_n", np.full(n, stiffness))[0], "length_m": true("length_m", length)},
        "rollers": {
            "radius_m": true("radius_m", radius),
            "inertia_kg_m2": true("inertia_kg_m2", inertia),
            "friction_nms_per_rad": true("friction_nms_per_rad", friction),
            "disturbance_m_per_s2": 1e-3 * fastest,
        },
        "sensors": {"tension_noise_n": 2e-3 * float(tension.mean()), "speed_noise_m_per_s": 1e-4 * fastest},
        "drives": {
            "rated_torque_nm": torque, "max_torque_nm": torque, "torque_lag_s": float(dice.uniform(1e-3, 4e-3)),
            "torque_step_nm": torque / 1000.0,
        },
        "plc": {"speed_ramp_m_per_s2": line.moves.stop_rate_m_per_s2 * over(1.0, 4.0)},
        "effects": {"slack": True},
        "recorder": {
            "torque_nm": torque, "torque_rate_nm_per_s": line.limits.torque_rate_nm_per_s,
            "tension_min_n": tension_min, "tension_max_n": tension_max,
        },
    }  # fmt: skip
    span, at_s = int(dice.integers(1, n + 1)), RAN_S + float(dice.uniform(0.0, 0.1))
    return Break(number, line, plant_of(document), tension, speed, span, at_s)


def judge(case: Break, waited_s: float = 60.0) -> Judged:
    """Run it, break the web, and wait until everything rests."""
    line, truth = case.line, case
    loop = SteppedLoop(line, design_lqi(task_of(line)), case.plant, case.number)
    loop.begin_in_production(case.tension_n, case.speed_m_per_s)
    period_s = line.control.period_s
    injector_of(loop.truth).add(parse_fault(f"web {case.span} web-break at {case.at_s:.4f}"), 0.0)
    before = round(case.at_s / period_s) - 1
    loop.step(before)
    if loop.cycle.machine.phase is not Phase.RUNNING:
        raise RuntimeError(f"draw {case.number} does not run: {loop.cycle.machine.reason}")
    rest_m_per_s = RESTS * line.limits.speed_max_m_per_s
    possible_s = least_possible_s(case, loop.truth.world.surface_speed_m_per_s)
    begun = loop.truth.world.surface_speed_m_per_s.copy()
    reaction_s, rest_s = inf, inf
    reversed_, over = 0, 0.0
    moved_s = case.at_s
    while loop.now_s - case.at_s < waited_s:
        loop.step()
        world = loop.truth.world
        if loop.cycle.machine.state is LoopState.STOP and reaction_s == inf:
            reaction_s = loop.now_s - case.at_s
        reversed_ += int((world.surface_speed_m_per_s < -rest_m_per_s).any())
        if (np.abs(world.surface_speed_m_per_s) > rest_m_per_s).any():
            moved_s = loop.now_s
        elif loop.now_s - moved_s > 1.0:
            break
    if loop.now_s - moved_s > 0.5:
        rest_s = moved_s - case.at_s
    recording = loop.truth.recorder.recording()
    after = recording.time_s >= case.at_s
    over = float((recording.tension_n[after] / line.limits.tension_max_n).max())
    counts = {kind: count for kind, count in loop.truth.recorder.unsafe_events.items() if kind != "tension-band"}
    counts |= {"web-pulled": int(over > 1.0), "reversed": reversed_, "driven": _driven(case, recording, reaction_s)}
    rule = loop.stopped_by[0][1].rule if loop.stopped_by else "nothing"
    phases = " ".join(phase.name for _, phase, _ in loop.transitions)
    notes = "; ".join(finding.text for _, finding in loop.alarms)
    note = (
        f"n {line.n} span {truth.span} {case.speed_m_per_s:.2f} of {line.limits.speed_max_m_per_s:.2f} m/s J "
        f"{max(r.inertia_kg_m2.value for r in line.rollers):.1f} over {over:.2f} {phases} | {notes} "
        f"| at {begun.max():.2f}"
    )
    return Judged(case.number, rule, reaction_s, rest_s, possible_s, {k: c for k, c in counts.items() if c}, note)


def least_possible_s(case: Break, speed_m_per_s: FloatArray) -> float:
    """The least time in which every roller can rest: braking torque, power and friction of the true line."""
    rollers, drives = case.plant.rollers, case.line.drives
    worst_s = 0.0
    for i, speed in enumerate(speed_m_per_s.tolist()):
        radius, inertia, friction = (
            float(np.atleast_1d(np.asarray(values))[i])
            for values in (rollers.radius_m, rollers.inertia_kg_m2, rollers.friction_nms_per_rad)
        )
        torque, power = drives[i].braking_torque_nm or 0.0, drives[i].braking_power_w or 0.0
        v = np.linspace(RESTS * case.line.limits.speed_max_m_per_s, max(speed, 1e-9), 500)
        brake = np.minimum(torque, power * radius / v)
        rate = (radius * brake + friction * v) / inertia
        worst_s = max(worst_s, float(np.trapezoid(1.0 / rate, v)))
    return worst_s


def _driven(case: Break, recording: Any, reaction_s: float) -> int:
    """Rollers that were driven on after the way to the ramp: more torque with the motion than their friction takes."""
    limits = case.line.limits
    settled_s = case.at_s + reaction_s + 2.0 * limits.torque_nm / limits.torque_rate_nm_per_s
    settled_s += limits.torque_nm / case.line.moves.torque_off_rate_nm_per_s
    late = recording.time_s >= settled_s
    least_nm = 0.01 * limits.torque_nm
    rollers, speed = case.plant.rollers, recording.speed_m_per_s[late]
    friction_nm = np.array(rollers.friction_nms_per_rad) / np.array(rollers.radius_m) * np.abs(speed)
    turns = np.abs(speed) > RESTS * limits.speed_max_m_per_s
    driven = turns & (recording.torque_nm[late] * np.sign(speed) > 1.7 * friction_nm + least_nm)
    return int(driven.any(axis=0).sum())


def _line(
    n: int,
    fastest: float,
    tension_n: FloatArray,
    tension_min_n: float,
    tension_max_n: float,
    stiffness_n: float,
    length_m: FloatArray,
    radius_m: FloatArray,
    inertia_kg_m2: FloatArray,
    friction: FloatArray,
    torque_nm: float,
) -> Line:
    document = tomllib.loads(line_template(n))

    def parameter(name: str, value: float) -> dict[str, float]:
        return {"value": float(value), "tolerance": TOLERANCE[name]}

    document["limits"] |= {
        "torque_nm": torque_nm, "torque_rate_nm_per_s": torque_nm / 0.06, "tension_min_n": tension_min_n,
        "tension_max_n": tension_max_n, "tension_margin_n": 0.02 * tension_max_n, "speed_max_m_per_s": fastest,
        "tension_step_max_n": 0.0, "speed_step_max_m_per_s": 0.0, "tensioning_time_s": 60.0,
    }  # fmt: skip
    stop_rate = fastest / 12.0
    document["moves"] |= {
        "stop_rate_m_per_s2": stop_rate, "speed_rate_m_per_s2": 0.8 * stop_rate, "stop_time_s": 15.0,
        "torque_off_rate_nm_per_s": torque_nm / 0.3, "tension_rate_n_per_s": 0.05 * tension_max_n,
    }  # fmt: skip
    document["web"]["stiffness_n"] = parameter("stiffness_n", stiffness_n)
    for i, roller in enumerate(document["rollers"]):
        roller["radius_m"] = parameter("radius_m", radius_m[i])
        roller["inertia_kg_m2"] = parameter("inertia_kg_m2", inertia_kg_m2[i])
        roller["friction_nms_per_rad"] = parameter("friction_nms_per_rad", friction[i])
        document["spans"][i]["length_m"] = parameter("length_m", length_m[i])
        document["drives"][i]["rated_torque_nm"] = torque_nm
        document["load_cells"][i]["capacity_n"] = 1.5 * tension_max_n
    document["recipes"] = [{"name": "drawn", "tension_n": tension_n.tolist(), "speed_m_per_s": 0.9 * fastest}]
    return Line.model_validate(document)


def main() -> None:
    parser = ArgumentParser()
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    asked = parser.parse_args()
    found: list[Judged] = []
    for number in range(asked.first, asked.first + asked.draws):
        try:
            found.append(judge(draw(number)))
        except RuntimeError as error:
            print(f"{number}: {error}")
            continue
        last = found[-1]
        mark = "UNSAFE" if last.unsafe else "SLOW" if last.slow else ""
        print(
            f"{number}: {mark} reaction {1e3 * last.reaction_s:.0f} ms, rest {last.rest_s:.1f} s (possible "
            f"{last.possible_s:.1f}) {last.unsafe} {last.note}",
            flush=True,
        )
    for name in ("reaction_s", "rest_s"):
        values = np.array([getattr(one, name) for one in found])
        p50, p99 = np.percentile(values, (50, 99))
        print(f"{name}: p50 {p50:.3f} p99 {p99:.3f} worst {values.max():.3f} of {len(values)}")
    rules = {rule: sum(one.rule == rule for one in found) for rule in {one.rule for one in found}}
    print(f"unsafe {sum(bool(one.unsafe) for one in found)}, slow {sum(one.slow for one in found)}, found by {rules}")


if __name__ == "__main__":
    main()
