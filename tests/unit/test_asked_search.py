"""Algorithm 1 with somebody who is asked: with the rules it is the search, and nobody gets anything past validation."""

from threading import Event

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gateway.cli.asked_in_time import InTime
from gateway.commissioning.architectures import ARCHITECTURES, LQI, LQR
from gateway.commissioning.asked_search import AskedSearch
from gateway.commissioning.decisions import RULES, Decided, Rules
from gateway.commissioning.ground import ground_of
from gateway.commissioning.records import Attempt, Suggestion
from gateway.commissioning.search import PatternSearch
from gateway.commissioning.suite import suite_of
from gateway.commissioning.trial import reasons_against, tried
from gateway.commissioning.tuning import attempted, tune
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.questions import MOST_BYTES, Choice, question_json
from tests.unit.asked_support import AGENT, ByChance, Persona, Says

LINE = load_line(line_template(1, "line.toml"), "line.toml")
EVERY = 1000


@pytest.fixture(scope="module")
def ground():
    return ground_of(LINE, suite_of(LINE), 1, 0).shortened(2, 0.1, 1.1)


def asking(decider, questions=EVERY):
    return AskedSearch(decider, LINE.site, LINE.line, questions)


@pytest.fixture(scope="module")
def hopeless(ground):
    return attempted(LQR, ground, Suggestion(values={"torque_per_nm2": 1e-4}, reason="haste"), ())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pid", "lqr", "lqi", "lqg"])
def test_asked_the_rules_give_what_the_search_gives(ground, name):
    found = tune(ARCHITECTURES[name], ground, asking(Rules()), 5)
    assert found == tune(ARCHITECTURES[name], ground, PatternSearch(), 5)


@pytest.mark.slow
def test_and_so_they_do_from_a_hopeless_start_and_to_the_end(ground, hopeless):
    assert hopeless.refused
    found = tune(LQR, ground, asking(Rules()), 25, [hopeless])
    assert found == tune(LQR, ground, PatternSearch(), 25, [hopeless]) and found.converged


@pytest.mark.slow
@settings(max_examples=7, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 10**6), name=st.sampled_from(["lqr", "lqr", "lqi", "pid"]))
def test_whatever_somebody_chooses_only_what_holds_is_accepted(ground, seed, name):
    """What is offered is designed and simulated anew here, and holds; its J is the least of those that do."""
    architecture, decider = ARCHITECTURES[name], ByChance(seed)
    found = tune(architecture, ground, asking(decider, 4), 5)
    costs = [one.cost_n2s for one in found.history if one.accepted]
    assert costs == sorted(costs, reverse=True) and len(found.history) <= 6
    for one in found.history:
        assert one.refused or architecture.wrong(one.values) == []
        assert (one.by == RULES) == (one.usual is None)
    if (best := found.best) is not None:
        again = tried(architecture.design(ground.task, best.values), ground)
        assert again == best.trial and reasons_against(again, ground) == []
        assert best.cost_n2s == min(one.cost_n2s for one in found.history if one.cost_n2s is not None)
    for question in decider.asked:
        assert len(question_json(question)) < MOST_BYTES // 4
        assert question.usual == question.options[0].id


def test_what_was_interrupted_goes_on_as_if_it_had_not_been(ground):
    whole = tune(LQR, ground, asking(ByChance(5), 5), 8)
    kept = [Attempt.model_validate_json(one.model_dump_json()) for one in whole.history]
    assert sum(one.by == AGENT for one in kept) > 1
    for cut in (1, 3, 6):
        assert tune(LQR, ground, asking(ByChance(5), 5), 8, kept[:cut]) == whole


def test_own_numbers_are_tried_and_the_search_goes_on_from_them(ground):
    turned = {"torque_per_nm2": 0.5, "integral_per_n2s2": 2.0}
    found = tune(LQI, ground, asking(Says(lambda question: ("best", turned)), 1), 3)
    first, own = found.history[:2]
    assert first.by == RULES, "where it begins is nobody's choice"
    for name, factor in {**turned, "antiwindup": 1.0}.items():
        assert own.values[name] == pytest.approx(factor * first.values[name], rel=0.01)
    search = PatternSearch().suggest(LQI, ground, [first])
    assert (own.by, own.reason, own.usual.values) == (AGENT, "I say best.", search.values)
    assert [one.by for one in found.history[2:]] == [RULES] * 2
    assert found == tune(LQI, ground, PatternSearch(), 3, found.history[:2])


def test_factors_lead_no_further_than_a_knob_goes(ground):
    low = Attempt(
        number=0, values={"torque_per_nm2": 1.5e-5}, reason="", trial=None, refused="too quick", accepted=False
    )
    found = tune(LQR, ground, asking(Says(lambda question: ("last", {"torque_per_nm2": 0.25}))), 1, [low])
    assert found.history[1].values == {"torque_per_nm2": LQR.knobs[0].least} and found.history[1].by == AGENT


@pytest.mark.slow
def test_as_long_as_nothing_holds_the_search_goes_its_own_way(ground, hopeless):
    """Not from where somebody has led it."""
    astray = Says(lambda question: ("last", {"torque_per_nm2": 0.5}))
    found = tune(LQR, ground, asking(astray, 3), 15, [hopeless])
    alone = tune(LQR, ground, PatternSearch(), 12, [hopeless])
    assert [one.by for one in found.history[1:4]] == [AGENT] * 3 and found.best is not None
    own = [one.values for one in found.history if one.by == RULES]
    assert own[: len(alone.history)] == [one.values for one in alone.history][: len(own)]


def test_what_was_tried_before_is_not_tried_again(ground):
    found = tune(LQR, ground, asking(Says(lambda question: ("best", {}))), 3)
    assert all(one.by == RULES for one in found.history)
    assert f"{AGENT} chooses what attempt 0 has tried" in found.history[1].instead
    values = [one.values for one in found.history]
    assert all(one not in values[:at] for at, one in enumerate(values))


def test_an_end_is_whose_it_is(ground):
    def ends(question):
        offered = any(one.id == "stop" for one in question.options)
        return ("stop", {}) if offered else ("best", {"torque_per_nm2": 4.0 - 0.1 * len(question.facts)})

    found = tune(LQR, ground, asking(Says(ends)), 20)
    assert found.converged and found.best is not None and len(found.history) - 1 - found.best.number == 3
    assert (found.stopped.by, found.stopped.reason) == (AGENT, "I say stop.") and found.stopped.usual.values


def test_without_anything_that_holds_no_end_is_offered(ground, hopeless):
    decider = Says(lambda question: None)
    tune(LQR, ground, asking(decider, 2), 1, [hopeless])
    assert [one.id for one in decider.asked[0].options] == ["search", "last"]
    assert all(not knob.of for knob in decider.asked[0].knobs)


def test_a_turn_that_is_named_is_the_one_that_was_shown(ground):
    decider = Says(lambda question: ("turn-2", {}))
    found = tune(LQI, ground, asking(decider, 2), 1)
    shown = next(one for one in decider.asked[0].options if one.id == "turn-2")
    assert {one.name: one.value for one in shown.figures} == found.history[1].values
    assert found.history[1].usual.values != found.history[1].values


@pytest.mark.slow
def test_a_perfect_model_tunes_as_well_as_the_search():
    """On the example line, with the real agent and client."""
    with open("docs/examples/line.toml", encoding="utf-8") as file:
        line = load_line(file.read(), "line.toml")
    ground = ground_of(line, suite_of(line), 1, 0).shortened(2, 0.1, 1.1)
    persona = Persona("perfect")
    found = tune(LQI, ground, AskedSearch(persona, line.site, line.line, 5), 5)
    assert found.best.cost_n2s <= tune(LQI, ground, PatternSearch(), 5).best.cost_n2s
    assert {one.by for one in found.history[1:]} == {AGENT} and len(persona.kept) == 5
    assert all(one.exchanges and not one.answer.instead.startswith("the language") for one in persona.kept)


@pytest.mark.parametrize("name", ["adversarial", "unit_confused", "hallucinating", "sloppy"])
def test_no_persona_gets_what_does_not_hold(ground, name):
    found = tune(LQR, ground, asking(Persona(name), 3), 3)
    for one in found.history:
        assert one.refused or reasons_against(one.trial, ground) == []
    assert found.history[0].accepted and found.best.cost_n2s <= found.history[0].cost_n2s


# Whoever is asked has to answer, and in time


QUESTIONS = Says(lambda question: None)


@pytest.fixture(scope="module")
def question(ground):
    tune(LQR, ground, asking(QUESTIONS, 1), 1)
    return QUESTIONS.asked[0]


class Broken:
    def decide(self, question):
        raise OSError("the wire is cut")


def test_who_fails_or_answers_another_question_leaves_it_to_the_rules(question):
    found = InTime(Broken(), 60.0).decide(question)
    assert (found.by, found.instead) == (RULES, "asking failed: the wire is cut")
    elsewhere = Says(lambda question: ("hybrid", {"torque_nm": 9.0}))
    found = InTime(elsewhere, 60.0).decide(question)
    assert found.by == RULES and found.choice.option == question.usual and "option is hybrid" in found.instead
    assert InTime(Says(lambda question: None), 60.0).decide(question).by == AGENT


def test_who_never_answers_is_asked_once(question):
    answers = Event()

    class Hung:
        asked = 0

        def decide(self, question):
            self.asked += 1
            answers.wait(60.0)
            return Decided(Choice(option=question.usual, reason="late"), AGENT)

    hung = Hung()
    asked = InTime(hung, 0.05)
    try:
        found = [asked.decide(question) for _ in range(3)]
    finally:
        answers.set()
    assert [one.by for one in found] == [RULES] * 3 and hung.asked == 1
    assert found[0].instead == "no answer in 0.05 s" and "before" in found[2].instead
