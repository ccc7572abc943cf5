"""One law hands over to another in a running, noisy closed loop: the torque does not jump, the tension stays near.

The plant is the nonlinear line, with parameters that no design knows. What is allowed in the tension comes on top of
what it does in the runs of either law alone with the same noise: in the middle of a transient a law that takes over
cannot know how much of the torque is the transient's and how much is needed for good.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.control.design import (
    DesignLimits,
    DesignTask,
    MpcWeights,
    design_lqg,
    design_lqi,
    design_lqr,
    design_mpc,
    design_pid,
    design_scheduled,
)  # fmt: skip
from gateway.control.law import Measured
from gateway.control.laws import make_law, untimed
from gateway.control.reference import MinimumJerk, Reference, Steady
from gateway.control.rollout import Course, Setup, limited, plants_of, rk4, simulate_slowly, start
from gateway.core.web_model import WebModel
from gateway.loop.setpoints import OnTheWay
from tests.unit.control_support import model

N, PERIOD_S, PERIODS = 3, 0.01, 350
CHANGE = 100  #: the period in which set-points or speed begin to change
LOOP = Setup(PERIOD_S, 0.01, 1, 60.0, 1000.0, 0.1, 1e-4, 1.6e-3)
DESIGNS = {
    "pid": design_pid,
    "lqr": design_lqr,
    "lqi": design_lqi,
    "lqg": design_lqg,
    "mpc": design_mpc,
    "mpc without disturbances": lambda task: design_mpc(task, MpcWeights(disturbance_nm_per_sqrt_s=0.0)),
    "scheduled lqi": lambda task: design_scheduled(task, design_lqi, [0.01, 0.05, 0.1]),
    "scheduled lqg": lambda task: design_scheduled(task, design_lqg, [0.01, 0.05, 0.1]),
}


@cache
def law(name: str, draw: tuple[int, ...] = (), copy: int = 0) -> Any:
    """A law of its own for each `copy`: MPC holds a solver."""
    limits = DesignLimits(60.0, 1000.0, 2.0, 60.0, 0.1)
    task = DesignTask(model(N), PERIOD_S, 0.01, np.full(N, 30.0), 0.05, draw, limits=limits)
    return make_law(untimed(DESIGNS[name](task)))


@dataclass(frozen=True)
class Case:
    """What is asked of the line, and how far the tension may leave what it does without a change of law, in N."""

    name: str
    last: int  #: period in which a law may change, from CHANGE on
    beyond_n: float

    def at(self, k: int) -> tuple[Reference, float]:
        tension = np.full(N, 30.0)
        if self.name == "minimum jerk":
            curve = MinimumJerk(np.append(tension, 0.02))
            curve.move(1, 44.0, 24.0, CHANGE * PERIOD_S)
            curve.move(N, 0.08, 0.1, CHANGE * PERIOD_S)
            now_s = k * PERIOD_S
            tension, unwind = curve.at(now_s)[0, :-1], float(curve.at(now_s)[0, -1])
            return (OnTheWay(tension, curve, now_s, 0.0) if curve.moving(now_s) else Steady(tension)), unwind
        if self.name == "step" and k >= CHANGE:
            tension[1] += 14.0
        return Steady(tension), 0.1 if self.name == "speed" and k >= CHANGE else 0.05


CASES = [Case("rest", 190, 1.5), Case("step", 170, 10.0), Case("speed", 170, 10.0), Case("minimum jerk", 190, 1.5)]


def plant(seed: int) -> WebModel:
    generator = np.random.default_rng(seed)

    def spread(value: float, share: float):
        return value * (1.0 + share * generator.uniform(-1.0, 1.0, N))

    return WebModel(
        float(spread(2400.0, 0.1)[0]), spread(1.0, 0.1), spread(0.04, 0.07), spread(0.95, 0.1), spread(10.0, 0.3)
    )  # fmt: skip


def run(laws: dict[int, Any], case: Case, theta: WebModel, seed: int, draw: tuple[int, ...] = (), look: Any = None):
    """Tensions, torques (k, n) of a loop in which each of `laws` takes over in its period.

    `look` is called in each with the period, the sample, the reference and the torque applied last.
    """
    generator = np.random.default_rng(seed)
    samples, moved = LOOP.draw(PERIODS, N)
    generator.shuffle(samples)
    generator.shuffle(moved)
    begin, unwind = case.at(0)
    (state,), (applied,) = start(plants_of([theta]), Course(begin.tension_n[None], np.array([unwind])))
    tensions, torques = np.empty((2, PERIODS, N))
    memory, running = None, None
    for k in range(PERIODS):
        reference, unwind = case.at(k)
        tensions[k], seen = state[:N], state + samples[k]
        measured = Measured(seen[:N].copy(), seen[N:].copy(), unwind)
        measured.tension_n[list(draw)] = np.nan
        if look:
            look(k, measured, reference, applied)
        if k in laws:
            running = laws[k]
            memory = running.engage(measured, reference, applied)
        decision = running.ask(memory, measured, reference)
        acting, applied = applied, limited(LOOP, decision.torque_nm, applied)
        memory = running.commit(memory, decision, applied)
        torques[k] = applied
        state = rk4(theta, state, acting, unwind, PERIOD_S)
        state[N:] += moved[k]
    return tensions, torques


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
@pytest.mark.parametrize("first", DESIGNS)
def test_every_law_begins_with_the_torque_that_every_other_ends_with(first, case):
    """Less than noise and motion change it by, and than the envelope lets through: nothing at all."""
    instants = np.random.default_rng(5).integers(CHANGE, case.last, 3).tolist()
    asked = []

    def look(k, measured, reference, applied):
        for second in DESIGNS if k in instants else ():
            taking = law(second, copy=1)
            decision = taking.ask(taking.engage(measured, reference, applied), measured, reference)
            asked.append(np.abs(decision.torque_nm - applied).max())

    run({0: law(first)}, case, plant(1), 1, look=look)
    assert len(asked) == len(set(instants)) * len(DESIGNS) and max(asked) < 1e-6


laws = st.sampled_from(sorted(DESIGNS))


@pytest.mark.slow
@settings(max_examples=30, derandomize=True)
@given(laws, laws, st.sampled_from(CASES), st.floats(0.0, 1.0), st.integers(0, 10_000), st.sampled_from([(), (1,)]))
def test_any_law_takes_over_from_any_other(first, second, case, instant, seed, draw):
    a, b = law(first, draw), law(second, draw)
    k = CHANGE + round(instant * (case.last - CHANGE))
    theta = plant(seed)
    tension, torque = run({0: a, k: b}, case, theta, seed, draw)
    alone = [run({0: one}, case, theta, seed, draw) for one in (a, b)]
    assert (torque[:k] == alone[0][1][:k]).all()
    assert np.abs(torque[k] - torque[k - 1]).max() < 1e-6
    if not second.startswith("mpc"):  # which goes for what is left as fast as the envelope lets it
        changes = [np.abs(np.diff(u[k - 1 : k + 50], axis=0)).max() for u in (torque, alone[0][1], alone[1][1])]
        assert changes[0] <= 1.5 * max(changes[1:])
    least = np.min([t[k:].min(axis=0) for t, _ in alone], axis=0)
    most = np.max([t[k:].max(axis=0) for t, _ in alone], axis=0)
    spans = [i for i in range(N) if i not in draw]
    beyond = np.maximum(tension[k:] - most, least - tension[k:])[:, spans].max()
    assert beyond <= case.beyond_n
    if second != "mpc without disturbances":  # which keeps what it has taken for a disturbance
        assert np.abs(tension[-30:] - alone[1][0][-30:])[:, spans].max() < 0.3


@pytest.mark.parametrize("after", [2, 4, 10, 20])
def test_what_is_never_corrected_is_not_taken_from_a_transient(after):
    """The torque of a step is no disturbance: an observer that keeps what it took would hold the line off for good."""
    step, theta, k, mpc = CASES[1], plant(3), CHANGE + after, "mpc without disturbances"
    taken, alone = (run(laws, step, theta, 3)[0] for laws in ({0: law("lqi"), k: law(mpc)}, {0: law(mpc)}))
    assert np.abs(taken[-50:] - alone[-50:]).max() < 3.0


@pytest.mark.parametrize("design", [design_pid, design_lqr, design_lqi, design_lqg])
@pytest.mark.parametrize("top_m_per_s", [0.1, 10.0])
def test_gains_that_follow_the_speed_move_the_torque_no_more_than_gains_that_stay(design, top_m_per_s):
    """From standstill to the greatest speed and back, in a closed loop with noise; at 10 m/s gains halve on the way."""
    fast = top_m_per_s > 1.0
    believed = model(N, length=0.5, friction=0.02) if fast else model(N)
    truth = model(N, length=0.55, friction=0.025, stiffness=2200.0) if fast else model(N, 2200.0, 1.1, 0.038, 1.0, 12.0)
    task = DesignTask(believed, PERIOD_S, 0.01, np.full(N, 30.0), 0.5 * top_m_per_s)
    config = design_scheduled(task, design, [0.0, 0.25 * top_m_per_s, 0.5 * top_m_per_s, top_m_per_s])
    there = top_m_per_s * np.linspace(0.0, 1.0, 400)
    course = Course(np.full((1000, N), 30.0), np.concatenate((there, np.full(200, top_m_per_s), there[::-1])))
    loop = Setup(PERIOD_S, 0.01, 1, 200.0, 1e4, 0.1, 1e-4, 1.6e-3, seed=4)
    found, *stay = (
        simulate_slowly(one, plants_of([truth]), course, loop) for one in (config, config.laws[0], config.laws[-1])
    )
    assert found.torque_step_max_nm.max() <= 1.1 * max(one.torque_step_max_nm.max() for one in stay)
    most, least = (max(one.tension_max_n.max() for one in stay), min(one.tension_min_n.min() for one in stay))
    assert least - 0.5 <= found.tension_min_n.min() and found.tension_max_n.max() <= most + 0.5
