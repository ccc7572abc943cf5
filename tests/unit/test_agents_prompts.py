"""The prompts of the agents name the questions that each is asked, and the options by their names."""

import pytest

from agents.monitoring.diagnosis import NONE_OF_THEM
from agents.roles import ROLES
from gateway.cli.commission_questions import LEAST, LEAST_SIZE, MORE_DATA, MOST, MOST_SIZE, PROPOSE, option_id
from gateway.commissioning import design_questions, tuning_question
from gateway.commissioning.design_questions import FIRST, LINEARISED, NONLINEAR, PRIORITIES
from gateway.commissioning.past import Follows
from gateway.commissioning.tuning_question import NEXT, STOP
from gateway.core.questions import DECISIONS

#: They serve the notes, or come with monitoring.
UNASKED = {"identify.structure", "identify.method", "adapt.convergence", "monitor.detect", "monitor.action"}


@pytest.mark.parametrize("decision", [one for one in DECISIONS if one not in UNASKED and not one.startswith("run.")])
def test_each_agent_is_told_what_it_is_asked(decision: str):
    (role,) = (one for one in ROLES.values() if decision in one.decides)
    assert f"`{decision}`" in role.own_words
    assert all(f"`{decision}`" not in one.own_words for one in ROLES.values() if one is not role)


@pytest.mark.parametrize(
    ("agent", "options"),
    [
        ("sysid", [option_id(0), PROPOSE, MORE_DATA]),
        ("initial-control", [option_id(0), LINEARISED, NONLINEAR, PRIORITIES, NEXT, STOP, FIRST]),
        ("adaptation", [option_id(0), *Follows]),
        ("monitoring", [NONE_OF_THEM]),
    ],
)
def test_each_agent_is_told_its_options_by_the_names_that_it_has_to_give(agent, options: list[str]):
    assert [one for one in options if f"`{one}`" not in ROLES[agent].own_words] == []


def test_the_ranges_of_knobs_are_those_that_hold():
    assert f"{LEAST:g} to {MOST:g}" in ROLES["adaptation"].own_words
    assert f"{LEAST_SIZE:g} to {MOST_SIZE:g}" in ROLES["sysid"].own_words
    design = ROLES["initial-control"].own_words
    assert design.count(f"{LEAST:g} to {MOST:g}") == 2 and (LEAST, MOST) == (
        tuning_question.LEAST,
        tuning_question.MOST,
    )
    assert f"{design_questions.LEAST:g} to {design_questions.MOST:g}" in design
