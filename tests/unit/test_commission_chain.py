"""The policy of the commissioning chain: whatever the gate says, it ends, and goes on after a restart."""

from dataclasses import replace
from itertools import cycle, islice

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.commissioning.candidates import FIRST_LAWS
from gateway.commissioning.chain import (
    MOST_ROUNDS,
    STRETCH,
    Look,
    Pending,
    from_one_experiment,
    may_experiment,
    may_use_all,
    refused_at_once,
)
from gateway.commissioning.decisions import AGENTS, RULES
from gateway.commissioning.ladder import (
    ALL,
    AS_IT_IS,
    BY_RULES,
    LADDERS,
    MOST_AGAIN,
    MOST_EXPERIMENTS,
    MOST_OWN,
    NEWEST_AFTER_ALL,
    OWN,
    Ended,
    Next,
)
from gateway.commissioning.past import Follows, Outcome, Past, Step
from gateway.commissioning.redesign import RUNGS
from tests.unit.chain_support import ADAPTED, FIRST_M_PER_S, LINE, after, asked, concluded, looked_at


def test_where_everything_gets_through_each_round_goes_faster_until_the_range_is_covered():
    past: list[Past] = []
    steps: list[Next] = []
    while isinstance(step := asked(past), Next):
        steps.append(step)
        past.append(after(step, past))
    assert isinstance(step, Look)
    ended = asked(looked_at(past))
    assert isinstance(ended, Ended) and ended.reached and ended.converged and "as it should" in ended.text
    rounds = 3 * [Step.EXPERIMENT, Step.MODEL, Step.REDESIGN]
    assert [one.step for one in steps] == [Step.FIRST, *rounds, Step.MEASUREMENT]
    tops = [max(one.speeds_m_per_s) for one in steps if one.step is Step.EXPERIMENT]
    assert tops == pytest.approx([0.02, 0.06, 0.12])  # no faster than data have shown, times STRETCH
    assert all(one.rung == 0 and one.size == 1.0 for one in steps)


def test_what_is_refused_is_followed_by_the_next_candidate_and_by_the_reason_in_the_end():
    past: list[Past] = []
    for rung in range(LADDERS[Step.FIRST]):
        step = asked(past)
        assert step == Next(Step.FIRST, rung)
        past.append(replace(after(step, past, Outcome.FAILED), why=f"corner {rung}"))
    assert asked(past) == asked(past)
    assert (
        isinstance(asked(past), Ended)
        and not asked(past).reached
        and f"corner {LADDERS[Step.FIRST] - 1}" in asked(past).text
    )


def test_in_the_place_of_a_candidate_any_that_has_not_failed_may_be_taken():
    first = asked([])
    assert [one.rung for one in (first, *first.others)] == list(range(LADDERS[Step.FIRST])) and first.own == MOST_OWN
    past = [after(first.others[1], [], Outcome.FAILED)]  # somebody began with the third
    assert [one.rung for one in (asked(past), *asked(past).others)] == [0, 1, *range(3, LADDERS[Step.FIRST])]
    past += [after(replace(first, rung=OWN), [], Outcome.FAILED)]
    assert asked(past).rung == 0 and asked(past).own == MOST_OWN - 1


def test_where_there_is_no_design_on_a_rung_there_is_none_above_it_but_what_is_in_service():
    past = [*ADAPTED[:3], Past("gains", Outcome.FAILED, Step.REDESIGN, 2, "no other design", last=True)]
    assert [one.rung for one in (asked(past), *asked(past).others)] == [0, 1]


def test_a_refused_experiment_is_smaller_then_slower():
    past = [Past("gains", Outcome.DONE, Step.FIRST, 0, speed_m_per_s=0.02)]
    first = asked(past)
    past.append(after(first, past, Outcome.FAILED))
    assert asked(past).size == 0.5 * first.size and asked(past).speeds_m_per_s == first.speeds_m_per_s
    adapted = [
        Past("gains", Outcome.DONE, Step.FIRST, 0, speed_m_per_s=0.02), Past("experiment", Outcome.DONE),
        Past("model", Outcome.DONE), Past("gains", Outcome.DONE, Step.REDESIGN, 0, speed_m_per_s=0.02),
    ]  # fmt: skip
    tops = []
    while isinstance(step := asked(adapted), Next):
        tops.append((max(step.speeds_m_per_s), step.size))
        adapted.append(after(step, adapted, Outcome.FAILED))
    assert tops == [(0.06, 1.0), (0.06, 0.5), (pytest.approx(0.0346, rel=0.01), 1.0),
                    (pytest.approx(0.0346, rel=0.01), 0.5)]  # fmt: skip


def test_data_that_give_no_model_are_followed_by_a_larger_experiment_a_few_times():
    past = [Past("gains", Outcome.DONE, Step.FIRST, 0, speed_m_per_s=0.02)]
    sizes = []
    while isinstance(step := asked(past), Next):
        failed = step.step is Step.MODEL
        sizes += [] if failed else [(step.size, step.number)]
        past.append(after(step, past, Outcome.FAILED if failed else Outcome.DONE))
    assert sizes == [(1.0, 0), (1.0, 1), (2.0, 2)] and len(sizes) == MOST_EXPERIMENTS and not step.reached


def test_where_more_data_are_asked_for_an_experiment_follows_at_once_as_long_as_there_may_be_one():
    past = [Past("gains", Outcome.DONE, Step.FIRST, 0, speed_m_per_s=0.02)]
    for _ in range(MOST_EXPERIMENTS):
        assert may_experiment(past)
        step = asked(past)
        assert isinstance(step, Next) and step.step is Step.EXPERIMENT
        past.append(after(step, past))
        assert asked(past).step is Step.MODEL
        past.append(Past("model", Outcome.FAILED, Step.MODEL, 0, "more data first", last=True))
    assert not may_experiment(past) and isinstance(asked(past), Ended)


def test_a_measurement_is_no_experiment_that_gave_no_model():
    past = looked_at([*ADAPTED, after(asked(ADAPTED), ADAPTED)], settled=False, gains=True)
    sizes: list[float] = []
    for _ in range(2):
        step = asked(past)
        assert isinstance(step, Next) and step.step is Step.EXPERIMENT
        sizes.append(step.size)
        past.append(after(step, past))
        while isinstance(step := asked(past), Next) and step.step is Step.MODEL:
            past.append(after(step, past, Outcome.FAILED))
    assert sizes == [1.0, 2.0]


def test_nothing_is_proposed_while_something_is_on_its_way_and_a_wrong_moment_costs_no_candidate():
    assert asked([Past("gains", Outcome.OPEN, proposal="a" * 64)]) == Pending("a" * 64, "gains")
    past = [Past("gains", Outcome.AGAIN, Step.FIRST, 0)]
    assert asked(past) == Next(Step.FIRST, 0)
    assert isinstance(asked(past * (MOST_AGAIN + 1)), Ended)


def test_what_an_engineer_has_done_meanwhile_counts():
    past = [Past("gains", Outcome.DONE, speed_m_per_s=0.02)]
    assert asked(past).step is Step.EXPERIMENT
    past += [Past("model", Outcome.DONE)]
    assert asked(past).step is Step.REDESIGN
    past += [Past("gains", Outcome.DONE, speed_m_per_s=0.12)]
    assert asked(past) == Next(Step.MEASUREMENT, 0, (0.045, 0.09))
    past += [after(asked(past), past)]
    assert asked(looked_at(past)).converged


@pytest.mark.parametrize("gains", [True, False])
def test_what_is_not_settled_leads_to_another_model_and_redesign_a_few_times(gains):
    past, steps, rungs = list(ADAPTED), [], []
    while not isinstance(step := asked(past), Ended):
        if isinstance(step, Look):
            past = looked_at(past, settled=False, gains=gains)
            continue
        steps.append(step.step)
        rungs += [step.rung] if step.step is Step.REDESIGN else []
        past.append(replace(after(step, past), speed_m_per_s=0.12))
    again = (
        [Step.EXPERIMENT, Step.MODEL, Step.REDESIGN, Step.MEASUREMENT] if gains else [Step.REDESIGN, Step.MEASUREMENT]
    )
    assert steps == [Step.MEASUREMENT, *(MOST_ROUNDS - 1) * again]
    assert step.reached and not step.converged and "span 2 overshoots" in step.text
    assert rungs == ([0, 0] if gains else [1, 2])  # what the model has foreseen, a newer one would give again


def test_of_so_many_adaptations_as_are_asked_for_the_second_is_from_all_data_and_those_after_it_from_new_ones():
    past, steps, rungs = list(ADAPTED), [], []
    while not isinstance(step := asked(past, adaptations=3), Ended):
        if isinstance(step, Look):
            past = looked_at(past, settled=False)
            continue
        steps.append(step.step)
        rungs += [step.rung] if step.step in {Step.REDESIGN, Step.MODEL} else []
        past.append(replace(after(step, past), speed_m_per_s=0.12))
    again = [Step.MODEL, Step.REDESIGN, Step.MEASUREMENT]
    assert steps == [Step.MEASUREMENT, *again, Step.EXPERIMENT, *again] and rungs == [ALL, 0, ALL, 0]


def test_a_model_of_one_experiment_is_followed_by_one_of_all_data_once():
    past = concluded(ADAPTED, Follows.ALL_DATA)
    step = asked(past)
    assert step == Next(Step.MODEL, ALL) and not step.others and not may_experiment(past)
    for _ in range(2):  # and a redesign on it
        past.append(replace(after(asked(past), past), speed_m_per_s=0.12))
    assert not from_one_experiment(past) and asked(past).step is Step.MEASUREMENT
    ended = asked(concluded(past, Follows.LEAVE))
    assert isinstance(ended, Ended) and ended.converged


def test_where_all_data_give_no_model_what_has_converged_stays():
    past = concluded(ADAPTED, Follows.ALL_DATA)
    refused = after(asked(past), past, Outcome.FAILED)
    ended = asked([*past, refused])
    assert isinstance(ended, Ended) and ended.reached and ended.converged


def test_where_no_experiment_gets_through_after_a_measurement_there_are_all_data():
    past = concluded(ADAPTED, Follows.NEWER_MODEL)
    while asked(past).step is Step.EXPERIMENT:
        past.append(after(asked(past), past, Outcome.FAILED))
    assert asked(past) == Next(Step.MODEL, ALL)


def test_after_a_measurement_all_data_come_first_and_then_the_newest():
    past = concluded(ADAPTED, Follows.NEWER_MODEL)
    past.append(after(asked(past), past))
    step = asked(past)
    assert [one.rung for one in (step, *step.others)] == [ALL, NEWEST_AFTER_ALL]
    past.append(after(step, past, Outcome.FAILED))
    assert asked(past).rung == NEWEST_AFTER_ALL


def test_where_all_data_give_no_model_and_an_adaptation_is_due_an_experiment_follows():
    for follows, converged, adaptations in ((Follows.LEAVE, True, 2), (Follows.ALL_DATA, False, 1)):
        past = concluded(ADAPTED, follows)
        past[-1] = replace(past[-1], converged=converged)
        refused = after(asked(past, adaptations), past, Outcome.FAILED)
        assert refused.step is Step.MODEL and asked([*past, refused], adaptations).step is Step.EXPERIMENT


def test_what_is_as_it_should_be_at_the_last_measurement_has_converged():
    past = list(ADAPTED)
    for _ in range(MOST_ROUNDS - 1):
        past = concluded(past, Follows.CALMER)
        past.append(replace(after(asked(past), past), speed_m_per_s=0.12))
    assert may_use_all(past, 2) and not may_use_all(past, 1)
    past = concluded(past, Follows.LEAVE)
    assert not may_use_all(past, 2)
    ended = asked(past)
    assert isinstance(ended, Ended) and ended.converged
    ended = asked([*past[:-1], replace(past[-1], follows=Follows.ALL_DATA)])
    assert isinstance(ended, Ended) and ended.converged


def test_once_enough_redesigns_are_kept_it_is_measured_what_the_last_one_does_and_no_more():
    measured = asked(ADAPTED, most_redesigns=1)
    assert measured.step is Step.MEASUREMENT
    past = [*ADAPTED, after(measured, ADAPTED)]
    assert isinstance(asked(past, most_redesigns=1), Look)
    for follows, converged in ((Follows.ALL_DATA, True), (Follows.NEWER_MODEL, False), (Follows.LEAVE, True)):
        past[-1] = replace(past[-1], follows=follows, converged=converged)
        ended = asked(past, most_redesigns=1)
        assert isinstance(ended, Ended) and ended.reached and ended.converged is converged


@pytest.mark.parametrize(
    ("refused", "gains", "tried"),
    [
        (Step.MEASUREMENT, True, LADDERS[Step.MEASUREMENT]),
        (Step.EXPERIMENT, True, 2 * (1 + LADDERS[Step.EXPERIMENT]) + 2),  # after the first, a model of all data
        (Step.REDESIGN, True, 3 + LADDERS[Step.REDESIGN]),
        (Step.REDESIGN, False, AS_IT_IS),  # what is in service is no candidate against itself
    ],
)
def test_where_nothing_further_gets_through_the_adapted_configuration_stays(refused, gains, tried):
    past = list(ADAPTED)
    while not isinstance(step := asked(past), Ended):
        if isinstance(step, Look):
            past = looked_at(past, settled=False, gains=gains)
            continue
        outcome = Outcome.FAILED if step.step is refused else Outcome.DONE
        past.append(replace(after(step, past, outcome), speed_m_per_s=0.12))
    assert step.reached and not step.converged and len(past) == len(ADAPTED) + tried


def test_a_measurement_that_failed_is_followed_by_a_smaller_one():
    failed = after(asked(ADAPTED), ADAPTED, Outcome.FAILED)
    assert asked([*ADAPTED, failed]).size == 0.5 * asked(ADAPTED).size


def picked(step: Next, pick: int) -> Next:
    candidates = (step, *step.others)
    assert len({one.rung for one in candidates}) == len(candidates) and step.own <= MOST_OWN
    if pick > 10 and step.own > 0:
        return replace(step, rung=OWN + MOST_OWN - step.own)
    return candidates[pick % len(candidates)]


@settings(max_examples=50)
@given(
    st.lists(st.sampled_from([Outcome.DONE, Outcome.DONE, Outcome.FAILED, Outcome.AGAIN]), min_size=1, max_size=40),
    st.floats(0.2, 1.0),
    st.lists(st.integers(0, 20), min_size=1, max_size=40),
)
def test_it_ends_whatever_the_gate_says_and_whoever_chooses(outcomes, share, picks):
    """It says the same again and again; `share` of what an experiment has shown is what a configuration gets.

    A pick is one of the candidates in turn, or the first of them with numbers of somebody's own.
    """
    past: list[Past] = []
    for outcome, pick in islice(zip(cycle(outcomes), cycle(picks), strict=False), 900):
        step = asked(past)
        if isinstance(step, Ended):
            return
        if isinstance(step, Look):
            past = looked_at(past, settled=len(past) % 2 == 0)
            continue
        assert isinstance(step, Next)
        theirs = step.rung >= BY_RULES
        assert step.rung < (BY_RULES + max(RUNGS, len(FIRST_LAWS)) if theirs else LADDERS[step.step])
        assert not theirs or any(one.author == AGENTS for one in past)
        reached = max((one.speed_m_per_s or 0.0 for one in past if one.kind == "gains"), default=FIRST_M_PER_S)
        assert all(speed <= max(STRETCH * reached, FIRST_M_PER_S) * (1.0 + 1e-9) for speed in step.speeds_m_per_s)
        one = after(picked(step, pick), past, outcome)
        one = replace(one, author=AGENTS if pick % 2 and not theirs else RULES)
        speed = None if one.speed_m_per_s is None else share * one.speed_m_per_s
        past.append(replace(one, speed_m_per_s=speed) if one.kind == "gains" else one)
    raise AssertionError(f"{len(past)} proposals, and no end")


def test_after_a_calmer_one_comes_none_that_is_quicker():
    past = [*ADAPTED[:3], replace(ADAPTED[3], rung=3)]
    past = looked_at([*past, after(asked(past), past)], settled=False)
    assert [one.rung for one in (asked(past), *asked(past).others)] == list(range(4, AS_IT_IS))


def test_a_closed_line_is_told_at_once():
    gate = LINE.gate.model_copy(update={"autonomy": "closed"})
    assert "closed" in refused_at_once(LINE.model_copy(update={"gate": gate})) and refused_at_once(LINE) == ""


def test_a_configuration_that_was_put_into_service_gets_experiments_and_old_data_no_model_again():
    """After one experiment without a model, and four refused under what was in service."""
    past = [ADAPTED[0]]
    while isinstance(step := asked(past), Next):
        done = step.step is Step.EXPERIMENT and not any(one.step is Step.EXPERIMENT for one in past)
        past.append(after(step, past, Outcome.DONE if done else Outcome.FAILED))
    past.append(replace(ADAPTED[0], author="anna", step=None))
    assert asked(past).step is Step.EXPERIMENT
