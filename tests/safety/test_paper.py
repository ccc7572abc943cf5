"""The paper's filter beside the verdict: what each criterion measures, its limit, and what a person reads of it."""

from dataclasses import dataclass, field, replace
from math import nan
from typing import Any

import numpy as np
import pytest

from gateway.control.design import design_mpc
from gateway.control.judged_courses import improvement_courses
from gateway.control.rollout import Rollouts, Setup, plants_of_thetas, simulate
from gateway.core.verdict import RuleFinding
from safety import programme
from safety.findings import told
from safety.performance import LOST, Figures
from safety.rules import paper
from safety.simulated import judged_of
from tests.safety.case_support import case_of, gains
from tests.safety.test_gate_corners import rollouts

BETTER, WORSE = Figures(1.0, 2.0, 2.0, 9.0), Figures(3.0, 4.0, 12.0, 1.0)  #: norms without effort: 3 and 13
APPROVED = told("paper: approve", True, "the paper's filter would approve it")
REJECTED = told("paper: approve", False, "the paper's filter would reject it")


@dataclass
class Loop:
    """What is found course by course, in one drive each, in place of what simulations would; and what they were."""

    torque_nm: tuple[float, float] = (30.0, 12.0)
    step_nm: tuple[float, float] = (5.0, 2.0)
    off_n: float = -7.25  #: from its set-point, in one sample of one span of the last plant
    performances: dict[str, dict[str, Figures]] = field(
        default_factory=lambda: {"in service": {"tension": WORSE}, "proposed": {"tension": BETTER}}
    )
    seen: list[tuple[int, Setup]] = field(default_factory=list)  #: numbers of plants, and how the loop was closed

    def simulate(self, config: Any, plants: Any, course: Any, setup: Setup, *, record: bool = False) -> Rollouts:
        self.seen.append((plants.count, setup))
        if record:
            tension = np.repeat(course.tension_n[None], plants.count, axis=0)
            tension[-1, 7, 3] += self.off_n
            return replace(rollouts(), tension_n=tension)
        torque, step = np.full((1, 6), -1.0), np.full((1, 6), 0.0)
        torque[0, 4], step[0, 2] = self.torque_nm[len(self.seen) - 1], self.step_nm[len(self.seen) - 1]
        return replace(rollouts(), torque_max_nm=torque, torque_step_max_nm=step)


@pytest.fixture
def loop(monkeypatch):
    loop = Loop()
    monkeypatch.setattr(paper, "simulate", loop.simulate)
    monkeypatch.setattr(paper, "performances", lambda _: loop.performances)
    return loop


def found(rule, passed, value, limit, unit, text):
    margin = None if value is None else limit - value
    return RuleFinding(rule=f"paper: {rule}", passed=passed, text=f"{rule}: {text}", value=value, limit=limit,
                       margin=margin, unit=unit)  # fmt: skip


def with_limits(case, **changes):
    return replace(case, line=case.line.model_copy(update={"limits": case.line.limits.model_copy(update=changes)}))


def test_a_configuration_that_meets_all_three_is_approved(case, loop):
    assert paper.check(case) == [
        found("C_safe", True, 0.5, 1.0, "",
              "the law asks for up to 30.0 Nm and 500 Nm/s; allowed: 60 Nm and 1000 Nm/s"),
        found("P_improved", True, 3.0, 13.0, "", "||P|| is 3 in tension; allowed: below 13, as in service"),
        found("S_robust", True, 7.25, 1.2 * 24.0, "N",
              "tension is up to 7.2 N from its set-point (neighbours); allowed: below 28.8 N"),
        APPROVED,
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("torque_nm", "step_nm", "share", "passed", "asked"),
    [
        ((60.0, 12.0), (5.0, 2.0), 1.0, True, "60.0 Nm and 500 Nm/s"),
        ((30.0, 12.0), (2.0, 10.0), 1.0, True, "30.0 Nm and 1000 Nm/s"),
        ((12.0, 66.0), (5.0, 2.0), 1.1, False, "66.0 Nm and 500 Nm/s"),
        ((30.0, 12.0), (12.5, 2.0), 1.25, False, "30.0 Nm and 1250 Nm/s"),
        ((0.75, 0.25), (0.0, 0.001), 0.0125, True, "0.8 Nm and 0 Nm/s"),
    ],
)
def test_c_safe_is_the_greater_share_of_torque_and_rate(case, loop, torque_nm, step_nm, share, passed, asked):
    loop.torque_nm, loop.step_nm = torque_nm, step_nm
    safe, _, _, approve = paper.check(case)
    assert (safe.rule, safe.passed, safe.unit) == ("paper: C_safe", passed, "")
    assert (safe.value, safe.limit) == (pytest.approx(share), 1.0)
    assert safe.text == f"C_safe: the law asks for up to {asked}; allowed: 60 Nm and 1000 Nm/s"
    assert approve == (APPROVED if passed else REJECTED)


def test_c_safe_is_of_a_loop_in_which_nothing_is_limited_and_nothing_is_late(case):
    """Of a line with limits that it would not keep."""
    tight = with_limits(case, torque_nm=24.0, torque_rate_nm_per_s=100.0)
    noise, most_nm, most_nm_per_s = case.noise, 0.0, 0.0
    free = Setup(0.01, 0.0, 2, tension_noise_n=noise.tension_n, speed_noise_m_per_s=noise.speed_m_per_s,
                 acceleration_m_per_s1_5=noise.acceleration_m_per_s1_5, seed=case.seed)  # fmt: skip
    for course in improvement_courses(judged_of(case)).values():
        run = simulate(case.controller, plants_of_thetas([case.believed]), course, free, record=True)
        most_nm = max(most_nm, np.abs(run.torque_nm).max())
        most_nm_per_s = max(most_nm_per_s, np.abs(np.diff(run.torque_nm, axis=1)).max() / 0.01)
    assert most_nm > 24.0 and most_nm_per_s > 2.0 * 100.0
    safe = paper.check(tight)[0]
    assert not safe.passed
    assert safe.value == pytest.approx(max(most_nm / 24.0, most_nm_per_s / 100.0), rel=1e-6)
    assert f"up to {most_nm:.1f} Nm and {most_nm_per_s:.0f} Nm/s; allowed: 24 Nm and 100 Nm/s" in safe.text


@pytest.mark.parametrize(
    ("now", "proposed", "value", "passed", "text"),
    [
        ({"velocity": BETTER, "tension": WORSE}, {"velocity": WORSE, "tension": BETTER}, 3.0, True,
         "||P|| is 3 in tension; allowed: below 13, as in service"),
        ({"velocity": WORSE, "moves": BETTER}, {"velocity": BETTER, "moves": WORSE}, 3.0, True,
         "||P|| is 3 in velocity; allowed: below 13, as in service"),
        ({"tension": WORSE}, {"tension": WORSE}, 13.0, False,
         "||P|| is 13 in tension; allowed: below 13, as in service"),
        ({"tension": WORSE}, {"tension": LOST}, None, False,
         "||P|| is inf in tension; allowed: below 13, as in service"),
    ],
)  # fmt: skip
def test_p_improved_is_less_than_in_service_in_steps_of_tension_where_there_are_any(
    case, loop, now, proposed, value, passed, text
):
    loop.performances = {"in service": now, "proposed": proposed}
    _, improved, _, approve = paper.check(case)
    assert improved == found("P_improved", passed, value, 13.0, "", text)
    assert approve == (APPROVED if passed else REJECTED)


@pytest.mark.parametrize(
    ("step_n", "off_n", "limit", "passed", "text"),
    [
        (24.0, 30.0, 1.2 * 24.0, False, "30.0 N from its set-point (neighbours); allowed: below 28.8 N"),
        (0.5, -0.5, 0.6, True, "0.5 N from its set-point (neighbours); allowed: below 0.6 N"),
        (0.5, 0.75, 0.6, False, "0.8 N from its set-point (neighbours); allowed: below 0.6 N"),
        (0.0, 3.75, 4.0, True, "3.8 N from its set-point (speed change); allowed: below 4.0 N"),
        (0.0, 4.0, 4.0, False, "4.0 N from its set-point (speed change); allowed: below 4.0 N"),
        (24.0, nan, 1.2 * 24.0, False, "inf N from its set-point (neighbours); allowed: below 28.8 N"),
    ],
)
def test_s_robust_is_below_the_largest_step_and_a_fifth_or_a_fifth_of_the_least_set_point(
    case, loop, step_n, off_n, limit, passed, text
):
    loop.off_n = off_n
    robust, approve = paper.check(with_limits(case, tension_step_max_n=step_n))[2:]
    off = None if not np.isfinite(off_n) else pytest.approx(abs(off_n))
    assert (robust.rule, robust.passed, robust.unit) == ("paper: S_robust", passed, "N")
    assert (robust.value, robust.limit) == (off, pytest.approx(limit))
    assert robust.text == f"S_robust: tension is up to {text}"
    assert approve == (APPROVED if passed else REJECTED)


def test_s_robust_is_of_eight_corners_and_of_two_for_a_programme_none_of_them_late(of, context, redesigned, loop):
    def looked_at(config):
        loop.seen.clear()
        case = case_of(gains(config, context), context, of, corners=12)
        assert len(case.corners) == 12
        paper.check(case)
        count, setup = loop.seen[-1]
        assert setup.late_share == 0.0 and setup.torque_nm == 60.0
        return count

    assert looked_at(redesigned) == 8
    mpc = design_mpc(of.task())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(programme, "fails_in_small", lambda _: False)
        assert looked_at(mpc) == 2


def test_corners_that_no_torque_holds_are_told(case, loop):
    robust, approve = paper.check(with_limits(case, torque_nm=5.0))[2:]
    assert robust == told("paper: S_robust", False, "S_robust: no corner is held by the torque")
    assert approve == REJECTED


def test_a_programme_that_fails_in_small_moves_is_not_looked_at(of, context, loop, monkeypatch):
    monkeypatch.setattr(programme, "fails_in_small", lambda _: True)
    text = "not looked at: it is refused for its small moves already"
    assert paper.check(case_of(gains(design_mpc(of.task()), context), context, of)) == [
        told(f"paper: {name}", False, text) for name in ("C_safe", "P_improved", "S_robust", "approve")
    ]
    assert not loop.seen
