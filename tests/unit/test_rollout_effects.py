"""Effects of real plants in rollouts: the kernel against the laws, both against what can be worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.control.design import DesignTask, design_lqg, design_lqi, design_mpc, design_pid
from gateway.control.laws import make_law
from gateway.control.mpc_linear import fallback, unconstrained
from gateway.control.rollout import (
    Course,
    Effects,
    Setup,
    course_through,
    no_effects,
    plants_of,
    plants_of_thetas,
    rate,
    simulate,
    simulate_slowly,
    start,
    with_effects,
)
from gateway.control.rollout_compiled_line import CompiledLine
from gateway.control.rollout_line import RealLine
from gateway.control.rollout_slow import plain_line, run_plant
from gateway.core.controller_schedule import ScheduledConfig
from gateway.core.metrics import overshoot_pct, settling_time_s
from gateway.core.theta import Theta
from gateway.core.web_model import linearise, reference_speeds
from sim_plant.world import World
from tests.unit.control_support import model
from tests.unit.sim_effects_support import plant as truth
from tests.unit.test_rollout import LINEAR, random_plants, task

QUIET = Setup(0.01, 0.01, 5, 60.0, 1000.0)
NOISY = replace(QUIET, tension_noise_n=0.1, speed_noise_m_per_s=1e-4, acceleration_m_per_s1_5=1.6e-3, seed=3)


def real(plants, lag_s=0.005, coulomb_nm=2.0, share=0.005, latency_s=None, seed=0):
    """Effects of up to this size, every roller and plant with its own; the second plant has no lag."""
    generator, shape = np.random.default_rng(seed), (plants.count, plants.n)
    lags_s = lag_s * generator.uniform(0.2, 1.0, plants.count) * (np.arange(plants.count) != 1)
    return with_effects(
        plants,
        Effects(
            lags_s,
            coulomb_nm * generator.uniform(0.0, 1.0, shape),
            share * generator.uniform(0.0, 1.0, shape),
            generator.uniform(0.0, 6.3, shape),
            latency_s,
        ),
    )


def picked(plants, rows):
    """Some of the plants: laws themselves take a thousand times as long."""
    values = {name: value[rows] for name, value in vars(plants).items() if name != "effects"}
    effects = plants.effects
    if effects is not None:
        effects = Effects(**{name: None if value is None else value[rows] for name, value in vars(effects).items()})
    return replace(plants, **values, effects=effects)


def several_changes(n=6, tail_s=0.4):
    base, stepped = np.full(n, 30.0), 30.0 + 14.0 * (np.arange(n) == n // 2)
    parts = [(0.1, base, 0.01), (0.6, stepped, 0.01), (0.5, stepped, 0.05), (0.8, base, 0.01)]
    return course_through(0.01, parts, tail_s)


def assert_alike(fast, slow, rows=slice(None), rtol=1e-9):
    """All figures and recordings, of some `rows` of the first."""
    for name in vars(slow):
        a, b = getattr(fast, name)[rows], getattr(slow, name)
        if name == "settled":  # a sample on the edge of the band may fall on either side
            assert (a == b).mean() > 0.95
        else:
            assert np.allclose(a, b, rtol=rtol, atol=1e-9, equal_nan=True), (name, np.abs(a - b).max())


def scheduled(task: DesignTask):
    slow, fast = (design_lqi(replace(task, unwind_speed_m_per_s=v)) for v in (0.01, 0.1))
    shared = {name: getattr(slow, name) for name in ("period_s", "latency_s", "draw_spans")}
    fast = fast.model_copy(update={"feedforward": slow.feedforward})
    return ScheduledConfig(**shared, feedforward=slow.feedforward, speed_m_per_s=[0.01, 0.1], laws=[slow, fast])


@pytest.mark.parametrize("design", [*LINEAR, scheduled])
def test_the_kernel_does_what_the_laws_do_with_all_effects(design):
    plants = real(random_plants(11), latency_s=0.01 + 0.0005 * np.arange(11))
    setup, rows = replace(NOISY, substeps=2, late_share=0.1, torque_nm=40.0), [1, 10]
    fast = simulate(design(task()), plants, several_changes(), setup, record=True)
    slow = simulate_slowly(design(task()), picked(plants, rows), several_changes(), setup, record=True)
    assert not fast.diverged.any()
    assert (fast.torque_max_nm == 40.0).any() and (fast.torque_step_max_nm > 9.99).any()  # limits do act
    assert_alike(fast, slow, rows)


@pytest.mark.parametrize("effects", [True, False])
def test_a_law_that_is_not_compiled_meets_the_same_line(effects):
    line, generator = random_plants(3), np.random.default_rng(5)
    plants = real(line) if effects else line
    states, torques = start(plants, several_changes())
    lines = [line_of(plants, 1, NOISY, states[1], torques[1]) for line_of in (CompiledLine, plain_line)]
    for _ in range(300):
        torque, moved = torques[1] + generator.normal(0.0, 5.0, 6), generator.normal(0.0, 1e-4, 6)
        for one in lines:
            one.step(torque, 0.05, moved)
    fast, slow = (one.state for one in lines)
    assert np.abs(slow[:6] - states[1][:6]).max() > 1.0  # it moves
    assert np.allclose(fast, slow, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("design", [design_lqi, design_lqg])
def test_effects_of_nothing_change_nothing(design):
    plants = random_plants(5)
    plain, empty = (
        simulate(design(task()), one, several_changes(), NOISY, record=True)
        for one in (plants, with_effects(plants, no_effects(plants)))
    )
    assert_alike(plain, empty)


def test_the_plant_is_that_of_the_simulated_line_with_its_effects():
    """The torques of a loop, sent late, on the simulated line's own full model."""
    n, theta = 3, model(3)
    coulomb, share, phase = np.array([2.0, 0.5, 1.0]), np.array([0.01, 0.003, 0.006]), np.array([0.3, 2.0, 4.0])
    one = plants_of_thetas([Theta(theta, coulomb, 0.005, 0.01)], share, phase)
    course = course_through(0.01, [(0.1, np.full(n, 30.0), 0.05), (1.4, np.array([30.0, 38.0, 26.0]), 0.05)])
    found = simulate(design_lqi(task(n)), one, course, replace(QUIET, substeps=10), record=True)
    world = World(
        truth(
            n,
            web={"stiffness_n": theta.stiffness_n, "length_m": 1.0},
            rollers={"radius_m": 0.04, "inertia_kg_m2": 0.95, "friction_nms_per_rad": 10.0},
            drives={"torque_lag_s": 0.005, "max_torque_nm": 200.0},
            effects={
                "friction": {"coulomb_nm": coulomb.tolist()},
                "eccentricity": {"share": share.tolist(), "phase_rad": (phase - np.pi / 2.0).tolist()},
            },
        ),
        seed=1,
    )
    holding = world.start_at_equilibrium(course.tension_n[0], 0.05)
    assert holding == pytest.approx(start(one, course)[1][0], abs=1e-9)
    sent = np.vstack((holding, found.torque_nm[0]))
    for k in range(course.periods - 1):
        for i in range(n):
            world.ramp_torque_nm(i, sent[k, i], np.inf)
        world.advance((k + 1) * 0.01)
        assert world.tension_n == pytest.approx(found.tension_n[0, k + 1], abs=2e-3), k
    assert np.ptp(found.tension_n[0], axis=0).max() > 5.0


def alone(lag_s=0.0, coulomb_nm=0.0, friction=10.0):
    """A roller on a web too soft to matter, turning at 0.1 m/s, its torque at 1 Nm."""
    plants = plants_of([replace(model(1), stiffness_n=1e-9, friction_nms_per_rad=np.array([friction]))])
    effects = Effects(np.array([lag_s]), np.array([[coulomb_nm]]), np.zeros((1, 1)), np.zeros((1, 1)))
    return RealLine(plants, effects, 0, 0.002, np.array([0.0, 0.1]), np.array([1.0]))


@pytest.mark.parametrize("lag_s", [0.0, 1e-4, 0.005, 0.1])
def test_the_torque_comes_behind_a_lag_of_the_first_order(lag_s):
    """J/R dw/dt = -f/R w + u_0 + (u - u_0)(1 - exp(-t / tau)), whose solution has two exponentials."""
    line, pole, gain, u0, u = alone(lag_s), 10.0 / 0.95, 0.04 / 0.95, 1.0, 7.0
    for k in range(1, 100):
        line.step(np.array([u]), 0.1, np.zeros(1))
        t = 0.002 * k
        expected = 0.1 * np.exp(-pole * t) + gain * u / pole * (1.0 - np.exp(-pole * t))
        if lag_s:
            fast = 1.0 / lag_s
            expected += gain * (u0 - u) * (np.exp(-fast * t) - np.exp(-pole * t)) / (pole - fast)
        assert line.state[1] == pytest.approx(expected, rel=1e-6)


def test_coulomb_friction_stops_a_roller_and_keeps_it():
    """From w_0, w = (w_0 + c R/f) exp(-f/J t) - c R/f until it is 0; then it rests, up to a torque of c."""
    line, reach, pole = alone(coulomb_nm=3.0), 3.0 * 0.04 / 10.0, 10.0 / 0.95
    stops_s = np.log(1.0 + 0.1 / reach) / pole
    for k in range(1, 200):
        line.step(np.zeros(1), 0.1, np.array([1e-4 if k > 150 else 0.0]))  # noise does not move what rests
        t = 0.002 * k
        expected = (0.1 + reach) * np.exp(-pole * t) - reach if t < stops_s else 0.0
        assert line.state[1] == pytest.approx(max(expected, 0.0), abs=1e-8)
    for torque_nm, moves in ((2.99, 0.0), (-2.99, 0.0), (3.5, 1.0)):
        line.step(np.array([torque_nm]), 0.1, np.zeros(1))
        assert np.sign(line.state[1]) == moves


def test_coulomb_friction_shifts_the_torque_that_holds_the_line():
    coulomb = np.array([2.0, 0.0, 1.0])
    plants = plants_of_thetas([Theta(model(3), c * np.ones(3), 0.0, 0.01) for c in (0.0 * coulomb, coulomb)])
    tension = np.array([30.0, 20.0, 40.0])
    course = Course(np.tile(tension, (300, 1)), np.full(300, 0.05), tail=100)
    found = simulate(design_lqi(task(3)), plants, course, QUIET, record=True)
    assert found.torque_nm[1, -1] - found.torque_nm[0, -1] == pytest.approx(coulomb, abs=1e-9)
    # It begins in its equilibrium, and stays there.
    assert np.abs(found.tension_n - tension).max() < 1e-9 and found.chatter_nm.max() < 1e-9
    (_, state), (_, torque) = start(plants, course)
    assert rate(plants.model(1), state, torque - coulomb, 0.05) == pytest.approx(np.zeros(6), abs=1e-12)


def test_an_eccentric_roller_moves_tensions_once_a_turn_as_linear_analysis_has_it():
    n, theta, e, unwind = 3, model(3), 1e-4, 1.0
    tension = np.array([30.0, 36.0, 24.0])
    speed = reference_speeds(theta, tension, unwind)
    plants = with_effects(
        plants_of([theta]), Effects(np.zeros(1), np.zeros((1, n)), e * np.eye(n)[1:2], np.ones((1, n)))
    )
    held = design_pid(task(n))
    none = np.zeros((n, n)).tolist()
    held = held.model_copy(
        update={"gain_proportional": np.zeros((n, 2 * n)).tolist(), "gain_integral": none, "gain_derivative": none}
    )  # the torque of the reference, and no more
    omega = speed[1] / theta.radius_m[1]
    turn = 2.0 * np.pi / omega
    periods = 3000
    course = Course(np.tile(tension, (periods, 1)), np.full(periods, unwind), tail=round(4.0 * turn / 0.01))
    found = simulate(held, plants, course, Setup(0.01, 0.01, 5), record=True)
    A, _ = linearise(theta, tension, speed, unwind)
    pushed = e * speed[1] * A[:, n + 1] * (np.arange(2 * n) < n)  # by the web's speed on roller 2, on spans 2 and 3
    pushed[n + 1] = e * theta.radius_m[1] ** 2 / theta.inertia_kg_m2[1] * (tension[2] - tension[1])
    expected = np.abs(np.linalg.solve(1j * omega * np.eye(2 * n) - A, pushed))[:n]
    t = 0.01 * np.arange(periods)
    last = slice(periods - round(20.0 * turn / 0.01), periods)
    basis = np.column_stack((np.cos(omega * t), np.sin(omega * t), np.ones(periods), t))[last]
    fitted = np.linalg.lstsq(basis, found.tension_n[0, last], rcond=None)[0]
    assert np.hypot(*fitted[:2]) == pytest.approx(expected, rel=2e-3)
    assert expected[1:].min() > 0.005  # it is to be seen
    assert found.tail_swing_n[0, 1:] == pytest.approx(expected[1:], rel=0.02)


def test_late_commands_hold_the_torque_before():
    """All of them late: a loop with a period more latency, which its law does not know of."""
    config, plants = design_lqi(task()), random_plants(3)
    late, later = (
        simulate(config, plants, several_changes(), setup, record=True)
        for setup in (replace(NOISY, late_share=1.0), replace(NOISY, latency_s=0.02))
    )
    assert_alike(late, later)
    own = with_effects(plants, replace(no_effects(plants), latency_s=np.full(3, 0.02)))
    assert_alike(simulate(config, own, several_changes(), NOISY, record=True), later)


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5])
def test_so_many_commands_are_late_drive_by_drive(share):
    setup = replace(QUIET, late_share=share, seed=5)
    late = setup.late(2000, 6)
    deviation = (share * (1.0 - share) / 2000.0) ** 0.5
    assert np.abs(late.mean(axis=0) - share).max() <= 4.0 * deviation
    assert share == 0.0 or np.abs(np.corrcoef(late.T) - np.eye(6)).max() < 0.1
    assert (late == setup.late(2000, 6)).all() and (late != replace(setup, seed=6).late(2000, 6)).any() == (share > 0.0)
    # The noise is what it is without late commands.
    assert all(
        (a == b).all() for a, b in zip(setup.draw(50, 6), replace(setup, late_share=0.0).draw(50, 6), strict=True)
    )


def test_latencies_of_plants_are_rounded_up():
    plants = random_plants(2)
    config = design_lqi(task())
    between, above = (
        simulate(
            config, with_effects(plants, replace(no_effects(plants), latency_s=np.full(2, s))), several_changes(), NOISY
        )
        for s in (0.0101, 0.012)
    )
    assert (between.rmse_n == above.rmse_n).all()


def test_the_tail_is_told_as_recorded():
    course = several_changes(tail_s=0.4)
    found = simulate(design_lqg(task()), real(random_plants(9)), course, replace(NOISY, substeps=1), record=True)
    tensions, torques = found.tension_n[:, -40:], found.torque_nm[:, -41:]
    assert found.tail_swing_n == pytest.approx(0.5 * np.ptp(tensions, axis=1), rel=1e-9)
    assert found.tail_error_n == pytest.approx(np.abs((tensions - course.tension_n[-40:]).mean(axis=1)), rel=1e-9)
    assert found.chatter_nm == pytest.approx(np.sqrt((np.diff(torques, axis=1) ** 2).mean(axis=1)), rel=1e-9)
    assert found.tail_swing_n.min() > 0.01 and found.chatter_nm.min() > 0.01


@pytest.mark.parametrize("effects", [False, True])
def test_extremes_between_the_samples_count(effects):
    plants, quick = real(random_plants(1)) if effects else random_plants(1), QUIET
    found = simulate(design_lqi(task()), plants, several_changes(), quick, record=True)
    stepped, _ = run_plant(make_law(design_lqi(task())), plants, 0, several_changes(), quick, drawn(quick))
    stepped, speeds = stepped[:, :6], stepped[:, 6:]
    assert np.allclose(stepped[::5], found.tension_n[0], atol=1e-9)
    assert np.allclose(found.roller_speed_max_m_per_s[0], np.abs(speeds).max(axis=0), atol=1e-9)
    assert np.allclose(found.tension_max_n[0], stepped.max(axis=0), atol=1e-9)
    assert np.allclose(found.tail_swing_n[0], 0.5 * np.ptp(stepped[-200:], axis=0), atol=1e-9)
    assert (found.tension_max_n > found.tension_n.max(axis=1) + 1e-3).any()


def drawn(setup, periods=200, n=6):
    return (*setup.draw(periods, n), setup.late(periods, n))


def test_every_change_is_settled_for_itself():
    course = several_changes()
    assert course.changes.tolist() == [10, 70, 120, 200]
    found = simulate(design_lqi(task()), real(random_plants(4), share=0.0), course, QUIET, record=True)
    for b in range(4):
        settled, beyond = np.zeros(6), np.zeros(6)
        for begin, end in ((10, 70), (70, 120), (120, 200)):
            part = slice(begin - 1, end)
            time_s, run, asked = 0.01 * np.arange(begin - 1, end), found.tension_n[b, part], course.tension_n[part]
            settled = np.maximum(settled, settling_time_s(time_s, run, asked, 0.01 * begin - 0.005) / 0.01)
            step = np.abs(asked[-1] - asked[0])
            size = np.where(step == 0.0, asked[-1], step) / 100.0
            beyond = np.maximum(beyond, size * overshoot_pct(time_s, run, asked, 0.01 * begin - 0.005))
        assert found.beyond_n[b] == pytest.approx(beyond, abs=1e-9)
        assert np.isfinite(settled).all() and found.settled[b] == pytest.approx(np.round(settled), abs=1.0)


@pytest.mark.parametrize("effects", [False, True])
def test_a_plant_that_runs_away_is_told_and_the_others_are_what_they_were(effects):
    config = design_lqi(task())
    plants = random_plants(19)
    if effects:
        plants = real(plants)
    wild = replace(plants, inertia_kg_m2=plants.inertia_kg_m2 / np.where(np.arange(19) % 3 == 2, 12.0, 1.0)[:, None])
    free = replace(NOISY, torque_nm=np.inf, torque_rate_nm_per_s=np.inf)
    fast, rows = simulate(config, wild, several_changes(), free, record=True), [1, 2]
    slow = simulate_slowly(config, picked(wild, rows), several_changes(), free, record=True)
    assert fast.diverged.tolist() == (np.arange(19) % 3 == 2).tolist() and slow.diverged.tolist() == [False, True]
    assert np.isinf(fast.tail_swing_n[fast.diverged]).all() and (fast.tension_min_n[fast.diverged] == -np.inf).all()
    assert not any(
        np.isnan(values).any() for name, values in vars(fast).items() if name not in ("tension_n", "torque_nm")
    )
    good = ~fast.diverged
    assert np.allclose(fast.tension_n[1], slow.tension_n[0], rtol=1e-9)
    assert (fast.rmse_n[good] == simulate(config, plants, several_changes(), free).rmse_n[good]).all()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"coulomb_nm": -np.ones((2, 6))}, "coulomb_nm goes from -1 to -1; allowed: 0"),
        ({"eccentricity": np.ones((2, 6))}, "eccentricity .* below 1"),
        ({"phase_rad": np.ones(6)}, r"phase_rad is \(6,\), it must be \(2, 6\)"),
        ({"torque_lag_s": np.ones(3)}, r"torque_lag_s is \(3,\), it must be \(2,\)"),
        ({"latency_s": np.full(2, np.nan)}, "latency_s goes from nan"),
    ],
)
def test_effects_that_no_plant_has_are_refused(change, says):
    plants = random_plants(2)
    with pytest.raises(ValueError, match=says):
        simulate(
            design_lqi(task()), with_effects(plants, replace(no_effects(plants), **change)), several_changes(), QUIET
        )


@pytest.mark.parametrize(
    ("course", "setup", "says"),
    [
        (replace(several_changes(), later=(5,)), QUIET, "ascending"),
        (replace(several_changes(), tail=201), QUIET, "tail of 201"),
        (several_changes(), replace(QUIET, late_share=1.5), "share of 1.5"),
    ],
)
def test_courses_and_loops_that_cannot_be_are_refused(course, setup, says):
    with pytest.raises(ValueError, match=says):
        simulate(design_lqi(task()), random_plants(1), course, setup)
    with pytest.raises(ValueError, match="at least 1"):
        course_through(0.01, [(0.001, np.full(6, 30.0), 0.05)])


def test_mpc_far_from_its_limits_is_its_unconstrained_law():
    wide = {"torque_nm": 500.0, "torque_rate_nm_per_s": 1e6}
    config, plants = design_mpc(task(3)).model_copy(update=wide), real(random_plants(1, 3))
    course = course_through(0.01, [(0.1, np.full(3, 30.0), 0.05), (0.2, np.full(3, 31.0), 0.05)], 0.1)
    setup = replace(QUIET, late_share=0.05, **wide)
    slow, fast = (simulate(law, plants, course, setup, record=True) for law in (config, unconstrained(config)))
    assert_alike(fast, slow, rtol=1e-6)
    assert np.ptp(fast.tension_n) > 0.5


def test_mpc_without_a_solution_is_its_fallback():
    """A programme whose limits the line is beyond from the start, and a solver that may not begin."""
    config = design_mpc(task(3))
    hopeless = config.model_copy(update={"torque_nm": 0.01, "torque_rate_nm_per_s": 0.01, "most_iterations": 1})
    course = course_through(0.01, [(0.1, np.full(3, 30.0), 0.05), (0.2, np.full(3, 44.0), 0.05)])
    nominal = plants_of([model(3)])
    slow, fast = (simulate(law, nominal, course, QUIET, record=True) for law in (hopeless, fallback(config)))
    other = simulate(unconstrained(config), nominal, course, QUIET, record=True)
    assert np.abs(slow.torque_nm - fast.torque_nm).max() < 1e-6 < np.abs(other.torque_nm - fast.torque_nm).max()
