"""What is predicted of a fallback, against the same line simulated step by step with the laws that really run."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.control.design.sampling import with_dead_time
from gateway.control.engagement import memory
from gateway.control.law import Measured
from gateway.control.laws import make_law
from gateway.control.reference import Steady
from gateway.core.web_model import linearise
from safety.actions import Action
from safety.limits import envelope_limits
from safety.monitor import recoverable
from safety.recoverability import Recovery
from safety.recovery_prediction import recovery_prediction
from tests.safety.recovery_support import (
    LAWS,
    LINE,
    MOST_NM,
    SPEED,
    STEP_NM,
    TENSION_N,
    THETA,
    at_rest,
    disturbed,
    equilibrium,
    recovery_of,
    replace_speed,
    rolled_out,
)


@pytest.mark.parametrize("size", [1.0, 8.0, 60.0])  # the greater ones meet torque rates and limits
@pytest.mark.parametrize("name", LAWS)
def test_the_prediction_is_what_the_law_does_with_the_model(name, size):
    config = LAWS[name]
    x, before_nm, torque_nm = disturbed(size)
    recovery = recovery_of(name)
    found, looks = recovery.ahead(Measured(x[:6], x[6:], SPEED), TENSION_N, before_nm[None], torque_nm)
    truth = rolled_out(config, x, before_nm, torque_nm, recovery.periods + 1)[0][:, :6]
    assert looks[-1] <= recovery.periods
    # The model is linear near the recipe's tensions in both; a schedule's law is that of the node's speed.
    scheduled = 0.2 if name == "scheduled" else 0.0
    np.testing.assert_allclose(found[:6].T, truth[looks], atol=1e-3 * max(1.0, size / 10.0) + scheduled * size)


@pytest.mark.parametrize("name", ["lqi", "lqg", "lqr", "pid"])
def test_a_fallback_that_runs_already_is_predicted_with_what_it_remembers(name):
    config, reference = LAWS[name], Steady(TENSION_N)
    x, before_nm, torque_nm = disturbed(2.0)
    law = make_law(config)
    measured = Measured(x[:6].copy(), x[6:].copy(), SPEED)
    state = law.engage(measured, reference, before_nm)
    for _ in range(3):  # it has run: nothing in it is as if it took over now
        decision = law.ask(state, measured, reference)
        state = law.commit(state, decision, torque_nm)
    recovery = recovery_of(name)
    given = (Measured(x[:6], x[6:], SPEED), TENSION_N, before_nm[None], torque_nm)
    found, looks = recovery.ahead(*given, memory(state))
    other, _ = recovery.ahead(*given)
    v_eq, u_eq = equilibrium()
    x_eq = np.concatenate((TENSION_N, v_eq))
    plant = with_dead_time(*linearise(THETA.web, TENSION_N, v_eq, SPEED), LINE.control.period_s, THETA.latency_s)
    sent, truth = [torque_nm, before_nm], []
    for _ in range(int(looks[-1]) + 1):
        x = x_eq + plant.transition @ (x - x_eq) + sum(
            G @ (u - u_eq) for G, u in zip(plant.inputs, sent, strict=True)
        )  # fmt: skip
        truth.append(x[:6])
        decision = law.ask(state, Measured(x[:6].copy(), x[6:].copy(), SPEED), reference)
        now = np.clip(np.clip(decision.torque_nm, sent[0] - STEP_NM, sent[0] + STEP_NM), -MOST_NM, MOST_NM)
        state, sent = law.commit(state, decision, now), [now, sent[0]]
    np.testing.assert_allclose(found[:6].T, np.array(truth)[looks], atol=1e-3)
    assert np.abs(found[:6, 5:20].max() - other[:6, 5:20].max()) > 1e-3


def test_a_line_at_rest_is_recoverable_and_one_that_runs_away_is_not():
    recovery = recovery_of()
    measured, setpoint_n, in_flight_nm, torque_nm = at_rest()
    assert recovery.shortfall(measured, setpoint_n, in_flight_nm, torque_nm) is None
    away = replace_speed(measured, 2, 0.4)  # roller 3 runs ahead: span 3 is pulled, span 4 goes slack
    short = recovery.shortfall(away, setpoint_n, in_flight_nm, torque_nm)
    assert short is not None and short.what == "span" and short.index in (2, 3)


def test_what_is_sent_now_counts_before_it_acts():
    measured, setpoint_n, in_flight_nm, torque_nm = at_rest()
    recovery, wild = recovery_of(), torque_nm + np.array([0.0, 0.0, 40.0, 0.0, 0.0, 0.0])
    away = measured
    for more in np.arange(0.05, 0.5, 0.01):  # as far as the fallback still recovers it
        if recovery.shortfall(replace_speed(measured, 2, more), setpoint_n, in_flight_nm, torque_nm) is not None:
            break
        away = replace_speed(measured, 2, more)
    assert away is not measured
    assert recovery.shortfall(away, setpoint_n, in_flight_nm, wild) is not None
    assert recovery.shortfall(away, setpoint_n, wild[None], torque_nm) is not None


def test_a_setpoint_near_a_limit_needs_half_of_what_it_keeps_itself():
    recovery = recovery_of()
    setpoint_n = TENSION_N.copy()
    setpoint_n[2] = LINE.limits.tension_min_n + 2.0
    there, *rest = at_rest(setpoint_n)
    assert recovery.shortfall(there, *rest) is None
    below = replace(there, tension_n=setpoint_n - np.eye(6)[2] * 1.5)
    assert recovery.shortfall(below, *rest).index == 2


def test_a_draw_span_is_not_looked_at():
    measured, *rest = at_rest()
    line = LINE.model_copy(
        update={"spans": [s.model_copy(update={"control": "draw"}) if i == 1 else s for i, s in enumerate(LINE.spans)]}
    )
    config = LAWS["lqi"].model_copy(update={"draw_spans": [1]})
    recovery = Recovery(recovery_prediction(THETA, config, line, [SPEED]), config, line)
    nobody_knows = replace(measured, tension_n=np.where(np.arange(6) == 1, np.nan, measured.tension_n))
    assert recovery.shortfall(nobody_knows, *rest) is None


def test_the_monitor_says_what_is_short_and_nothing_without_a_model():
    measured, setpoint_n, in_flight_nm, torque_nm = at_rest()
    assert recoverable(None, measured, setpoint_n, in_flight_nm, torque_nm, None) == []
    assert recoverable(recovery_of(), measured, setpoint_n, in_flight_nm, torque_nm, None) == []
    away = replace_speed(measured, 2, 0.4)
    (finding,) = recoverable(recovery_of(), away, setpoint_n, in_flight_nm, torque_nm, None)
    assert finding.rule == "unrecoverable-tension" and finding.action is Action.STOP and finding.parameters["span"] > 2


def test_a_step_leaves_rollers_a_tenth_of_the_room_that_the_monitor_watches():
    """The least step of all set-points that is too large for the monitor, and for a step that is foreseen."""
    config, reference = LAWS["lqi"], Steady(TENSION_N)
    v_eq, u_eq = equilibrium()
    measured = Measured(TENSION_N.copy(), v_eq.copy(), SPEED)
    law = make_law(config)
    state = law.engage(measured, reference, u_eq)
    state = law.commit(state, law.ask(state, measured, reference), u_eq)
    recovery = recovery_of()
    given = (u_eq[None], u_eq, memory(state))
    watched = envelope_limits(LINE).roller_speed_watched_m_per_s
    assert recovery.shortfall_of_step(measured, TENSION_N, *given) is None

    def fastest(step_n):
        return float(np.abs(recovery.ahead(measured, TENSION_N + step_n, *given)[0][6:]).max())

    for step_n in np.linspace(0.5, 12.0, 24):
        short, stopped = (look(measured, TENSION_N + step_n, *given) for look in looks_of(recovery))
        assert (stopped is None) or stopped.what == "roller"
        assert (short is not None) == (fastest(step_n) > SPEED + 0.9 * (watched - SPEED))
        assert (stopped is not None) == (fastest(step_n) > watched)
    assert short is not None and short.allowed == pytest.approx(0.1427, abs=1e-4)


def test_a_step_leaves_more_room_than_it_would_be_stopped_for():
    config = LAWS["lqi"]
    recovery = recovery_of()
    v_eq, u_eq = equilibrium()
    measured = Measured(TENSION_N.copy(), v_eq, SPEED)
    law = make_law(config)
    state = law.engage(measured, Steady(TENSION_N), u_eq)
    given = (u_eq[None], u_eq, memory(law.commit(state, law.ask(state, measured, Steady(TENSION_N)), u_eq)))
    low_n, told = LINE.limits.tension_min_n, set()
    for down_n in np.linspace(2.0, TENSION_N[5] - low_n - 1.0, 200):
        asked = TENSION_N - down_n * np.eye(6)[5]
        lowest_n = recovery.ahead(measured, asked, *given)[0][:6].min(axis=1)
        margin_n = np.minimum(6.0, 0.5 * (asked - low_n))
        short, stopped = (look(measured, asked, *given) for look in looks_of(recovery))
        if (stopped or short) is None or (stopped or short).what == "span":
            assert (stopped is not None) == bool((lowest_n < low_n + margin_n).any())
            assert (short is not None) == bool((lowest_n < low_n + 1.1 * margin_n).any())
        told.add((short is not None, stopped is not None))
    assert (True, False) in told and (False, True) not in told


def looks_of(recovery):
    return recovery.shortfall_of_step, recovery.shortfall
