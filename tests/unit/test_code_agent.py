"""The Code agent, and a model that asks it before it answers: what is named, what it costs, what is on record."""

import asyncio
import json
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.answering import Agent
from agents.code.agent import CodeAgent, Task
from agents.code.calls import Design, Margins
from agents.code.job import Job, Outcome
from agents.code.materials import Given, Materials
from agents.language_model.budget import Budget
from agents.language_model.client import LanguageModel
from agents.language_model.computing import results_message
from agents.language_model.deciding import MOST_TRIES
from agents.rag.stages import Asked, Retrieval
from gateway.cli.agents_view import as_story, as_table
from gateway.control.design import design_lqg, task_of
from gateway.core.computations import Computed
from gateway.core.interactions import Answer, Interaction, pack, unpack
from gateway.core.line_model import model_hash
from gateway.core.questions import Figure, Question, wrong_with
from gateway.supervisor.interactions import Interactions
from tests.stand_in.engine import Engine
from tests.stand_in.in_process import InProcess
from tests.stand_in.personas import PERSONAS
from tests.stand_in.spoken import Form, Message, Persona, Spoken
from tests.unit.code_support import LINE, in_service
from tests.unit.language_model_support import QUESTION, SETTINGS, virtually
from tests.unit.model_support import model as line_model

DESIGN = {"call": "design", "architecture": "lqg"}


class Runs:
    """In place of a process: designs an LQG, and has a figure for everything."""

    def __init__(self) -> None:
        self.jobs: list[Job] = []

    async def __call__(self, job: Job, within_s: float) -> Outcome:
        self.jobs.append(job)
        made = design_lqg(task_of(LINE)) if isinstance(job.call, Design) else None
        return Outcome(figures=[Figure(name="delay margin", value=12.5, unit="ms")], words=["stable"], controller=made)


class Kept(list[Interaction]):
    async def keep(self, one: Interaction) -> None:
        self.append(unpack(pack(one)))


def code(kept: Kept, runs: Runs, materials: Materials | None = None) -> CodeAgent:
    return CodeAgent(LINE, materials or Given(line_model(3), in_service()), kept.keep, run=runs)


def computed(*calls: Any, materials: Materials | None = None) -> tuple[list[Computed], Runs, Interaction]:
    kept, runs = Kept(), Runs()
    results = asyncio.run(code(kept, runs, materials).task("adaptation", "why").compute(calls, 60.0))
    return results, runs, kept[0]


def refused(call: Any, materials: Materials | None = None) -> str:
    (result,), runs, _ = computed(call, materials=materials)
    assert not runs.jobs and not result.figures and result.refused
    return "; ".join(result.refused)


# names


def test_what_a_call_names_goes_with_it() -> None:
    model = line_model(3)
    _, runs, _ = computed(
        {"call": "margins"},
        {"call": "margins", "model": "nominal"},
        {"call": "margins", "model": model_hash(model)[:8]},
    )
    assert [job.models[0].model for job in runs.jobs] == [model, None, model]
    assert all(job.controllers[0].config == in_service() for job in runs.jobs)


def test_a_call_may_name_what_an_earlier_one_has_designed_and_nothing_else() -> None:
    results, runs, _ = computed(
        {"call": "margins", "controller": "call 1"}, DESIGN, {"call": "margins", "controller": "call 2"},
        {"call": "margins", "controller": "call 3"},
    )  # fmt: skip
    assert [one.done for one in results] == [False, True, True, False] and [one.number for one in results] == [
        1,
        2,
        3,
        4,
    ]
    assert runs.jobs[1].controllers[0].config == design_lqg(task_of(LINE))
    assert results[3].refused == ["call 3 has designed no controller; allowed: in-service, call 2"]


def test_what_is_not_there_is_refused_with_what_is() -> None:
    assert "not known; allowed: in-service (" in refused({"call": "margins", "model": "abcdef"})
    nothing = Given()
    assert "no controller is known" in refused({"call": "margins"}, nothing)
    assert "nominal: no model is accepted yet" in refused(DESIGN | {"model": "abcdef"}, nothing)
    assert "no recording" in refused({"call": "identify"}, nothing)
    other = Given(line_model(2), in_service())
    assert "2 spans, the line 3" in refused({"call": "margins"}, other)


def test_without_an_accepted_model_the_lines_file_speaks_and_is_named() -> None:
    _, runs, _ = computed(DESIGN, materials=Given())
    assert runs.jobs[0].models[0].model is None and "none is accepted yet" in runs.jobs[0].models[0].name


def test_whoever_knows_the_line_may_fail() -> None:
    class Gone(Given):
        async def controller(self) -> Any:
            raise ConnectionError("the gateway has gone")

    (result,), _, _ = computed({"call": "margins"}, materials=Gone())
    assert result.failed == "what it names cannot be had: the gateway has gone"


def test_who_lets_it_wait_costs_no_more_than_the_time_that_there_is() -> None:
    class Silent(Given):
        async def controller(self) -> Any:
            await asyncio.Event().wait()

    async def story() -> list[Computed]:
        task = code(Kept(), Runs(), Silent()).task("adaptation", "why")
        return await task.compute([{"call": "margins"}] * 2, 0.05)

    assert all("not done within" in one.failed for one in asyncio.run(story()))


def test_only_one_is_computed_at_a_time() -> None:
    busy = 0

    async def run(job: Job, within_s: float) -> Outcome:
        nonlocal busy
        busy += 1
        assert busy == 1
        await asyncio.sleep(0)
        busy -= 1
        return Outcome()

    async def story() -> None:
        agent = CodeAgent(LINE, Given(None, in_service()), Kept().keep, run=run)
        tasks: list[Task] = [agent.task("adaptation", "why") for _ in range(4)]
        results = await asyncio.gather(*(one.compute([{"call": "margins"}] * 2, 60.0) for one in tasks))
        assert all(one.done for each in results for one in each)

    asyncio.run(story())


# the record


def test_a_computation_is_on_record_with_who_asked_for_what_and_what_came_of_it(tmp_path: Any) -> None:
    results, _, kept = computed({"call": "margins"}, {"call": "exec", "code": "x" * 5000}, 7)
    assert (kept.agent, kept.asked_by, kept.task, kept.computations) == ("code", "adaptation", "why", results)
    assert isinstance(results[1].call, str) and len(results[1].call) <= 200
    log = Interactions(tmp_path)
    assert log.keep(pack(kept), kept) == 1
    (row,) = log.newest(5, "code")
    assert (row.decision, row.chosen, row.decided_by) == ("compute", "margins, no call, no call for adaptation", "code")
    story = as_story(log.find("1"))
    assert "asked by adaptation" in story and "delay margin 12.5 ms" in story and "allowed: 2048" in story
    assert "margins" in as_table([row])


@pytest.mark.parametrize("missing", ["asked_by", "task", "computations"])
def test_a_record_of_neither_question_nor_computation_is_refused(missing: str) -> None:
    _, _, kept = computed({"call": "margins"})
    with pytest.raises(ValueError, match="allowed: a question, or computations"):
        Interaction.model_validate(kept.model_dump(exclude={missing}))


# a model that asks


async def nothing_known(_: Asked) -> Retrieval:
    raise OSError("nothing here")


async def asked(
    persona: Persona, question: Question = QUESTION, most: int = 3, budget: Budget | None = None, **settings: Any
) -> tuple[Answer, Interaction, Kept, Runs]:
    """The answer of the adaptation agent, its record, those of the Code agent, and what was run."""
    kept, of_code, runs = Kept(), Kept(), Runs()
    changed = SETTINGS.model_copy(update={"computations_max": most} | settings)
    clock = asyncio.get_running_loop().time
    async with LanguageModel(changed, clock, InProcess(Engine(persona, seed=1))) as model:
        agent = Agent(
            "adaptation", nothing_known, kept.keep, model, lambda _: budget or Budget(200_000),
            code=code(of_code, runs),
        )  # fmt: skip
        answer = await agent.answer(question)
    return answer, kept[0], of_code, runs


def purposes(one: Interaction) -> list[str]:
    return [exchange["purpose"] for exchange in one.exchanges]


def said(one: Interaction) -> str:
    return "\n".join(message["content"] for exchange in one.exchanges for message in exchange["messages"])


def test_a_model_has_something_computed_and_answers_with_it_before_it() -> None:
    answer, kept, of_code, runs = virtually(asked(PERSONAS["perfect"]))
    assert (answer.choice.option, answer.by) == ("mpc", "adaptation")
    assert purposes(kept) == ["reason", "compute", "answer"]
    assert [type(job.call) for job in runs.jobs] == [Margins]
    assert "> delay margin: 12.5 ms" in said(kept) and "# Computations" in said(kept)
    assert kept.exchanges[1]["computed"][0]["figures"][0]["value"] == 12.5
    (record,) = of_code
    assert (record.asked_by, record.task, len(record.computations)) == ("adaptation", QUESTION.task, 1)
    assert "delay margin 12.5 ms" in as_story(kept)


def test_no_computation_no_stage() -> None:
    answer, kept, of_code, _ = virtually(asked(PERSONAS["perfect"], most=0))
    assert answer.choice.option == "mpc" and purposes(kept) == ["reason", "answer"] and not of_code


@pytest.mark.parametrize("persona", sorted(PERSONAS))
def test_whoever_the_model_is_it_gets_no_more_than_its_calls_and_there_is_an_answer(persona: str) -> None:
    answer, kept, of_code, runs = virtually(asked(PERSONAS[persona]))
    assert not wrong_with(answer.choice, QUESTION)
    assert len(runs.jobs) <= 3 and sum(len(one.computations) for one in of_code) <= 3
    assert purposes(kept).count("compute") <= 3 and purposes(kept).count("answer") <= MOST_TRIES
    assert unpack(pack(kept)) == kept


def test_calls_that_do_not_exist_or_are_too_large_are_told_back_and_cost_what_others_do() -> None:
    for name in ("hallucinating", "adversarial", "unit_confused"):
        _, kept, of_code, runs = virtually(asked(PERSONAS[name]))
        assert not runs.jobs and all(one.refused for record in of_code for one in record.computations)
        assert "allowed:" in said(kept)
    _, kept, _, _ = virtually(asked(PERSONAS["adversarial"]))
    assert "8 calls were asked for; allowed: 3" in said(kept) and purposes(kept).count("compute") == 1
    _, kept, _, _ = virtually(asked(PERSONAS["unit_confused"]))
    assert purposes(kept).count("compute") == 3, "one refused call leaves two"


def in_turn(*lists: str) -> Persona:
    """Asks for these, in their order; else as the perfect one."""
    left = list(lists)

    def persona(messages: Sequence[Message], form: Form, rng: Any) -> Spoken:
        if form is not None and "calls" in form["properties"]:
            return Spoken(left.pop(0))
        return PERSONAS["perfect"](messages, form, rng)

    return persona


def test_what_is_no_list_costs_a_call_and_the_next_may_be_one() -> None:
    good = json.dumps({"calls": [DESIGN, {"call": "margins", "controller": "call 1"}]})
    answer, kept, _, runs = virtually(asked(in_turn("I would like some margins.", good)))
    assert answer.by == "adaptation" and purposes(kept) == ["reason", "compute", "compute", "answer"]
    assert [type(job.call) for job in runs.jobs] == [Design, Margins]
    assert kept.exchanges[1]["refused"] and "no JSON" in said(kept)


def test_calls_of_a_later_list_may_name_those_of_an_earlier_one() -> None:
    first = json.dumps({"calls": [DESIGN, {"call": "marginz"}]})
    second = json.dumps({"calls": [{"call": "margins", "controller": "call 1"}]})
    _, _, of_code, runs = virtually(asked(in_turn(first, second)))
    assert [type(job.call) for job in runs.jobs] == [Design, Margins]
    assert [one.number for record in of_code for one in record.computations] == [1, 2, 3]


def test_tokens_of_computations_count_in_the_same_budget() -> None:
    spent, without = Budget(200_000), Budget(200_000)
    virtually(asked(PERSONAS["perfect"], budget=spent))
    virtually(asked(PERSONAS["perfect"], budget=without, most=0))
    assert spent.spent_tokens > without.spent_tokens + 500


def test_a_computation_may_take_half_of_the_time_that_is_left_and_no_more() -> None:
    given: list[float] = []

    class Slow(Runs):
        async def __call__(self, job: Job, within_s: float) -> Outcome:
            given.append(within_s)
            await asyncio.sleep(within_s + 1000.0)
            return Outcome()

    async def story() -> tuple[Answer, Interaction]:
        kept = Kept()
        clock = asyncio.get_running_loop().time
        async with LanguageModel(SETTINGS, clock, InProcess(Engine(PERSONAS["perfect"]))) as model:
            agent = Agent(
                "adaptation", nothing_known, kept.keep, model, lambda _: Budget(200_000), code=code(Kept(), Slow())
            )
            return await agent.answer(QUESTION), kept[0]

    answer, kept = virtually(story())
    assert answer.by == "adaptation" and given and given[0] <= 0.5 * SETTINGS.answer_max_s
    assert "not done within" in said(kept)


def test_where_computations_do_not_fit_into_the_context_it_answers_without_them() -> None:
    narrow = {"context_tokens": 4500, "answer_tokens": 512}
    answer, kept, of_code, _ = virtually(asked(PERSONAS["perfect"], **narrow))
    assert (answer.choice.option, answer.by) == ("mpc", "adaptation") and not of_code
    assert purposes(kept) == ["reason", "compute", "answer"] and kept.exchanges[1]["failure"] == "too-long"


def test_where_the_results_do_not_fit_it_answers_without_them() -> None:
    class Long(Runs):
        async def __call__(self, job: Job, within_s: float) -> Outcome:
            return Outcome(words=["0123456789 " * 20] * 10)

    async def story() -> tuple[Answer, Interaction]:
        kept = Kept()
        settings = SETTINGS.model_copy(update={"context_tokens": 5600, "answer_tokens": 512})
        clock = asyncio.get_running_loop().time
        async with LanguageModel(settings, clock, InProcess(Engine(PERSONAS["perfect"]))) as model:
            agent = Agent(
                "adaptation", nothing_known, kept.keep, model, lambda _: Budget(200_000), code=code(Kept(), Long())
            )
            return await agent.answer(QUESTION), kept[0]

    answer, kept = virtually(story())
    assert answer.by == "adaptation" and purposes(kept) == ["reason", "compute", "answer", "answer"]
    assert kept.exchanges[2]["failure"] == "too-long" and kept.exchanges[1]["computed"]


def only_calls(failing: Spoken) -> Persona:
    """Fails when it is asked what to compute, and only then."""

    def persona(messages: Sequence[Message], form: Form, rng: Any) -> Spoken:
        asks_calls = form is not None and "calls" in form["properties"]
        return failing if asks_calls else PERSONAS["perfect"](messages, form, rng)

    return persona


@pytest.mark.parametrize(
    ("failing", "kind"),
    [
        (Spoken("it thinks", end="hang"), "late"),
        (Spoken("it broke", status=500), "refused"),
        (Spoken('{"calls": []}', read_share=0.1), "cut"),
        (Spoken('{"calls": []}', end="hang-up", after_tokens=1), "broken"),
    ],
)
def test_what_fails_in_computing_costs_the_computations_and_not_the_answer(failing: Spoken, kind: str) -> None:
    answer, kept, of_code, _ = virtually(asked(only_calls(failing)))
    assert (answer.choice.option, answer.by) == ("mpc", "adaptation") and not of_code
    assert purposes(kept) == ["reason", "compute", "answer"]
    assert kept.exchanges[1]["failure"] == kind and kept.exchanges[1]["refused"]
    assert kept.exchanges[1]["seconds"] <= 0.5 * SETTINGS.answer_max_s + 1.0


def computed_in(messages: Sequence[Message]) -> bool:
    return any("What was computed" in one["content"] for one in messages)


def test_what_was_computed_before_a_failure_is_still_answered_with() -> None:
    first, heard = json.dumps({"calls": [DESIGN, {"call": "marginz"}]}), list[Sequence[Message]]()

    def persona(messages: Sequence[Message], form: Form, rng: Any) -> Spoken:
        if form is not None and "calls" in form["properties"]:
            return Spoken("", status=500) if computed_in(messages) else Spoken(first)
        heard.append(messages)
        return PERSONAS["perfect"](messages, form, rng)

    answer, kept, _, _ = virtually(asked(persona))
    assert answer.by == "adaptation" and purposes(kept) == ["reason", "compute", "compute", "answer"]
    assert computed_in(heard[-1]) and not computed_in(heard[0])


ODD = st.recursive(
    st.none() | st.integers() | st.floats() | st.text(st.characters(), max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(st.characters()), inner),
    max_leaves=8,
)


@given(
    st.lists(
        ODD | ODD.map(lambda odd: {"call": odd}) | ODD.map(lambda odd: DESIGN | {"knobs": odd}), min_size=1, max_size=3
    )
)
def test_whatever_is_asked_is_refused_told_and_on_record(calls: list[Any]) -> None:
    results, _, kept = computed(*calls)
    assert len(results) == len(calls) and unpack(pack(kept)) == kept
    results_message(results, []).content.encode()
    as_story(kept).encode()
