"""Weights by rule: today's at 10 ms, margins and stability from 1 to 20 ms on random plants, monotone in between.

And of lines of every size: the same law in other units, and no more torque from encoders' noise than its share.
"""

from dataclasses import astuple, replace
from itertools import pairwise

import numpy as np
import pytest

from gateway.control.design import (
    DesignLimits,
    DesignTask,
    LqgWeights,
    LqiWeights,
    LqrWeights,
    MpcWeights,
    design_lqg,
    design_lqi,
    design_lqr,
    design_mpc,
    design_pid,
    lqg_weights,
    lqi_weights,
    lqr_weights,
    margins,
    mpc_weights,
    require_margin,
    task_of,
    without_disturbances,
)
from gateway.control.design.margins import LEAST_DELAY_MARGIN_S
from gateway.control.design.mpc import HORIZON_S, default_blocks
from gateway.control.design.weights import LET_GO_S, STOOD_BEYOND_S, encoder_bandwidth, stood_s
from gateway.control.mpc_problem import MpcProblem
from gateway.control.rollout import Course, Setup, plants_of, simulate, simulate_slowly
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.theta import NOISE_SHARE
from gateway.core.web_model import WebModel
from tests.unit.control_support import model

PERIODS_S = (0.001, 0.002, 0.005, 0.01, 0.02)
TIMES = [(period, k * period) for period in PERIODS_S for k in (0, 1, 2)]
DRIVES = [(60.0, 1000.0), (500.0, 1e5)]
RULES = [lqr_weights, lqi_weights, lqg_weights, mpc_weights]


def task(theta=None, period_s=0.01, latency_s=0.01, torque_nm=60.0, rate_nm_per_s=1000.0):
    limits = DesignLimits(torque_nm, rate_nm_per_s, 2.0, 60.0)
    return DesignTask(theta or model(), period_s, latency_s, np.full(6, 30.0), 0.05, limits=limits)


def random_plants(count, seed):
    """EA, J, L +-20 %, R +-15 %, f +-50 % around S_sim, as far as 50 Nm keep 0.1 m/s."""
    generator, found = np.random.default_rng(seed), []

    def around(value, share, size=6):
        return value * (1.0 + share * generator.uniform(-1.0, 1.0, size))

    while len(found) < count:
        theta = WebModel(
            float(around(2400.0, 0.2, 1)[0]), around(1.0, 0.2), around(0.04, 0.15), around(0.95, 0.2), around(10.0, 0.5)
        )
        if (theta.friction_nms_per_rad * 0.1 / theta.radius_m <= 50.0).all():
            found.append(theta)
    return found


def test_at_ten_milliseconds_the_weights_are_the_defaults():
    assert lqr_weights(task()) == LqrWeights(common_torque=0.25)
    assert astuple(lqi_weights(task())) == pytest.approx(astuple(LqiWeights()))
    assert lqg_weights(task()) == LqgWeights()
    assert astuple(mpc_weights(task())) == pytest.approx(astuple(MpcWeights()))
    assert default_blocks(0.01) == (1, 1, 1, 1, 2, 3, 6)
    assert STOOD_BEYOND_S == LEAST_DELAY_MARGIN_S


@pytest.mark.parametrize(("torque_nm", "rate_nm_per_s"), DRIVES)
@pytest.mark.parametrize(("period_s", "latency_s"), TIMES)
@pytest.mark.parametrize("design", [design_pid, design_lqr, design_lqi, design_lqg, design_mpc])
def test_every_design_stands_four_milliseconds_more(design, period_s, latency_s, torque_nm, rate_nm_per_s):
    for theta in (model(), *random_plants(2, 11)):
        asked = task(theta, period_s, latency_s, torque_nm, rate_nm_per_s)
        require_margin(margins(design(asked), asked))


@pytest.mark.parametrize("rule", RULES)
def test_weights_fall_with_the_dead_time_and_the_torque_rate(rule):
    times = sorted(TIMES, key=lambda time: time[1] + 0.5 * time[0])
    by_time = [rule(task(None, *time)).torque_per_nm2 for time in times]
    assert all(before <= after * (1.0 + 1e-12) for before, after in pairwise(by_time))
    rates = (300.0, 1000.0, 3000.0, 1e4, 1e5)
    by_rate = [rule(task(None, 0.001, 0.0, rate_nm_per_s=rate)).torque_per_nm2 for rate in rates]
    assert all(before >= after for before, after in pairwise(by_rate)) and by_rate[0] > by_rate[-1]


@pytest.mark.parametrize("period_s", [*PERIODS_S, 0.0005, 0.004, 0.05])
def test_blocks_cover_the_horizon_at_any_period_and_are_as_many(period_s):
    blocks = default_blocks(period_s)
    assert len(blocks) == 7 and blocks[0] == 1
    assert all(before <= after for before, after in pairwise(blocks))
    assert sum(blocks) * period_s <= max(HORIZON_S + 0.5 * period_s, 7 * period_s) + 1e-12
    assert sum(blocks) * period_s >= 0.95 * HORIZON_S


def test_back_calculation_takes_as_much_within_the_dead_time_whatever_the_period():
    for time in TIMES:
        share, periods = lqi_weights(task(None, *time)).antiwindup, max(stood_s(task(None, *time)), LET_GO_S) / time[0]
        assert (1.0 - share) ** periods == pytest.approx(0.6**1.9)


@pytest.mark.parametrize(("period_s", "latency_s", "torque_nm", "rate_nm_per_s"), [
    (0.001, 0.0, 500.0, 1e5), (0.001, 0.0, 60.0, 1000.0), (0.002, 0.004, 60.0, 1000.0), (0.01, 0.02, 60.0, 1000.0),
])  # fmt: skip
def test_a_step_beyond_the_limits_does_not_swing(period_s, latency_s, torque_nm, rate_nm_per_s):
    """The paper's 24 N at once, on random plants, designed on S_sim: at rest again after two seconds."""
    asked = task(None, period_s, latency_s, torque_nm, rate_nm_per_s)
    periods, begin = round(3.0 / period_s), round(0.1 / period_s)
    tension = np.full((periods, 6), 30.0)
    tension[:, 2] = 20.0
    tension[begin:, 2] = 44.0
    course = Course(tension, np.full(periods, 0.01), begin)
    setup = Setup(period_s, latency_s, max(1, round(period_s / 1e-3)), torque_nm, rate_nm_per_s)
    plants = plants_of(random_plants(8, 12))
    for design in (design_pid, design_lqi, design_lqg):
        found = simulate(design(asked), plants, course, setup, record=True)
        assert found.tension_max_n.max() < 60.0
        still = found.tension_n[:, round(2.1 / period_s) :]
        assert np.ptp(still, axis=1).max() < 1.0


def test_without_disturbances_the_observer_follows_the_measurements():
    """An offset is the torque that the model has wrong over the gain of the feedback, and nothing more."""
    asked = task(None)
    config = design_mpc(asked, without_disturbances(mpc_weights(asked)))
    assert not np.any(config.predictor.gain_disturbance)
    speed = np.full(500, 0.1)
    speed[:50] = 0.01  # what holds the line when the law is engaged is known to it; friction grows from there
    course, loop = Course(np.full((500, 6), 30.0), speed, 50), Setup(0.01, 0.01, 10, 60.0, 1000.0)
    expected = -np.linalg.solve(MpcProblem(config).gain()[:, :6], 2.0 * 0.09 / 0.04 * np.ones(6))
    trusting = design_mpc(asked, MpcWeights(disturbance_nm_per_sqrt_s=0.0))
    follows, trusts = (
        np.linalg.norm(run.tension_n[0, -1] - 30.0)
        for run in (simulate_slowly(c, plants_of([model(friction=12.0)]), course, loop, record=True)
                    for c in (config, trusting))
    )  # fmt: skip
    assert follows < 1.5 * np.linalg.norm(expected) and trusts > 2.0 * follows


def test_cheap_common_torque_nearly_halves_the_offset_of_friction_that_is_wrong_everywhere():
    asked, plants = task(), plants_of([model(friction=14.0)])
    course = Course(np.full((1000, 6), 30.0), np.full(1000, 0.1))
    setup = Setup(0.01, 0.01, 10, 60.0, 1000.0)
    cheap, plain = (simulate(design_lqr(asked, w), plants, course, setup) for w in (None, LqrWeights()))
    assert cheap.rmse_n[0] < 0.6 * plain.rmse_n[0]


def scaled(theta, length=1.0, tension=1.0, inertia=1.0):
    """The same line with lengths, tensions and inertias so many times as large: J as m R^2, friction as T R t."""
    return WebModel(
        tension * theta.stiffness_n, length * theta.length_m, length * theta.radius_m,
        inertia * length**2 * theta.inertia_kg_m2, inertia * length**2 * theta.friction_nms_per_rad,
    )  # fmt: skip


@pytest.mark.parametrize("draw_spans", [(), (2,)])
@pytest.mark.parametrize("design", [design_pid, design_lqr, design_lqi])
@pytest.mark.parametrize(("length", "tension"), [(0.25, 2.0**-9), (4.0, 2.0**-3), (1.0, 2.0**8), (2.0, 2.0**8)])
def test_a_line_in_other_units_gets_the_same_law(design, length, tension, draw_spans):
    """Times are the same, so masses are as tension over length; torques are as tension times length."""
    inertia, torque = tension / length, tension * length
    noise_m_per_s = 5e-3  # counts: the second weight of three is not the only one tried
    small = replace(task(), encoder_noise_m_per_s=noise_m_per_s, draw_spans=draw_spans)
    large = DesignTask(
        scaled(small.model, length, tension, inertia), small.period_s, small.latency_s, tension * small.tension_n,
        length * small.unwind_speed_m_per_s, draw_spans,
        limits=DesignLimits(60.0 * torque, 1000.0 * torque, 2.0 * tension, 60.0 * tension),
        encoder_noise_m_per_s=length * noise_m_per_s,
    )  # fmt: skip
    per_tension, per_speed = torque / tension, torque / length
    units = np.concatenate((np.full(6, per_tension), np.full(6, per_speed)))
    of_small, of_large = design(small), design(large)
    if design is design_pid:
        expected, found = of_small.gain_proportional, of_large.gain_proportional
    else:
        expected, found = of_small.gain_state, of_large.gain_state
    _same(found, np.array(expected) * units)
    if design is design_lqi:
        of_span = np.where(np.isin(np.arange(6), draw_spans), per_speed, per_tension)
        _same(of_large.gain_integral, np.array(of_small.gain_integral) * of_span)


def _same(found, expected):
    """But for the rounding of the largest gains of each unit."""
    for columns in (slice(0, 6), slice(6, 12)):
        of_unit = expected[:, columns]
        if of_unit.size:
            close = 1e-8 * np.abs(of_unit).max()
            assert np.array(found)[:, columns] == pytest.approx(of_unit, rel=1e-6, abs=close)


@pytest.mark.parametrize("times", [10.0, 30.0, 100.0, 300.0])
@pytest.mark.parametrize("design", [design_pid, design_lqr, design_lqi])
def test_noise_of_encoders_makes_no_more_of_the_torque_than_its_share(design, times):
    """Independently of the rule: from the gain itself, every roller's noise added up."""
    for theta in (model(), model(length=0.3), *random_plants(2, 13)):
        noise_m_per_s = times * 1e-4
        asked = replace(task(theta), encoder_noise_m_per_s=noise_m_per_s)
        found = design(asked)
        gain = np.array(found.gain_proportional if design is design_pid else found.gain_state)[:, 6:]
        torque_nm = noise_m_per_s * np.linalg.norm(gain, axis=1).max()
        free = design(replace(asked, encoder_noise_m_per_s=0.0))
        free_gain = np.array(free.gain_proportional if design is design_pid else free.gain_state)[:, 6:]
        share = torque_nm / (1000.0 * asked.period_s)
        assert share < 1.05 * NOISE_SHARE
        if times == 30.0 and noise_m_per_s * np.linalg.norm(free_gain, axis=1).max() > NOISE_SHARE * 10.0:
            assert share > 0.5 * NOISE_SHARE  # nor much less; beyond it friction damps the line more than the law does
        require_margin(margins(found, asked))


def test_what_is_expected_of_encoders_comes_from_the_line_and_bounds_no_design_of_the_demonstration():
    line = load_line(line_template(6), "line.toml")
    asked = task_of(line)
    assert asked.encoder_noise_m_per_s == pytest.approx(1e-4)
    assert encoder_bandwidth(asked) > 100.0
    assert design_lqi(asked) == design_lqi(replace(asked, encoder_noise_m_per_s=0.0))
