"""What has been tried on a line, as the gate's list of proposals tells it."""

from types import SimpleNamespace

import pytest

from gateway.cli.commission_side import proposed_on_model
from gateway.commissioning.ladder import Next
from gateway.commissioning.past import Outcome, Step, named, past_of
from gateway.control.design import design_lqi, task_of
from gateway.core.controller import config_hash
from tests.unit.chain_support import LINE, asked, shown


def test_what_has_had_its_answer_on_the_accepted_model_is_known_by_its_hash():
    hash_ = config_hash(design_lqi(task_of(LINE)))
    model = SimpleNamespace(proposal=SimpleNamespace(kind="model"), stage="kept")
    assert proposed_on_model([shown("refused", ("corners",)), model]) == frozenset()
    assert proposed_on_model([model, shown("expired"), shown("refused", ("cool-down",))]) == frozenset()
    for answered in (shown("refused", ("corners",)), shown("rejected"), shown("kept"), shown("rolled-back")):
        assert proposed_on_model([model, answered]) == {hash_}


@pytest.mark.parametrize(
    ("stage", "rules", "why", "outcome"),
    [
        ("kept", (), "", Outcome.DONE),
        ("done", (), "", Outcome.DONE),
        ("done", (), "a torque was at a limit", Outcome.FAILED),
        ("waiting", (), "", Outcome.OPEN),
        ("probation", (), "", Outcome.OPEN),
        ("refused", ("cool-down",), "", Outcome.AGAIN),
        ("refused", ("cool-down", "corners: error"), "", Outcome.FAILED),
        ("rejected", (), "by anna", Outcome.FAILED),
        ("rolled-back", (), "tension 1 swings", Outcome.FAILED),
        ("superseded", (), "", Outcome.AGAIN),
    ],
)
def test_a_proposal_says_of_itself_where_in_the_chain_it_belongs(stage, rules, why, outcome):
    found = past_of(shown(stage, rules, why))
    assert (found.step, found.rung, found.outcome, found.why) == (Step.FIRST, 2, outcome, why)
    assert found.speed_m_per_s == (None if rules else 0.02)


def test_somebody_elses_proposal_that_nobody_has_decided_holds_nothing_up_and_a_forged_step_is_none():
    own = shown("waiting")
    of_others = own.model_copy(update={"proposal": own.proposal.model_copy(update={"evidence": []})})
    assert past_of(own).outcome is Outcome.OPEN and past_of(of_others).outcome is Outcome.AGAIN
    assert asked([past_of(of_others)]) == Next(Step.FIRST, 0)
    for evidence in (named(Step.EXPERIMENT, 0), named(Step.FIRST, -3)):
        forged = own.proposal.model_copy(update={"evidence": [evidence]})
        assert past_of(own.model_copy(update={"proposal": forged})).step is None
