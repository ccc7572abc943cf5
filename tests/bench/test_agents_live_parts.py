"""Parts of the bench of agents beside a running line that need no line."""

from typing import get_args

import pytest

from gateway.commissioning.decisions import Decided
from gateway.core.questions import Choice, usual_choice
from gateway.supervisor.agents_cases import RECORD_EVERY_S
from gateway.supervisor.agents_cases import Case as Recorded
from tests.bench.agents_live import AGENT, CASES, Case, _wrong, bench_of, healthy
from tests.bench.agents_live_records import SPARE_S, missing, settled_s
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


def test_in_the_healthy_case_an_agent_must_have_answered() -> None:
    (case,) = [one for one in CASES if one.begin is healthy]
    assert not _wrong(case, Decided(usual_choice(QUESTION), "rules"))
    assert "nobody answers" in _wrong(case, Decided(usual_choice(QUESTION), "rules", "nobody answers"))


KILLED = frozenset({"gone", "unanswered"})


def test_only_records_of_the_cases_own_window_count() -> None:
    records = [("gone", 90.0), ("unanswered", 105.0), ("gone", 131.0)]
    assert missing(KILLED, records, 100.0, 130.0) == {"gone"}
    assert not missing(KILLED, records, 100.0, 131.0)


@pytest.mark.parametrize(
    ("records", "until_s"),
    [
        ([("gone", 101.0), ("unanswered", 104.0), ("refused", 30.0)], 104.0),  # the newest of each kind
        ([("gone", 101.0), ("unanswered", 104.0), ("gone", 161.0)], 104.0),  # what came after the end is a rest of it
        ([("gone", 101.0)], 120.0),  # one is missing
        ([], 120.0),
    ],
)
def test_the_next_case_begins_when_nothing_of_this_one_is_outstanding(
    records: list[tuple[str, float]], until_s: float
) -> None:
    assert settled_s(KILLED, records, 100.0, 120.0) == until_s + RECORD_EVERY_S + SPARE_S


def test_a_case_of_which_nothing_is_on_record_waits_for_nothing() -> None:
    assert settled_s(frozenset(), [], 100.0, 120.0) == 120.0


def test_a_run_with_other_arguments_does_not_pass_for_the_whole() -> None:
    part, whole = bench_of(False, 1, ["--rounds", "1"]), bench_of(True, 3, [])
    assert (part.name, whole.name) == ("agents-live-part", "agents-live")
    assert part.goals_of == "agents-live" and part.command == 'make bench-agents-live ARGS="--rounds 1"'
