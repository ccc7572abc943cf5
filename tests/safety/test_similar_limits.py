"""Every limit that is derived from a line grows with the line, in the unit that its name says."""

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest

from gateway.control.design import design_lqi, task_of
from gateway.control.judged_courses import near_m_per_s as near_asked
from gateway.core.line import Line
from gateway.core.line_scales import line_scales, longest_step_of, runaway_n
from gateway.core.theta import expected_noise, nominal_theta
from safety.drift import drift_limits
from safety.excitation import least_seconds, near_m_per_s
from safety.frozen import turning_m_per_s
from safety.impossible import value_limits
from safety.jumps import jump_limits
from safety.limits import envelope_limits
from safety.monitor import monitor_limits
from safety.recovery_prediction import recovery_prediction
from safety.rejections import rejections
from safety.simulated import setup_of
from safety.stuck import stuck_limits
from tests.closed_loop.conftest import demo_line
from tests.support.similar import Similar

SIZES = [Similar(force=2.0**-9), Similar(length=2.0**6), Similar(time=0.5), Similar(2.0**8, 2.0**3, 2.0)]


def of_numbers(line: Line) -> dict[str, float]:
    """What is one number, under a name with its unit."""
    law, speed_m_per_s = design_lqi(task_of(Similar().line(demo_line(3)))), line.limits.speed_max_m_per_s
    recovery = recovery_prediction(nominal_theta(line), law, line, [speed_m_per_s])
    return {
        "turning_m_per_s": turning_m_per_s(line), "runaway_n": runaway_n(line), "step_s": longest_step_of(line),
        "near_m_per_s": near_m_per_s(0.0, line), "asked_m_per_s": near_asked(line), "least_s": least_seconds(line),
        "parting_m_per_s": envelope_limits(line).parting_m_per_s, "horizon_s": recovery.horizon_s,
        "standstill_m_per_s": envelope_limits(line).standstill_m_per_s, "margin_n": recovery.margin_n,
        "response_s": line_scales(line).response_s,
    }  # fmt: skip


LIMITS: dict[str, Any] = {
    "scales": line_scales,
    "noise": expected_noise,
    "jumps": lambda line: jump_limits(line, np.zeros(line.n)),
    "values": lambda line: value_limits(line, np.zeros(line.n)),
    "drift": drift_limits,
    "envelope": envelope_limits,
    "monitor": monitor_limits,
    "rejections": rejections,
    "stuck": stuck_limits,
    "setup": lambda line: setup_of(line, expected_noise(line), 1, 0.05),
    "numbers": of_numbers,
}


def compare(size: Similar, name: str, one: Any, other: Any) -> None:
    """`other` is `one`, larger by what `size` says of the unit in `name`; without a unit it is the same."""
    if is_dataclass(one):
        for field in fields(one):
            compare(size, field.name, getattr(one, field.name), getattr(other, field.name))
    elif isinstance(one, dict):
        for key in one:
            compare(size, key, one[key], other[key])
    elif isinstance(one, float | np.ndarray):
        assert np.array_equal(np.asarray(one) * size.of(name), np.asarray(other)), (name, one, other)
    else:
        assert one == other, name


@pytest.mark.parametrize("what", LIMITS)
def test_limits_grow_with_the_line(what: str) -> None:
    line = Similar().line(demo_line(3))
    for size in SIZES:
        compare(size, what, LIMITS[what](line), LIMITS[what](size.line(line)))
