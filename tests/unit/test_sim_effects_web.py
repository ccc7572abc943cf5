"""The web: relaxation, slack, break and slip against what can be worked out by hand."""

import numpy as np
import pytest

from sim_plant.effects_model import SLIP_TIME_S
from sim_plant.world import World
from tests.unit.sim_effects_support import HELD_NM, LENGTH_M, RADIUS_M, STIFFNESS_N, held_span, plant, rows_of

PER_METRE_N = STIFFNESS_N / LENGTH_M  #: tension per metre that a span is stretched
TENSION_N = np.array([28.0, 36.0, 20.0])


def test_a_stretched_web_relaxes_from_its_short_term_to_its_long_term_modulus() -> None:
    """Step of strain: T(t) = E A x/L (1 + r exp(-t/tau)), Zener's solid."""
    world = held_span(relaxation={"stiffness_share": 0.4, "time_s": 0.5})
    world.set_unwind_speed(-1.0)  # back, for a millisecond: a millimetre
    world.advance(0.001)
    world.set_unwind_speed(0.0)
    tension = rows_of(world, 4.0)[:, 0]
    t = 0.0005 + 0.001 * np.arange(1, len(tension) + 1)  # the step is done in its middle
    expected = PER_METRE_N * 1e-3 * (1.0 + 0.4 * np.exp(-t / 0.5))
    assert np.abs(tension / expected - 1.0).max() < 1e-6
    assert tension[-1] / tension[0] == pytest.approx(1.0 / 1.4, rel=1e-3)


def test_a_running_web_that_relaxes_rests_where_its_rest_point_is() -> None:
    """Not by the code that computes it: both integrate to the same, from the rest point and from far away."""
    relaxing = plant(3, effects={"relaxation": {"stiffness_share": 0.3, "time_s": 2.0}})
    rest, elsewhere = World(relaxing, seed=1), World(relaxing, seed=1)
    torque_nm = rest.start_at_equilibrium(TENSION_N, 0.5)
    rest.advance(5.0)
    assert np.abs(rest.tension_n - TENSION_N).max() < 1e-9
    elsewhere.start_at_equilibrium(TENSION_N * 0.8, 0.5)
    elsewhere.command_torques_nm(torque_nm)
    elsewhere.advance(120.0)
    assert np.abs(elsewhere.tension_n - TENSION_N).max() < 1e-6


def test_at_speed_a_web_has_less_time_to_relax() -> None:
    """The draw needed for a tension lies between that of the short-term and of the long-term modulus."""
    draws = []
    for speed in (1e-3, 10.0):
        world = World(plant(1, effects={"relaxation": {"stiffness_share": 0.5, "time_s": 1.0}}), seed=1)
        world.start_at_equilibrium(np.array([20.0]), speed)
        draws.append(float(world.speed_m_per_s[0]) / speed - 1.0)
    assert draws[0] == pytest.approx(20.0 / STIFFNESS_N, rel=0.02)
    assert draws[1] == pytest.approx(20.0 / (1.5 * STIFFNESS_N), rel=0.06)


def test_slack_must_be_taken_up_before_tension_comes_back() -> None:
    world = held_span(slack=True)
    world.ramp_unwind_speed(0.02, 0.1)
    fed = rows_of(world, 1.0)
    length_m = float(fed[:, 1 * 3].sum()) * 0.001
    assert not fed[:, 0].any()
    assert world.use_full_line().slack_m[0] == pytest.approx(length_m, rel=1e-9) == pytest.approx(0.018, rel=0.01)
    world.set_unwind_speed(-0.01)
    back = rows_of(world, 4.0)
    taken_m = 0.01 * 0.001 * np.arange(1, len(back) + 1)
    expected = np.maximum(0.0, taken_m - length_m) * PER_METRE_N
    assert back[:, 0].min() == 0.0
    assert np.abs(back[:, 0] - expected).max() < 1e-6
    assert world.use_full_line().slack_m[0] == 0.0


def test_a_slack_web_that_relaxes_is_taken_up_by_its_whole_length() -> None:
    """Nobody stretches it before: its arm has nothing to remember, and tension returns with the short-term modulus."""
    world = held_span(slack=True, relaxation={"stiffness_share": 0.5, "time_s": 0.2})
    world.set_unwind_speed(0.05)
    world.advance(1.0)
    world.set_unwind_speed(0.0)
    world.advance(3.0)
    world.set_unwind_speed(-0.05)
    rows = rows_of(world, 4.01)
    assert not rows[:999, 0].any()
    assert rows[1004, 0] == pytest.approx(1.5 * PER_METRE_N * 0.05 * 0.005, rel=0.05)


def test_without_slack_the_web_pushes_as_in_the_paper() -> None:
    world = held_span()
    world.set_unwind_speed(0.01)
    world.advance(0.1)
    assert world.tension_n[0] == pytest.approx(-PER_METRE_N * 1e-3)
    assert not world.use_full_line().slack_m.any()


def test_a_slack_web_carries_no_strain_into_the_next_span() -> None:
    """T_1 v_1 enters span 2: none while span 1 is slack, however much too long it is."""
    stuck = {"friction": {"breakaway_nm": HELD_NM}, "slack": True}
    slacks = []
    for length_m in (0.0, 0.5):
        world = World(plant(2, effects=stuck | {"friction": {"breakaway_nm": [0.0, HELD_NM]}}), seed=1)
        world.slacken_web(1, length_m)
        world.set_torque_nm(0, -1.0)  # roller 1 pulls span 2 backwards, and loosens span 1
        world.advance(0.5)
        slacks.append(float(world.use_full_line().slack_m[0]))
        assert world.tension_n[0] == 0.0 and world.tension_n[1] > 1.0
    assert slacks[1] - slacks[0] == pytest.approx(0.5, rel=1e-12)


def test_a_span_may_be_given_slack() -> None:
    world = World(plant(3), seed=1)
    world.start_at_equilibrium(TENSION_N, 0.0)
    world.slacken_web(2, 0.03)
    assert world.tension_n[1] == 0.0 and world.use_full_line().slack_m.tolist() == pytest.approx([0.0, 0.03, 0.0])
    assert world.tension_n[[0, 2]].tolist() == [28.0, 20.0]


def test_a_broken_span_is_gone_for_both_its_rollers_at_once() -> None:
    world = World(plant(3), seed=1)
    world.start_at_equilibrium(TENSION_N, 0.0)
    world.break_web(2)
    assert world.tension_n.tolist() == [28.0, 0.0, 20.0]
    row = rows_of(world, 0.001)[0]
    gained = RADIUS_M**2 / 1.0 * 36.0 * 0.001  # what the tension of the span held, over 1 ms
    assert row[3:6].tolist() == pytest.approx([-gained, gained, 0.0], rel=0.01, abs=1e-6)
    world.set_unwind_speed(-1.0)
    after = rows_of(world, 2.0)
    assert not after[:, 1].any() and after[:, [0, 2]].min() >= 0.0


def test_a_spliced_web_begins_straight_and_without_tension() -> None:
    world = held_span(slack=True, relaxation={"stiffness_share": 0.5, "time_s": 10.0})
    world.set_unwind_speed(-0.01)
    world.advance(0.1)
    assert world.tension_n[0] > 1.0
    world.break_web(1)
    world.advance(0.2)
    world.splice_web(1)
    assert world.tension_n[0] == 0.0
    world.advance(0.201)
    assert world.tension_n[0] == pytest.approx(1.5 * PER_METRE_N * 1e-5, rel=1e-3)


def capstan(wrap_rad: float, on: bool = True) -> World:
    """Two spans over a roller that is held; the roller behind pulls with 40 N."""
    slip = {"on": on, "friction_coefficient": 0.3, "wrap_rad": wrap_rad}
    world = World(plant(2, effects={"friction": {"breakaway_nm": [HELD_NM, 0.0]}, "slip": slip}), seed=1)
    world.start_at_equilibrium(np.array([10.0, 10.0]), 0.0)
    world.set_torque_nm(1, 40.0 * RADIUS_M)
    return world


@pytest.mark.parametrize("wrap_rad", [1.0, 3.0])
def test_a_web_that_slides_keeps_eulers_and_eytelweins_ratio(wrap_rad: float) -> None:
    world = capstan(wrap_rad)
    world.advance(200.0)
    assert world.tension_n[1] == pytest.approx(40.0, rel=1e-3)
    assert world.tension_n[1] / world.tension_n[0] == pytest.approx(np.exp(0.3 * wrap_rad), rel=1e-4)
    assert world.surface_speed_m_per_s[0] == 0.0


def test_a_web_that_is_held_does_not_slide() -> None:
    for world in (capstan(3.0, on=False), capstan(np.log(4.0) / 0.3 + 0.01)):
        world.advance(20.0)
        assert world.tension_n[0] == 10.0 and world.speed_m_per_s[0] == 0.0


def test_the_force_on_a_roller_is_limited_whatever_it_does() -> None:
    """Roller 1 races: the web takes no more than the belt friction off it, plus what slides through a stiff film."""
    world = World(plant(2, effects={"slip": {"on": True, "wrap_rad": 2.0}, "slack": True}), seed=1)
    world.start_at_equilibrium(np.array([20.0, 20.0]), 0.1)
    world.set_torque_nm(0, 80.0)
    rows = rows_of(world, 1.0)
    grip = np.exp(0.3 * 2.0)
    sliding = world.surface_speed_m_per_s[0] - world.speed_m_per_s[0]
    film_n = SLIP_TIME_S * PER_METRE_N * (1.0 + grip) * sliding
    tension_before, tension_after = rows[-1, 0], rows[-1, 1]
    assert sliding > 0.05
    assert tension_before == pytest.approx(grip * tension_after + film_n, rel=1e-6)


def test_slip_can_begin_while_the_line_runs_and_end() -> None:
    world = World(plant(2), seed=1)
    world.start_at_equilibrium(np.array([10.0, 30.0]), 0.1)
    world.set_slip(1, 1.0)
    world.advance(0.1)
    assert world.tension_n.tolist() == pytest.approx([10.0, 30.0])  # 1 is the plant as it is: nothing slips
    world.set_slip(1, 0.2)
    world.advance(0.2)
    grip = np.exp(0.2 * 0.3 * np.pi)
    assert world.tension_n[1] / world.tension_n[0] == pytest.approx(grip, rel=0.05)
    assert world.speed_m_per_s[0] > world.surface_speed_m_per_s[0]
    world.set_slip(1, 1.0)
    assert world.speed_m_per_s[0] == world.surface_speed_m_per_s[0]
