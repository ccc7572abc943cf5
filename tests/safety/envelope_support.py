"""A healthy line of three spans, the last one by draw, and what the envelope finds of its periods."""

import numpy as np

from gateway.core.signals import DriveState, Inputs, Quality
from safety.envelope import EnvelopeState, Supervision, check_inputs
from safety.limits import EnvelopeLimits

LIMITS = EnvelopeLimits(
    period_s=0.01,
    torque_nm=60.0,
    torque_rate_nm_per_s=1000.0,
    tension_min_n=2.0,
    tension_max_n=60.0,
    speed_max_m_per_s=0.12,
    hold_periods=3,
    measured=np.array([1.0, 1.0, 0.0]),
)
EVERYTHING = Supervision(True, False, True, DriveState.ENABLED, True)
AT_STANDSTILL = Supervision(True, True, False, DriveState.ENABLED, False)
TORQUE_FREE = Supervision(False, False, False, None, False)


def healthy():
    inputs = Inputs(3)
    for i in range(3):
        inputs.tension.put(i, 30.0, 1.0)
        inputs.speed.put(i, 0.05, 1.0)
        inputs.torque.put(i, 10.0, 1.0)
        inputs.drive_state[i] = DriveState.ENABLED
    inputs.unwind_speed.put(0, 0.05, 1.0)
    plc = inputs.plc
    plc.quality, plc.permissive, plc.emergency_stop, plc.running = Quality.GOOD, True, False, True
    return inputs


def story(*periods, supervision=EVERYTHING):
    """What is found in the last of these periods."""
    state = EnvelopeState()
    for inputs in periods:
        seen, state = check_inputs(LIMITS, state, inputs, supervision)
    return seen


def findings_after(count, inputs, supervision=EVERYTHING):
    return story(*[inputs] * count, supervision=supervision).findings
