"""Laws over a range of speeds: what is refused, what is in between, and that nothing jumps on the way."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.control.design import (
    DesignLimits,
    DesignRefused,
    DesignTask,
    design_lqg,
    design_lqi,
    design_lqr,
    design_mpc,
    design_pid,
    design_scheduled,
    gains_change,
    margins,
)  # fmt: skip
from gateway.control.law import Measured
from gateway.control.laws import make_law, untimed
from gateway.control.reference import Steady
from gateway.control.rollout import Course, Setup, plants_of, simulate, simulate_slowly
from gateway.control.scheduled import STEPS, SpeedGrid
from gateway.core.controller import ControllerRefused, canonical, config_hash, parse_controller
from gateway.core.controller_schedule import law_at, parts
from gateway.core.web_model import reference_speeds
from tests.unit.control_support import model

LINEAR = [design_pid, design_lqr, design_lqi, design_lqg]
NODES = [0.0, 5.0, 10.0]
N = 3


def fast(n=N, draw=(), **changes):
    """Short spans at up to 10 m/s: what a web carries along matters, and gains halve over the range."""
    return DesignTask(model(n, length=0.5, friction=0.02), 0.01, 0.01, np.full(n, 30.0), 5.0, draw, **changes)


def document(nodes=NODES) -> dict[str, Any]:
    return json.loads(canonical(design_scheduled(fast(2), design_lqi, nodes)))


@pytest.mark.parametrize("design", LINEAR)
def test_schedules_survive_the_round_trip(design):
    config = design_scheduled(fast(), design, NODES)
    again = parse_controller(canonical(config))
    assert again == config and config_hash(again) == config_hash(config) and untimed(again) is again
    assert [law.kind for law in again.laws] == [config.laws[0].kind] * 3


def _set(*path_and_value):
    *path, value = path_and_value

    def change(data):
        for key in path[:-1]:
            data = data[key]
        data[path[-1]] = value

    return change


def _other(design, **changes):
    def change(data):
        data["laws"][1] = json.loads(canonical(design(replace(fast(2), **changes))))

    return change


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_set("speed_m_per_s", [0.0, 5.0, 5.0]), "allowed: 2 or more speeds from 0 up, strictly ascending"),
        (_set("speed_m_per_s", [5.0]), "2 or more"),
        (_set("speed_m_per_s", [-1.0, 5.0, 10.0]), "from 0 up"),
        (_set("speed_m_per_s", [0.0, 5.0]), "3 laws for 2 speeds"),
        (_other(design_pid), "of the kinds lqi, pid; allowed: one kind"),
        (
            _other(design_mpc),
            r"laws\.1: .* kind mpc: its programme .* belong to one model; allowed: pid, lqr, lqi, lqg",
        ),
        (_set("laws", 1, {"kind": "scheduled"}), "kind scheduled: a schedule of schedules"),
        (_set("laws", 1, "kind", "lqx"), "lqx"),
        (_other(design_lqi, period_s=0.02), r"laws\[1\].period_s is 0.02, the schedule's is 0.01"),
        (_other(design_lqi, latency_s=0.004), r"laws\[1\].latency_s is 0.004"),
        (_other(design_lqi, draw_spans=(1,)), r"laws\[1\].draw_spans is \[1\]"),
        (_other(design_lqi, model=model(2)), r"laws\[1\].feedforward"),
        (_set("laws", 1, "gain_input", [[], []]), r"laws\[1\].gain_input is \(2, 0\), in laws\[0\] it is \(2, 2\)"),
        (_set("speed", 1.0), "Extra inputs"),
    ],
)
def test_what_is_no_schedule_is_refused_with_what_is_allowed(change, says):
    data = document()
    change(data)
    with pytest.raises(ControllerRefused, match=says):
        parse_controller(json.dumps(data).encode())


def test_predictors_of_unequal_depth_are_refused():
    data = json.loads(canonical(design_scheduled(fast(2), design_lqg, NODES)))
    late = json.loads(canonical(design_lqg(replace(fast(2), latency_s=0.02))))
    data["laws"][2] = late | {"latency_s": 0.01}
    with pytest.raises(ControllerRefused, match=r"laws\[2\]\.predictor\.inputs is \(3, 4, 2\), in laws\[0\]"):
        parse_controller(json.dumps(data).encode())


@pytest.mark.parametrize("design", LINEAR)
def test_numbers_go_linearly_from_node_to_node_and_stay_at_the_ends(design):
    config = design_scheduled(fast(), design, NODES)
    for node, law in zip(NODES, config.laws, strict=True):
        assert law_at(config, node) == law
    assert law_at(config, -1.0) == config.laws[0] and law_at(config, 20.0) == config.laws[2]
    found, low, high = (parts(law) for law in (law_at(config, 2.0), config.laws[0], config.laws[1]))
    assert found.keys() == low.keys()
    for name, value in found.items():
        assert np.allclose(value, 0.6 * low[name] + 0.4 * high[name], rtol=1e-12, atol=1e-12), name
    parse_controller(canonical(law_at(config, 2.0)))


@given(st.lists(st.floats(0.0, 20.0), min_size=2, max_size=6, unique=True))
def test_the_grid_has_every_node_and_is_fine(speeds):
    nodes = sorted(speeds)
    if min(np.diff(nodes)) < 1e-6:
        return
    config = design_scheduled(fast(1), design_pid, nodes)
    grid = SpeedGrid(config).speeds_m_per_s
    assert set(nodes) <= set(grid) and len(grid) <= STEPS + 1 + len(nodes)
    assert (np.diff(grid) > 0.0).all() and np.diff(grid).max() <= (nodes[-1] - nodes[0]) / STEPS * (1.0 + 1e-6)


@given(st.floats(0.0, 10.0), st.floats(-1.0, 11.0))
def test_noise_of_the_speed_does_not_move_it_to_and_fro(begin, end):
    grid = SpeedGrid(design_scheduled(fast(1), design_pid, NODES))
    points = np.array(grid.speeds_m_per_s)
    step = 10.0 / STEPS
    at = grid.course([begin])[0]
    assert abs(points[at] - begin) <= 0.5 * step + 1e-9
    then = grid.following(at, end)
    assert abs(points[then] - np.clip(end, 0.0, 10.0)) <= 0.75 * step + 1e-9
    noise = 0.12 * step * (-1.0) ** np.arange(50)
    assert len(set(grid.course((end + noise).tolist())[1:])) == 1


@pytest.mark.parametrize("design", LINEAR)
def test_at_one_speed_it_is_the_law_of_that_speed(design):
    task = fast()
    setup = Setup(0.01, 0.01, 1, 200.0, 1e4, 0.1, 1e-4, 1.6e-3, seed=1)
    course = Course(np.full((200, N), 30.0), np.full(200, 5.0))
    plants = plants_of([model(N, length=0.6, friction=0.03)])
    config = design_scheduled(task, design, NODES)
    alone, both = (simulate_slowly(c, plants, course, setup, record=True) for c in (config.laws[1], config))
    assert (alone.torque_nm == both.torque_nm).all()


@pytest.mark.parametrize("design", LINEAR)
@pytest.mark.parametrize("draw", [(), (1,)])
def test_the_kernel_does_what_a_schedule_does(design, draw):
    config = design_scheduled(fast(draw=draw), design, [0.5, 4.0, 10.0])
    tension = np.full((300, N), 30.0)
    tension[150:, 0] += 5.0
    course = Course(tension, np.concatenate((np.full(30, 0.2), np.linspace(0.2, 11.0, 200), np.full(70, 7.0))), 150)
    setup = Setup(0.01, 0.01, 4, 200.0, 1e4, 0.1, 1e-4, 1.6e-3, seed=3)
    plants = plants_of([model(N, length=s * 0.5, friction=0.02) for s in (0.9, 1.0, 1.1)])
    fast_found, slow = (run(config, plants, course, setup, record=True) for run in (simulate, simulate_slowly))
    assert np.allclose(fast_found.tension_n, slow.tension_n, rtol=1e-9, atol=1e-9)
    assert np.allclose(fast_found.torque_nm, slow.torque_nm, rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("design", LINEAR)
def test_a_change_of_gains_is_no_jump(design):
    """Through the whole range in 3 s with noise: what a switch adds is the gains' change times the deviations."""
    task = fast()
    config = design_scheduled(task, design, NODES)
    law: Any = make_law(config)
    grid, generator = SpeedGrid(config), np.random.default_rng(0)
    speeds = np.linspace(0.0, 10.0, 300)
    setpoint, theta = Steady(np.full(N, 30.0)), task.model
    most_of_switches, most_of_periods, switches = 0.0, 0.0, 0
    state, before = None, np.zeros(N)
    for unwind in speeds.tolist():
        speed = reference_speeds(theta, setpoint.tension_n, unwind) + 1e-3 * generator.standard_normal(N)
        measured = Measured(30.0 + 0.5 * generator.standard_normal(N), speed, unwind)
        state = law.engage(measured, setpoint, before) if state is None else state
        decision = law.ask(state, measured, setpoint)
        if decision.at != state.at:
            switches += 1
            kept = make_law(grid.laws[state.at]).ask(state.inner, measured, setpoint)
            jump = decision.torque_nm - kept.torque_nm
            if design in (design_lqr, design_lqi):  # - (K' - K) deviations; the integral has no part in it
                after, first = (parts(grid.laws[at]) for at in (decision.at, state.at))
                x = np.concatenate((kept.errors.tension_n, kept.errors.speed_m_per_s))
                by_state = (after["gain_state"] - first["gain_state"]) @ x
                by_input = (after["gain_input"] - first["gain_input"]) @ (before - kept.errors.torque_nm)
                assert np.allclose(jump, -by_state - by_input, rtol=1e-6, atol=1e-9)
            most_of_switches = max(most_of_switches, float(np.abs(jump).max()))
        most_of_periods = max(most_of_periods, float(np.abs(decision.torque_nm - before).max()))
        before = decision.torque_nm
        state = law.commit(state, decision, before)
    assert switches >= STEPS
    assert most_of_switches <= 0.05 * most_of_periods


@settings(max_examples=20)
@given(st.integers(0, 1000))
def test_integral_in_torque_is_the_integral_in_newton_seconds(seed):
    """u = u_ref - K_x x~ - K_u u~ - K_i q with back-calculation through the inverse of K_i, written out once more."""
    generator = np.random.default_rng(seed)
    config = design_lqi(fast(limits=DesignLimits()))
    law, setpoint, h = make_law(config), Steady(np.full(N, 30.0)), config.period_s
    k_x, k_u, k_i = (np.array(m) for m in (config.gain_state, config.gain_input, config.gain_integral))
    measured = Measured(generator.uniform(25.0, 35.0, N), np.full(N, 5.0), 5.0)
    applied = generator.uniform(-5.0, 5.0, N)
    state, sent, q = law.engage(measured, setpoint, applied), applied, None
    for _ in range(50):
        decision = law.ask(state, measured, setpoint)
        errors = decision.errors
        x = np.concatenate((errors.tension_n, errors.speed_m_per_s))
        base = errors.torque_nm - k_x @ x - k_u @ (sent - errors.torque_nm)
        q = np.linalg.solve(k_i, base - applied) if q is None else q
        asked = base - k_i @ q
        assert np.allclose(decision.torque_nm, asked, atol=1e-7)
        given_nm = np.clip(asked, -6.0, 6.0)
        q = q + h * errors.controlled + config.antiwindup * np.linalg.solve(k_i, asked - given_nm)
        state, sent = law.commit(state, decision, given_nm), given_nm
        measured = Measured(generator.uniform(25.0, 35.0, N), np.full(N, 5.0) + generator.uniform(-0.01, 0.01, N), 5.0)


def test_margins_are_the_worst_over_the_nodes_and_between():
    task = fast()
    config = design_scheduled(task, design_lqi, NODES)
    found = margins(config, task)
    speeds = [0.0, 2.5, 5.0, 7.5, 10.0]
    each = [margins(law_at(config, v), replace(task, unwind_speed_m_per_s=v)) for v in speeds]
    assert found.delay_margin_s == min(m.delay_margin_s for m in each) > 0.0
    assert found.chatter_nm == max(m.chatter_nm for m in each)
    assert found.noise_floor_n == max(m.noise_floor_n for m in each)
    assert found.decay_per_s == min(m.decay_per_s for m in each)
    assert found.spectral_radius == max(m.spectral_radius for m in each)
    assert len({m.chatter_nm for m in each}) == 5


def test_a_schedule_stands_more_delay_than_one_law_for_all_speeds():
    """At 20 m/s, where it pays."""
    task = replace(fast(), unwind_speed_m_per_s=10.0)
    one, config = design_lqi(task), design_scheduled(task, design_lqi, [0.0, 5.0, 10.0, 20.0])
    worst = min(margins(one, replace(task, unwind_speed_m_per_s=v)).delay_margin_s for v in config.speed_m_per_s)
    assert margins(config, task).delay_margin_s >= worst + 0.004


def test_designs_refuse_with_the_speed():
    with pytest.raises(DesignRefused, match=r"at 0\.1 m/s: roller 1 needs .* Nm to keep 0\.1 m/s"):
        slow = DesignTask(
            model(N), 0.01, 0.01, np.full(N, 30.0), 0.01, limits=DesignLimits(10.0, speed_max_m_per_s=0.03)
        )
        design_scheduled(slow, design_lqi, [0.0, 0.01, 0.1])
    with pytest.raises(DesignRefused, match="mpc has no schedule: .*; allowed: pid, lqr, lqi, lqg"):
        design_scheduled(fast(), design_mpc, NODES)
    for speeds in ([], [1.0], [0.0, float("nan")], [1.0, 0.0], [0.0, float("inf")]):
        with pytest.raises(DesignRefused, match="2 or more speeds from 0 up"):
            design_scheduled(fast(), design_lqi, speeds)


def test_how_much_gains_change():
    slow = DesignTask(model(N), 0.01, 0.01, np.full(N, 30.0), 0.05)
    assert max(gains_change(design_scheduled(slow, design_pid, [0.0, 0.1])).values()) == 0.0
    little = gains_change(design_scheduled(slow, design_lqi, [0.0, 0.1]))
    much = gains_change(design_scheduled(fast(), design_lqi, NODES))
    assert 0.0 < max(little.values()) < 0.01 and 0.3 < max(much.values()) < 1.0
    assert {"gain_state on tension", "gain_state on speed", "gain_input", "gain_integral"} <= much.keys()
    config = design_scheduled(fast(), design_lqi, NODES)
    first, last = (np.array(law.gain_integral) for law in (config.laws[0], config.laws[2]))
    norms = [np.linalg.norm(law.gain_integral) for law in config.laws]
    assert much["gain_integral"] == pytest.approx(np.linalg.norm(first - last) / max(norms))
