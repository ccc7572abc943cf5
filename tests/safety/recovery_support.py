"""A line near one speed, laws for it, and what they really do with its linear model, step by step."""

from dataclasses import replace

import numpy as np

from gateway.control.design import design_lqg, design_lqi, design_lqr, design_pid, design_scheduled, task_of
from gateway.control.design.sampling import with_dead_time
from gateway.control.law import Measured
from gateway.control.laws import make_law
from gateway.control.reference import Steady
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.theta import nominal_theta
from gateway.core.web_model import equilibrium_torque, linearise, reference_speeds
from safety.recoverability import Recovery
from safety.recovery_prediction import recovery_prediction

LINE = load_line(line_template(6, "line.toml"), "line.toml")
TASK = task_of(LINE)
THETA = nominal_theta(LINE)
LAWS = {
    "lqi": design_lqi(TASK),
    "lqg": design_lqg(TASK),
    "lqr": design_lqr(TASK),
    "pid": design_pid(TASK),
    "scheduled": design_scheduled(TASK, design_lqi, [0.02, 0.1]),
}
TENSION_N, SPEED = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0]), 0.05
STEP_NM, MOST_NM = LINE.limits.torque_rate_nm_per_s * LINE.control.period_s, LINE.limits.torque_nm


def limited(**limits):
    """The line with other limits."""
    return LINE.model_copy(update={"limits": LINE.limits.model_copy(update=limits)})


def recovery_of(name="lqi", line=LINE, speeds=(SPEED,), theta=THETA, **changes):
    return Recovery(recovery_prediction(theta, LAWS[name], line, list(speeds), **changes), LAWS[name], line)


def equilibrium(tension_n=TENSION_N, speed=SPEED):
    """Roller speeds and torques at which everything stays."""
    v_eq = reference_speeds(THETA.web, tension_n, speed)
    return v_eq, equilibrium_torque(THETA.web, tension_n, v_eq)


def at_rest(tension_n=TENSION_N, speed=SPEED):
    v_eq, u_eq = equilibrium(tension_n, speed)
    return Measured(tension_n.copy(), v_eq, speed), tension_n, u_eq[None], u_eq


def replace_speed(measured, roller, more):
    speed = measured.speed_m_per_s.copy()
    speed[roller] += more
    return replace(measured, speed_m_per_s=speed)


def disturbed(size, seed=0):
    dice = np.random.default_rng(seed)
    v_eq, u_eq = equilibrium()
    # Beyond what an observer takes to be at its set-point, so that prediction and law mean the same.
    away_n = np.sign(dice.normal(size=6)) * dice.uniform(1.0, 2.0, 6) * size
    before_nm, torque_nm = u_eq + dice.normal(size=(2, 6)) * size
    return np.concatenate((TENSION_N + away_n, v_eq + dice.normal(size=6) * 1e-3 * size)), before_nm, torque_nm


def rolled_out(config, x, before_nm, torque_nm, periods, line=LINE):
    """Under the law that really runs, engaged after a period: states (periods, 2n) and torques asked and sent."""
    web, n = THETA.web, 6
    step_nm, most_nm = line.limits.torque_rate_nm_per_s * line.control.period_s, line.limits.torque_nm
    v_eq, u_eq = equilibrium()
    x_eq = np.concatenate((TENSION_N, v_eq))
    plant = with_dead_time(*linearise(web, TENSION_N, v_eq, SPEED), line.control.period_s, THETA.latency_s)
    flight, law, state = [before_nm] * plant.depth, make_law(config), None
    found, asked_nm, sent_nm = [], [], [torque_nm]
    for k in range(periods + 1):
        if k > 0:
            measured = Measured(x[:n].copy(), x[n:].copy(), SPEED)
            reference = Steady(TENSION_N)
            state = law.engage(measured, reference, torque_nm) if state is None else state
            decision = law.ask(state, measured, reference)
            asked = np.clip(decision.torque_nm, torque_nm - step_nm, torque_nm + step_nm)
            torque_nm = np.clip(asked, -most_nm, most_nm)
            state = law.commit(state, decision, torque_nm)
            found.append(x)
            asked_nm.append(decision.torque_nm)
            sent_nm.append(torque_nm)
        sent = [torque_nm, *flight]
        x = x_eq + plant.transition @ (x - x_eq) + sum(
            G @ (u - u_eq) for G, u in zip(plant.inputs, sent, strict=True)
        )  # fmt: skip
        flight = sent[: plant.depth]
    return np.array(found), np.array(asked_nm), np.array(sent_nm)
