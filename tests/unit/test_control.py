"""Design and control laws against independent judges: python-control, a direct simulation, and the equations."""

import json

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from gateway.control.design import DesignTask, LqiWeights, design_lqi, design_pid
from gateway.control.design.sampling import sampled
from gateway.control.law import Measured
from gateway.control.laws import make_law
from gateway.control.reference import Steady
from gateway.core.controller import ControllerRefused, canonical, config_hash, parse_controller
from gateway.core.web_model import WebModel, equilibrium_torque, linearise, reference_speeds


def model(n=6, stiffness=2400.0, length=1.0, radius=0.04, inertia=0.95, friction=10.0):
    ones = np.ones(n)
    return WebModel(stiffness, length * ones, radius * ones, inertia * ones, friction * ones)


def task(n=6, draw=(), period_s=0.01, latency_s=0.01, **parameters):
    return DesignTask(model(n, **parameters), period_s, latency_s, np.full(n, 30.0), 0.05, draw)


def derivative(theta: WebModel, state, torque, unwind):
    """The paper's two equations, written out once more."""
    n = theta.n
    tension = np.concatenate(([theta.tension_before_n], state[:n], [theta.tension_after_n]))
    speed = np.concatenate(([unwind], state[n:]))
    rate = []
    for i in range(1, n + 1):
        stretch = theta.stiffness_n * (speed[i] - speed[i - 1])
        carried = tension[i - 1] * speed[i - 1] - tension[i] * speed[i]
        rate.append((stretch + carried) / theta.length_m[i - 1])
    for i in range(1, n + 1):
        r, j, f = theta.radius_m[i - 1], theta.inertia_kg_m2[i - 1], theta.friction_nms_per_rad[i - 1]
        rate.append((r * r * (tension[i + 1] - tension[i]) - f * speed[i] + r * torque[i - 1]) / j)
    return np.array(rate)


parameters = st.fixed_dictionaries(
    {
        "stiffness": st.floats(1900, 2900),
        "length": st.floats(0.8, 1.2),
        "radius": st.floats(0.034, 0.046),
        "inertia": st.floats(0.76, 1.14),
        "friction": st.floats(5, 15),
    }
)


@given(parameters, st.integers(1, 12), st.floats(0.0, 0.1))
def test_reference_speeds_and_torques_are_an_equilibrium(values, n, unwind):
    theta = model(n, **values)
    tension = np.linspace(20.0, 44.0, n)
    speed = reference_speeds(theta, tension, unwind)
    torque = equilibrium_torque(theta, tension, speed)
    assert np.abs(derivative(theta, np.concatenate((tension, speed)), torque, unwind)).max() < 1e-9


@pytest.mark.parametrize("design", [design_lqi, design_pid])
def test_set_points_that_move_in_place_move_the_equilibrium(design):
    """What belongs to the set-points is kept from period to period."""
    setpoint, none = np.array([28.0, 36.0, 20.0]), np.zeros(3)
    kept = make_law(design(task(3)))
    for moved_n in (0.0, 5.0, 0.0, -5.0):
        setpoint[1] = 36.0 + moved_n
        measured = Measured(np.array([28.5, 35.0, 20.0]), np.array([0.05, 0.051, 0.049]), 0.05)
        anew = make_law(design(task(3)))
        asked = [
            law.ask(law.engage(measured, Steady(setpoint), none), measured, Steady(setpoint)) for law in (kept, anew)
        ]
        assert (asked[0].torque_nm == asked[1].torque_nm).all()
        assert (asked[0].errors.tension_n == measured.tension_n - setpoint).all()


def test_linearisation_is_the_derivative_of_the_equations():
    theta = model()
    tension, unwind = np.array([28.0, 36, 20, 40, 24, 32]), 0.05
    speed = reference_speeds(theta, tension, unwind)
    A, B = linearise(theta, tension, speed, unwind)
    state, torque = np.concatenate((tension, speed)), equilibrium_torque(theta, tension, speed)
    for k in range(12):
        step = np.zeros(12)
        step[k] = 1e-4
        both = [derivative(theta, state + s * step, torque, unwind) for s in (1, -1)]
        assert np.allclose(A[:, k], (both[0] - both[1]) / 2e-4, rtol=1e-6, atol=1e-6)
    assert np.allclose(B[6:], np.diag(theta.radius_m / theta.inertia_kg_m2)) and not B[:6].any()


def test_zero_order_hold_is_that_of_python_control():
    A, B = linearise(model(3), np.full(3, 30.0), np.full(3, 0.05), 0.05)
    mine = sampled(A, B, 0.01)
    theirs = control.c2d(control.ss(A, B, np.eye(6), np.zeros((6, 3))), 0.01)
    assert np.allclose(mine[0], theirs.A, atol=1e-12) and np.allclose(mine[1], theirs.B, atol=1e-12)


def test_lqi_gain_is_that_of_python_control():
    """Built anew here: [x; u_{k-1}; q] with one period of latency, solved by another library's dlqr."""
    weights, h, n = LqiWeights(), 0.01, 3
    config = design_lqi(task(n))
    speed = reference_speeds(model(n), np.full(n, 30.0), 0.05)
    A, B = linearise(model(n), np.full(n, 30.0), speed, 0.05)
    step = control.c2d(control.ss(A, B, np.eye(2 * n), np.zeros((2 * n, n))), h)
    F = np.block(
        [
            [step.A, step.B, np.zeros((2 * n, n))],
            [np.zeros((n, 4 * n))],
            [h * np.eye(n), np.zeros((n, 2 * n)), np.eye(n)],
        ]
    )
    G = np.vstack((np.zeros((2 * n, n)), np.eye(n), np.zeros((n, n))))
    cost = np.repeat([weights.tension_per_n2, weights.speed_per_m2_s2, 0.0, weights.integral_per_n2s2], n)
    gain, _, poles = control.dlqr(F, G, np.diag(cost), weights.torque_per_nm2 * np.eye(n))
    mine = np.hstack((config.gain_state, config.gain_input, config.gain_integral))
    assert np.allclose(mine, gain, rtol=1e-5, atol=1e-5 * np.abs(gain).max())
    assert np.abs(poles).max() < 1.0


def run(config, theta, unwind=0.05, seconds=4.0, latency_steps=1, start_error=2.0):
    """The law on the nonlinear equations (scipy), sampled at its period, noise off; returns tensions (k, n)."""
    law, n, h = make_law(config), theta.n, config.period_s
    setpoint = np.full(n, 30.0)
    speed = reference_speeds(theta, setpoint, unwind)
    torque = equilibrium_torque(theta, setpoint, speed)
    state = np.concatenate((setpoint + start_error, speed))
    in_flight = [torque] * latency_steps
    measured = Measured(state[:n].copy(), state[n:].copy(), unwind)
    law_state, rows = law.engage(measured, Steady(setpoint), torque), []
    for _ in range(round(seconds / h)):
        measured = Measured(state[:n].copy(), state[n:].copy(), unwind)
        for i in config.draw_spans:
            measured.tension_n[i] = np.nan
        decision = law.ask(law_state, measured, Steady(setpoint))
        law_state = law.commit(law_state, decision, decision.torque_nm)
        in_flight.append(decision.torque_nm)
        u = in_flight.pop(0)
        state = solve_ivp(lambda _t, x, u=u: derivative(theta, x, u, unwind), (0, h), state, rtol=1e-7).y[:, -1]
        rows.append(state[:n])
    return np.array(rows)


@pytest.mark.parametrize("design", [design_lqi, design_pid])
def test_closed_loop_on_a_wrong_model_settles_at_the_setpoints(design):
    truth = model(3, stiffness=2200, length=1.2, radius=0.035, inertia=1.0, friction=15)
    tension = run(design(task(3)), truth, seconds=6.0)
    assert np.abs(tension[-50:] - 30.0).max() < 0.1


@pytest.mark.parametrize("design", [design_lqi, design_pid])
def test_a_draw_span_needs_no_load_cell_and_its_neighbours_settle(design):
    tension = run(design(task(3, draw=(1,))), model(3), seconds=6.0)
    assert np.abs(tension[-50:][:, [0, 2]] - 30.0).max() < 0.2
    assert np.isfinite(tension).all() and np.abs(tension[:, 1] - 30.0).max() < 10.0


@pytest.mark.parametrize(("latency_s", "depth"), [(0.0, 0), (0.004, 1), (0.01, 1), (0.015, 2), (0.02, 2)])
def test_dead_time_becomes_torques_in_flight(latency_s, depth):
    config = design_lqi(task(2, latency_s=latency_s))
    assert np.shape(config.gain_input) == (2, 2 * depth)
    if latency_s in (0.0, 0.01, 0.02):
        tension = run(config, model(2), latency_steps=depth)
        assert np.abs(tension[-20:] - 30.0).max() < 0.05


@settings(max_examples=30)
@given(parameters, st.sampled_from([design_lqi, design_pid]), st.floats(-20, 20), st.data())
def test_engaging_is_bumpless_and_saturation_does_not_wind_up(values, design, start, data):
    config = design(task(3, **values))
    law = make_law(config)
    measured = Measured(np.array(data.draw(st.lists(st.floats(0, 60), min_size=3, max_size=3))), np.full(3, 0.05), 0.05)
    setpoint, applied = Steady(np.full(3, 30.0)), np.full(3, start)
    state = law.engage(measured, setpoint, applied)
    first = law.ask(state, measured, setpoint)
    assert np.allclose(first.torque_nm, applied, atol=1e-6)
    asked = []
    for k in range(2001):  # 20 s against a stop: nothing moves whatever is asked
        decision = law.ask(state, measured, setpoint)
        if k in (500, 2000):
            asked.append(decision.torque_nm)
        state = law.commit(state, decision, applied)
    # What it asks for is bounded by the errors there are, not by how long they have been there.
    assert np.allclose(asked[0], asked[1], rtol=1e-3, atol=1e-3)
    error = np.abs(measured.tension_n - 30.0).max()
    assert np.abs(asked[1] - applied).max() < 30.0 * (1.0 + error)


def test_configurations_survive_the_round_trip_and_hash_their_content():
    config = design_lqi(task(2))
    again = parse_controller(canonical(config))
    assert again == config and config_hash(again) == config_hash(config)
    other = config.model_copy(update={"antiwindup": 0.5})
    assert config_hash(other) != config_hash(config)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (b'"kind":"lqi"', b'"kind":"lqx"'),
        (b'"period_s":0.01', b'"period_s":NaN'),
        (b'"period_s":0.01', b'"period_s":true'),
        (b'"antiwindup":0.4', b'"antiwindup":0.4,"gain":1'),
    ],
)
def test_configurations_that_must_not_run_are_refused(change, reason):
    payload = canonical(design_lqi(task(2)))
    assert change in payload
    with pytest.raises(ControllerRefused):
        parse_controller(payload.replace(change, reason))


def test_a_gain_of_the_wrong_shape_names_both_shapes():
    config = design_lqi(task(2)).model_dump()
    config["gain_integral"] = [[1.0, 0.0]]

    with pytest.raises(ControllerRefused, match=r"gain_integral is \(1, 2\), for 2 spans it must be \(2, 2\)"):
        parse_controller(json.dumps(config).encode())
