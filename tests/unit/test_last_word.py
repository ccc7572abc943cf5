"""What the rules propose in the end, in the place of what agents have led to."""

from datetime import UTC, datetime

import pytest

from gateway.cli.commission_changes import Changes, LineNow
from gateway.commissioning.candidates import FIRST_LAWS, Exhausted, Law, NotOffered, configuration
from gateway.commissioning.ladder import BY_RULES, Next
from gateway.commissioning.past import Step
from gateway.commissioning.redesign import Figures, no_worse
from gateway.core.controller import config_hash
from gateway.core.deployment import Region
from tests.unit.test_redesign import LINE, MODEL, TENSION_N

#: As a late adversary leaves it: calm, and as good as any in a step that torque limits.
CALM = configuration(LINE, MODEL, 0.06, Law("lqi", (("torque_per_nm2", 4.0), ("integral_per_n2s2", 0.3))))
CHANGES = Changes(LINE)


def now(in_service, model=MODEL):
    return LineNow(in_service, model, TENSION_N, 0.01, datetime(2026, 1, 5, tzinfo=UTC))


def by_rules(in_service, proposed=()):
    (offer,) = CHANGES.offers(Next(Step.REDESIGN, BY_RULES), now(in_service), [], Region(), proposed)
    return offer


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


def test_where_what_is_in_service_is_the_rules_own_there_is_none():
    best = by_rules(CALM).redesign.controller
    with pytest.raises(Exhausted):
        by_rules(best)


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
