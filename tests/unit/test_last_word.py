"""What the rules propose in the end, in the place of what agents have led to."""

from dataclasses import replace
from datetime import UTC, datetime

import pytest

from gateway.cli.commission_changes import Changes, LineNow
from gateway.commissioning.candidates import FIRST_LAWS, Exhausted, Law, NotOffered, configuration
from gateway.commissioning.decisions import AGENTS, RULES
from gateway.commissioning.ladder import AS_IT_IS, BY_RULES, OWN, Ended, Next
from gateway.commissioning.past import Follows, Outcome, Step, past_of
from gateway.commissioning.redesign import CALM_PREDICTIVE, PREDICTIVE, Figures, no_worse, redesigns
from gateway.core.controller import config_hash
from gateway.core.deployment import Region
from tests.unit.chain_support import ADAPTED, after, asked, concluded, looked_at, shown
from tests.unit.test_redesign import LINE, MODEL, TENSION_N

#: As a late adversary leaves it: calm, and as good as any in a step that torque limits.
CALM = configuration(LINE, MODEL, 0.06, Law("lqi", (("torque_per_nm2", 4.0), ("integral_per_n2s2", 0.3))))
CHANGES = Changes(LINE)
BY_AGENTS = [*ADAPTED[:3], replace(ADAPTED[3], author=AGENTS)]


def at_the_end(past):
    """Measured and looked at: the chain would end."""
    return looked_at([*past, replace(after(asked(past), past), speed_m_per_s=0.12)])


def test_where_agents_have_chosen_what_is_in_service_the_rules_have_the_last_word_once():
    past = at_the_end(BY_AGENTS)
    step = asked(past)
    assert step == Next(Step.REDESIGN, BY_RULES) and not step.others and step.own <= 0
    refused = after(step, past, Outcome.FAILED)
    assert asked([*past, refused]) == Next(Step.REDESIGN, BY_RULES + 1)
    none = replace(refused, last=True)  # there is no design that promises as much
    assert isinstance(asked([*past, none]), Ended) and asked([*past, none]).converged
    kept = [*past, replace(after(step, past), speed_m_per_s=0.12)]
    assert asked(kept).step is Step.MEASUREMENT and isinstance(asked(at_the_end(kept)), Ended)


def test_the_last_word_is_had_whatever_agents_have_concluded_from_their_own_choices():
    past = concluded(BY_AGENTS, Follows.CALMER)
    past.append(replace(after(asked(past), past), speed_m_per_s=0.12, author=AGENTS))
    assert asked(concluded(past, Follows.LEAVE)) == Next(Step.REDESIGN, BY_RULES)


def test_the_last_word_is_had_where_the_rules_only_had_to_be_calmer_than_what_agents_had_chosen():
    past = concluded(BY_AGENTS, Follows.CALMER)
    past.append(replace(after(asked(past), past), speed_m_per_s=0.12))
    assert past[-1].author == RULES
    assert asked(concluded(past, Follows.LEAVE)) == Next(Step.REDESIGN, BY_RULES)


@pytest.mark.parametrize("since", [[], [replace(ADAPTED[3], rung=4)]])
def test_the_last_word_is_had_where_agents_have_replaced_a_design_of_the_rules(since):
    past = [*ADAPTED, replace(ADAPTED[3], rung=3, author=AGENTS), *since]
    assert asked(at_the_end(past)) == Next(Step.REDESIGN, BY_RULES)


@pytest.mark.parametrize(
    ("rung", "author", "left"),
    [(2, AGENTS, 2), (OWN, AGENTS, 0), (0, AGENTS, 0), (2, RULES, 0), (2, "anna", 0)],
)
def test_where_no_model_came_of_it_the_rules_propose_what_they_would_have_begun_with(rung, author, left):
    past = [replace(ADAPTED[0], rung=rung, author=author)]
    while isinstance(step := asked(past), Next) and step.rung < BY_RULES:
        past.append(after(step, past, Outcome.FAILED if step.step is Step.MODEL else Outcome.DONE))
    proposed = []
    while isinstance(step, Next):
        proposed.append(step.rung - BY_RULES)
        assert step.step is Step.FIRST and not step.others and step.own <= 0
        past.append(after(step, past, Outcome.FAILED))
        step = asked(past)
    assert proposed == list(range(left)) and not step.reached
    if left:
        kept = [*past[:-left], replace(past[-1], rung=BY_RULES, outcome=Outcome.DONE)]
        assert isinstance(asked(kept), Ended) and not asked(kept).reached


def test_the_rules_do_not_propose_what_they_would_have_begun_with_where_no_experiment_was_made():
    past = [replace(ADAPTED[0], rung=2, author=AGENTS)]
    while isinstance(step := asked(past), Next):
        assert step.step is Step.EXPERIMENT
        past.append(after(step, past, Outcome.FAILED))
    assert step.text.startswith("no experiment of 4")


def test_a_person_who_rejects_what_the_rules_would_have_is_not_asked_again():
    past = at_the_end(BY_AGENTS)
    wanted = asked(past)
    rejected = past_of(shown("rejected", step=wanted.step, rung=wanted.rung))
    assert rejected.rung == BY_RULES and isinstance(asked([*past, rejected]), Ended)


@pytest.mark.parametrize(
    "past",
    [
        ADAPTED,
        [*ADAPTED[:3], replace(ADAPTED[3], author="anna", step=None)],  # a person's own
        [replace(ADAPTED[0], author=AGENTS), *ADAPTED[1:]],
        [*BY_AGENTS, replace(ADAPTED[3], rung=BY_RULES), replace(ADAPTED[3], rung=4, author=AGENTS)],  # had already
        [*BY_AGENTS, replace(ADAPTED[3], author="anna", step=None), replace(ADAPTED[3], rung=4)],  # calmer than hers
    ],
)
def test_nobody_is_overruled_who_has_left_it_to_the_rules_or_is_a_person(past):
    assert isinstance(asked(at_the_end(past)), Ended)


def test_what_agents_began_with_and_stays_as_it_is_is_theirs():
    as_it_is = [replace(ADAPTED[0], author=AGENTS), *ADAPTED[1:3], replace(ADAPTED[3], rung=AS_IT_IS)]
    assert asked(at_the_end(as_it_is)) == Next(Step.REDESIGN, BY_RULES)


def test_the_last_word_comes_also_where_no_more_redesigns_are_wanted_and_not_where_it_is_not_had():
    assert asked(at_the_end(BY_AGENTS), most_redesigns=1) == Next(Step.REDESIGN, BY_RULES)
    assert isinstance(asked(at_the_end(ADAPTED), most_redesigns=1), Ended)
    assert isinstance(asked(at_the_end(BY_AGENTS), most_redesigns=1, last_word=False), Ended)


def now(in_service, model=MODEL):
    return LineNow(in_service, model, TENSION_N, 0.01, datetime(2026, 1, 5, tzinfo=UTC))


def by_rules(in_service, proposed=()):
    (offer,) = CHANGES.offers(Next(Step.REDESIGN, BY_RULES), now(in_service), [], Region(), proposed)
    return offer


@pytest.mark.slow
def test_it_is_a_tenth_better_in_a_course_and_says_what_it_promises_in_each():
    offer = by_rules(CALM)
    shares = offer.redesign.shares
    assert min(shares.values()) <= 0.9 and offer.redesign.share < 1.0 and not offer.knobs
    reason = offer.make({}).reason
    assert all(f"{share:.0%} ({course})" in reason for course, share in shares.items()) and "agents" in reason


def test_what_has_been_proposed_on_the_model_is_not_proposed_again():
    proposed = set()
    with pytest.raises(Exhausted, match="no design that promises 10%"):
        while True:
            hash_ = config_hash(by_rules(CALM, proposed).redesign.controller)
            assert hash_ not in proposed
            proposed.add(hash_)
    assert len(proposed) > 1


@pytest.mark.slow
def test_where_what_is_in_service_is_the_rules_own_there_is_none():
    best = by_rules(CALM).redesign.controller
    with pytest.raises(Exhausted):
        by_rules(best)


@pytest.mark.slow
def test_without_a_model_it_is_what_the_rules_would_have_begun_with_unless_that_had_its_answer():
    step, line = Next(Step.FIRST, BY_RULES + 1), now(CALM, None)
    (offer,) = CHANGES.offers(step, line, [], None)
    made = offer.make({})
    assert made.reason.startswith(f"{FIRST_LAWS[1].text} on the line's file") and "led to no model" in made.reason
    (offer,) = CHANGES.offers(step, line, [], None, {config_hash(made.change.controller)})
    with pytest.raises(NotOffered, match="proposed before"):
        offer.make({})


def test_the_last_word_may_use_all_that_the_gate_tolerates():
    fine = LINE.gate.fine_overshoot_pct
    before, one = (Figures(rmse_n=1.0, overshoot_pct=pct, settling_s=0.3) for pct in (0.5 * fine, 0.98 * fine))
    assert no_worse(LINE, one, before, of_tolerance=1.0) and not no_worse(LINE, one, before)


@pytest.mark.slow
def test_the_last_word_has_calmer_predictive_control_too_which_overshoots_less():
    offers = redesigns(LINE, MODEL, CALM, TENSION_N, Region(), last=True)
    overshoot_pct = {one.law: one.figures["tension"].overshoot_pct for one in offers}
    calm, usual = (
        [overshoot_pct[law] for law in laws if law in overshoot_pct] for laws in (CALM_PREDICTIVE, PREDICTIVE)
    )
    assert len(calm) == 2 and usual and max(calm) < min(usual)
    assert not set(CALM_PREDICTIVE) & {one.law for one in redesigns(LINE, MODEL, CALM, TENSION_N, Region())}
