"""Rollers and spans with limits of their own: the loop, the gate and the check of the file go by them."""

from typing import Any

import numpy as np
import pytest

from gateway.control.judged_courses import Judged
from gateway.control.rollout import course_through, plants_of_thetas, simulate
from gateway.core.controller_laws import LqiConfig
from gateway.core.line import Line
from gateway.core.line_defaults import derived_defaults
from gateway.core.line_file import LineRefused, load_line
from gateway.core.line_template import line_template
from gateway.core.signals import DriveState
from gateway.core.theta import Noise, nominal_theta
from safety.case import Case
from safety.envelope import EnvelopeState, Supervision, check_inputs, limit_torque
from safety.limits import envelope_limits
from safety.rules import corners
from safety.simulated import holdable, setup_of
from tests.safety.case_support import gains, published
from tests.safety.envelope_support import healthy

PRODUCTION = Supervision(True, False, True, DriveState.ENABLED, True)


def with_own(line: Line, torque_nm: float | None = None, **band: Any) -> Line:
    """Roller 2 and span 2 with their own."""
    rollers, spans = list(line.rollers), list(line.spans)
    rollers[1] = rollers[1].model_copy(update={"torque_nm": torque_nm})
    spans[1] = spans[1].model_copy(update=band)
    return line.model_copy(update={"rollers": rollers, "spans": spans})


def text_with(roller: str = "", span: str = "") -> str:
    text = line_template(3).replace('name = "roller-2"\n', f'name = "roller-2"\n{roller}\n')
    return text.replace('name = "span-2"\n', f'name = "span-2"\n{span}\n')


LINE = load_line(text_with("torque_nm = 20.0", "tension_min_n = 5.0\ntension_max_n = 40.0"), "line.toml")


def test_torque_is_cut_at_each_drives_own_limit() -> None:
    limits = envelope_limits(LINE)
    cut = limit_torque(limits, np.full(3, 100.0), np.array([55.0, 15.0, 55.0]), 0.01)
    assert cut.tolist() == [60.0, 20.0, 60.0]
    assert limit_torque(limits, np.full(3, -100.0), np.array([-55.0, -15.0, -55.0]), 0.01).tolist() == [
        -60.0,
        -20.0,
        -60.0,
    ]


@pytest.mark.parametrize(("tension_n", "rule"), [(41.0, "tension-high"), (4.0, "slack"), (39.0, None), (6.0, None)])
def test_the_band_is_each_spans_own(tension_n: float, rule: str | None) -> None:
    limits, state = envelope_limits(LINE), EnvelopeState()
    for span, found_here in ((1, rule), (0, None)):
        inputs = healthy()
        inputs.tension.put(2, 30.0, 1.0)
        inputs.tension.put(span, tension_n, 1.0)
        state = EnvelopeState()
        for _ in range(2):
            seen, state = check_inputs(limits, state, inputs, PRODUCTION)
        assert [finding.rule for finding in seen.findings] == ([found_here] if found_here else [])
        assert all((one.parameters["low_n"], one.parameters["high_n"]) == (5.0, 40.0) for one in seen.findings)


def test_where_all_are_alike_they_are_one_number() -> None:
    limits = envelope_limits(with_own(LINE, None, tension_min_n=None, tension_max_n=None))
    assert (limits.torque_nm, limits.tension_min_n, limits.tension_max_n) == (60.0, 2.0, 60.0)


@pytest.mark.parametrize(
    ("roller", "span", "where", "says"),
    [
        ("torque_nm = 61.0", "", "rollers[2].torque_nm", "is more than all drives have in common"),
        ("", "tension_max_n = 61.0", "spans[2].tension_max_n", "is outside of what all spans have in common"),
        ("", "tension_min_n = 1.0", "spans[2].tension_min_n", "is outside of what all spans have in common"),
        ("", "tension_min_n = 38.5\ntension_max_n = 40.0", "spans[2].tension_max_n", "leaves no room for a set-point"),
        ("", "tension_max_n = 30.0", "recipes[1].tension_n[2]", "the limits exclude this set-point"),
        ("torque_nm = 0.5", "", "recipes[1]", "needs"),
    ],
)
def test_the_check_says_what_is_wrong_with_them(roller: str, span: str, where: str, says: str) -> None:
    with pytest.raises(LineRefused) as refused:
        load_line(text_with(roller, span), "line.toml")
    problems = [str(problem) for problem in refused.value.problems]
    assert any(where in problem and says in problem for problem in problems), problems


def test_a_drive_must_give_its_rollers_own_torque_only() -> None:
    weak = text_with("torque_nm = 20.0").replace("rated_torque_nm = 60.0", "rated_torque_nm = 25.0")
    with pytest.raises(LineRefused) as refused:
        load_line(weak, "line.toml")
    assert len([problem for problem in refused.value.problems if "rated_torque_nm" in str(problem)]) == 2


def test_the_gate_keeps_them_too() -> None:
    of = published()
    context = of.context()
    given = gains(context.in_service, context)
    assert isinstance(context.in_service, LqiConfig)

    def judged(line: Line) -> dict[str, Any]:
        case = Case(line, context, given, "0" * 64, [of.recording], 1)
        return {found.rule: found for found in corners.check(case)}

    common, own = judged(of.line), judged(with_own(of.line, tension_max_n=34.0))
    highest = "corners: highest tension"
    assert (common[highest].limit, own[highest].limit) == (60.0, 34.0)
    assert own[highest].margin < common[highest].margin


def test_simulated_drives_give_no_more_than_their_own() -> None:
    of, config = published(), published().context().in_service
    line = with_own(of.line, 6.0)
    course = course_through(0.01, [(0.3, np.full(6, 20.0), 0.05), (1.0, np.full(6, 40.0), 0.05)])
    plants = plants_of_thetas([nominal_theta(line)])
    run = simulate(config, plants, course, setup_of(line, Noise(0.0, 0.0, 0.0), 1, 0.0), record=True)
    most_nm = np.abs(run.torque_nm[0]).max(axis=0)
    assert most_nm[1] <= 6.0 < most_nm[2]
    assert not holdable([nominal_theta(line)], course, np.array([60.0, 0.1, 60.0, 60.0, 60.0, 60.0]))
    assert holdable([nominal_theta(line)], course, 60.0)


def test_steps_are_judged_within_each_spans_own_band() -> None:
    low, high = Judged(LINE, np.array([28.0, 36.0, 20.0]), 0.05, 24.0, 0.05).levels()
    assert low[1] >= 6.0 and high[1] <= 39.0 and high[0] - low[0] == pytest.approx(24.0)


def test_ramps_are_as_steep_as_each_roller_follows_within_its_own_torque() -> None:
    common, own = (derived_defaults(with_own(LINE, torque_nm))["moves"] for torque_nm in (60.0, 6.0))
    for key in ("stop_rate_m_per_s2", "speed_rate_m_per_s2"):
        assert own[key] == pytest.approx(common[key] / 10.0)
