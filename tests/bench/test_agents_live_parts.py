"""Parts of the bench of agents beside a running line that need no line."""

from typing import get_args

import pytest

from gateway.commissioning.decisions import Decided
from gateway.core.questions import Choice, usual_choice
from gateway.supervisor.agents_cases import Case as Recorded
from tests.bench.agents_live import AGENT, CASES, Case, _wrong, healthy
from tests.bench.figures import GOALS
from tests.unit.language_model_support import QUESTION


def test_every_case_has_a_goal_and_every_way_of_failing_a_case() -> None:
    goals = {name.removeprefix("lateness_p99_ratio_") for name in GOALS["agents-live"] if "ratio" in name}
    assert goals == {case.name for case in CASES}
    assert {record for case in CASES for record in case.records} == set(get_args(Recorded))


@pytest.mark.parametrize(
    ("by", "decided", "wrong"),
    [
        ("rules", Decided(usual_choice(QUESTION), "rules", "nobody answers"), ""),
        ("rules", Decided(Choice(option="mpc", reason="a"), "rules"), "the rules chose mpc"),
        ("rules", Decided(usual_choice(QUESTION), AGENT), "decided by adaptation"),
        (AGENT, Decided(usual_choice(QUESTION), "rules", "late"), "decided by rules: late"),
        (AGENT, Decided(Choice(option="pid-calm", factors={"torque": 2.0}, reason="a"), AGENT), ""),
        (AGENT, Decided(Choice(option="pid-calm", factors={"torque": 1e9}, reason="a"), AGENT), "factors.torque"),
    ],
)
def test_an_answer_by_somebody_else_or_of_another_kind_is_told(by: str, decided: Decided, wrong: str) -> None:
    found = _wrong(Case(healthy, frozenset(), by), decided)
    assert found.startswith(wrong) and bool(found) == bool(wrong)
