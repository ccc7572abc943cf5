"""How the way of a fallback is looked at: in one product where no torque is cut, step by step where one is."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.control.design import design_pid, task_of
from gateway.control.deviation import Measured
from gateway.control.engagement import memory
from gateway.control.law import Measured as LawMeasured
from gateway.control.laws import make_law
from gateway.control.reference import Steady
from gateway.core.controller import config_hash
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.theta import nominal_theta
from gateway.core.web_model import equilibrium_torque, reference_speeds
from safety.actions import Action
from safety.monitor import recoverable
from safety.recoverability import Recovery
from safety.recovery_prediction import recovery_prediction
from tests.safety.recovery_support import (
    LAWS,
    LINE,
    SPEED,
    STEP_NM,
    TENSION_N,
    THETA,
    at_rest,
    disturbed,
    equilibrium,
    limited,
    recovery_of,
    replace_speed,
    rolled_out,
)

LOOKS = [0, 1, 2, 3, 4, 5, 6, 7, 8, 11, 14, 17, 20, 23, 26, 29, 32, 35, 38, 41, 44, 47, 50, 53, 56, 59]  #: up to 60


def looked_at(cut):
    """Periods that are looked at, where `cut` says of each period whether the law's torque was."""
    periods = np.flatnonzero(cut)
    if not periods.size:
        return LOOKS
    first, last = periods[0], periods[-1]
    in_vain = np.count_nonzero(~cut[first:last])  # times that the rest was hoped to be without a cut
    if in_vain >= 4 or last >= 59:
        return list(range(61))
    behind = last + 2  # the first period that follows one without a cut
    return [*range(behind), *(behind + look for look in LOOKS if behind + look <= 60)]


@pytest.mark.parametrize(
    ("size", "seed", "limits", "first_and_last", "in_one"),
    [
        (1.0, 0, {}, (), True),
        (3.0, 0, {}, (), True),
        (8.0, 0, {}, (1, 5), True),
        (20.0, 0, {}, (1, 17), True),
        (3.0, 3, {"torque_nm": 25.0}, (4, 4), True),  # none is cut to begin with
        (3.0, 5, {"torque_rate_nm_per_s": 300.0}, (1, 11), True),  # four times it looks as if it was over
        (3.0, 1, {"torque_rate_nm_per_s": 200.0}, (1, 21), False),  # five times
        (8.0, 1, {"torque_rate_nm_per_s": 200.0}, (1, 60), False),
    ],
)
def test_what_is_looked_at_is_what_the_law_does_and_each_period_while_torques_are_cut(
    size, seed, limits, first_and_last, in_one
):
    line = limited(**limits)
    x, *torques = disturbed(size, seed)
    before_nm, torque_nm = np.clip(torques, -line.limits.torque_nm, line.limits.torque_nm)
    truth, asked_nm, sent_nm = rolled_out(LAWS["lqi"], x, before_nm, torque_nm, 61, line)
    cut = (np.abs(asked_nm - sent_nm[1:]) > 1e-3).any(axis=1)
    assert np.flatnonzero(cut)[[0, -1][: 2 * cut.any()]].tolist() == list(first_and_last)
    measured = Measured(x[:6], x[6:], SPEED)
    found, looks = recovery_of(line=line).ahead(measured, TENSION_N, before_nm[None], torque_nm)
    assert looks.tolist() == looked_at(cut) and (len(looks) < 61) is in_one
    np.testing.assert_allclose(found[:6].T, truth[looks, :6], atol=1e-3)
    np.testing.assert_allclose(found[6:].T, truth[looks, 6:], atol=1e-5)


LONGER = {
    8: LOOKS,
    9: [0, 1, 2, 3, *range(4, 61, 3)],
    16: [0, 1, 2, 3, *range(4, 61, 4)],
    20: [0, 1, 2, 3, *range(4, 61, 5)],
}


@pytest.mark.parametrize("n", LONGER)
def test_a_longer_line_is_looked_at_less_often(n):
    line = load_line(line_template(n, "line.toml"), "line.toml")
    theta, config = nominal_theta(line), design_pid(task_of(line))
    tension_n = np.array(line.recipes[0].tension_n)
    v_eq = reference_speeds(theta.web, tension_n, SPEED)
    u_eq = equilibrium_torque(theta.web, tension_n, v_eq)
    recovery = Recovery(recovery_prediction(theta, config, line, [SPEED]), config, line)
    found, looks = recovery.ahead(Measured(tension_n, v_eq, SPEED), tension_n, u_eq[None], u_eq)
    assert looks.tolist() == LONGER[n]
    np.testing.assert_allclose(found, np.repeat(np.concatenate((tension_n, v_eq))[:, None], len(looks), axis=1))


def test_a_torque_at_its_limit_is_not_cut_and_one_beyond_it_is():
    measured, *rest = at_rest()
    most_nm = float(np.abs(rest[-1]).max())
    for share, in_one in ((1.0, True), (1.0 - 1e-5, False)):
        _, looks = recovery_of(line=limited(torque_nm=share * most_nm)).ahead(measured, *rest)
        assert (looks.tolist() == LOOKS) is in_one


def running(config, measured, setpoint_n, in_flight_nm, torque_nm):
    """What a law that has kept the line remembers at the next sample."""
    law, reference = make_law(config), Steady(setpoint_n)
    now = LawMeasured(measured.tension_n.copy(), measured.speed_m_per_s.copy(), measured.unwind_speed_m_per_s)
    state = law.engage(now, reference, torque_nm)
    return memory(law.commit(state, law.ask(state, now, reference), torque_nm))


def test_a_torque_that_changes_at_its_rate_is_not_cut_and_a_faster_one_is():
    """The law that runs asks for the torque of the equilibrium again, after another one was sent."""
    measured, setpoint_n, in_flight_nm, u_eq = given = at_rest()
    remembered = running(LAWS["lqi"], *given)
    recovery = recovery_of()
    for share, in_one in ((1.0, True), (1.0 + 1e-5, False)):
        sent_nm = u_eq + share * STEP_NM * np.eye(6)[1]
        _, looks = recovery.ahead(measured, setpoint_n, in_flight_nm, sent_nm, remembered)
        assert (looks.tolist() == LOOKS) is in_one


@pytest.mark.parametrize(("speed", "node"), [(0.005, 0), (0.0299, 0), (0.0301, 1), (0.0749, 1), (0.0751, 2), (0.12, 2)])
def test_the_model_at_the_nearest_speed_is_taken(speed, node):
    speeds = [0.01, 0.05, 0.1]
    measured, *rest = at_rest(speed=speed)
    away = replace(measured, tension_n=measured.tension_n + 1.0)
    found, _ = recovery_of(speeds=speeds).ahead(away, *rest)
    ways = [recovery_of(speeds=[one]).ahead(away, *rest)[0] for one in speeds]
    assert [np.array_equal(found, way) for way in ways] == [i == node for i in range(3)]


@pytest.mark.parametrize("speed", [SPEED, 0.0, -SPEED])
def test_dry_friction_is_a_part_of_what_keeps_the_line(speed):
    coulomb_nm = np.arange(1.0, 7.0)
    recovery = recovery_of(theta=replace(THETA, coulomb_nm=coulomb_nm))
    measured, setpoint_n, _, u_eq = at_rest(speed=speed)
    torque_nm = u_eq + coulomb_nm * np.sign(speed)
    found, looks = recovery.ahead(measured, setpoint_n, torque_nm[None], torque_nm)
    still = np.concatenate((TENSION_N, measured.speed_m_per_s))
    np.testing.assert_allclose(found, np.repeat(still[:, None], len(looks), axis=1), atol=1e-9)


def test_a_lag_of_the_drives_is_a_dead_time_more():
    """Latency and lag together reach into the period after next: two torques are in flight."""
    late = recovery_prediction(replace(THETA, latency_s=0.014), LAWS["lqi"], LINE, [SPEED])
    lagging = recovery_prediction(replace(THETA, latency_s=0.010, torque_lag_s=0.004), LAWS["lqi"], LINE, [SPEED])
    assert len(lagging.nodes[0].inputs) == 3
    for mine, other in zip(lagging.nodes[0].inputs, late.nodes[0].inputs, strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-9, atol=1e-12)
    assert Recovery(lagging, LAWS["lqi"], LINE).depth == 2


def test_it_is_told_which_configuration_the_fallback_is():
    assert recovery_of("pid").fallback == config_hash(LAWS["pid"])


def test_the_monitor_takes_of_the_torques_sent_as_many_as_are_in_flight():
    measured, setpoint_n, in_flight_nm, torque_nm = at_rest()
    long_ago_nm = np.vstack((in_flight_nm, np.full((4, 6), 50.0)))
    assert recoverable(recovery_of(), measured, setpoint_n, long_ago_nm, torque_nm, None) == []
    away = replace_speed(measured, 2, 0.4)
    (finding,) = recoverable(recovery_of(), away, setpoint_n, long_ago_nm, torque_nm, None)
    (same,) = recoverable(recovery_of(), away, setpoint_n, in_flight_nm, torque_nm, None)
    assert finding == same


def test_the_monitor_asks_with_what_a_running_fallback_remembers():
    """At set-points that have stepped: what runs jumps after them, what takes over does not jump."""
    measured, setpoint_n, *sent = given = at_rest()
    stepped = (measured, setpoint_n + 6.0, *sent)
    (finding,) = recoverable(recovery_of(), *stepped, running(LAWS["lqi"], *given))
    assert (finding.rule, finding.action) == ("unrecoverable-speed", Action.STOP)
    assert finding.parameters["roller"] == 6
    assert recoverable(recovery_of(), *stepped, None) == []


def test_equilibrium_is_what_stays():
    """Of the support itself: with the torques of `equilibrium` the law that runs moves nothing."""
    v_eq, u_eq = equilibrium()
    x = np.concatenate((TENSION_N, v_eq))
    truth, asked_nm, _ = rolled_out(LAWS["lqi"], x, u_eq, u_eq, 61)
    np.testing.assert_allclose(truth, np.repeat(x[None], 61, axis=0), atol=1e-9)
    np.testing.assert_allclose(asked_nm, np.repeat(u_eq[None], 61, axis=0), atol=1e-9)
