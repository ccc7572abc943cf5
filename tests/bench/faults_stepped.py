"""Faults that take long and have nothing to do with a wire, in stepped time: the whole cycle over a link in memory."""

from random import Random

from gateway.cli.stepped import SteppedLoop
from gateway.core.doubts import Doubt
from gateway.core.messages import SetSpeed
from gateway.core.states import LoopState
from sim_plant.faults.parse import parse_fault
from sim_plant.faults.stepped import injector_of
from tests.bench.faults_seen import Injection
from tests.closed_loop.conftest import start, stepped

REFERENCE_PERIODS = 2000  #: after the last set-point, until the balance of torques is known
DRIFT_BOUND_S = 60.0
SATURATION_BOUND_S = 2.01


def drift(number: int) -> Injection:
    """A load cell that drifts by 0.1 N/s must be named."""
    dice = Random(f"cell-drift/{number}")
    span, rate = dice.randint(1, 6), dice.choice((-0.1, 0.1))
    loop = start(stepped(seed=1 + number))
    loop.step(REFERENCE_PERIODS + dice.randrange(500))
    fault = f"load-cell {span} drift rate_n_per_s={rate}"
    before, begin_s = len(loop.alarms), _inject(loop, fault)
    while loop.now_s - begin_s < 1.5 * DRIFT_BOUND_S and len(loop.alarms) == before:
        loop.step()
    told = loop.alarms[before:]
    named = any(f"load-cell-{span} " in finding.text for _, finding in told)
    at_s = told[0][0] - begin_s if told else None
    return _injection(loop, "cell-drift", named and not before, at_s, f"{fault}: {[f.text for _, f in loop.alarms]}")


def saturation(number: int) -> Injection:
    """A bearing that gets stiff, so that its roller's drive is at its limit; timed from the first torque there.

    The count is net of the periods away from the limit: noise that lets go of it now and then only puts it off.
    """
    dice = Random(f"saturation/{number}")
    loop = start(stepped(seed=1 + number))
    assert loop.command(SetSpeed(speed_m_per_s=0.12)).ok
    loop.step(1000 + dice.randrange(100))
    friction, radius = loop.plant.rollers.friction_nms_per_rad, loop.plant.rollers.radius_m
    assert isinstance(friction, float) and isinstance(radius, float), "S_real has the same rollers everywhere"
    roller = dice.randint(1, 6)
    at_limit = loop.line.limits.torque_nm / (friction / radius * 0.12)
    fault = f"web {roller} friction-rise factor={at_limit + dice.uniform(0.005, 0.02):.4f}"
    begin_s = _inject(loop, fault)
    saturated_s = None
    while loop.now_s - begin_s < 8.0 and loop.cycle.machine.state is LoopState.RUN and not loop.cycle.watch.doubts:
        loop.step()
        if not loop.recorded()[-1].saturated:
            saturated_s = None
        elif saturated_s is None:
            saturated_s = loop.now_s
    blocked = loop.cycle.watch.doubts == Doubt.SATURATED
    at_s = loop.now_s - saturated_s if blocked and saturated_s is not None else None
    return _injection(loop, "saturation", blocked, at_s, f"{fault}: {loop.cycle.machine.reason}")


def _inject(loop: SteppedLoop, fault: str) -> float:
    injector_of(loop.truth).add(parse_fault(fault), loop.truth.world.now_s)
    return loop.now_s


def _injection(loop: SteppedLoop, row: str, flagged: bool, at_s: float | None, note: str) -> Injection:
    unsafe = {kind: count for kind, count in loop.truth.recorder.unsafe_events.items() if count}
    return Injection(row, row, "flag" if flagged else "nothing", at_s, at_s, None, unsafe, note)
