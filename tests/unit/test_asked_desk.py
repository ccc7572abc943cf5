"""What a proposal rests on, over a real socket: out of the log, each note once, and what is not there is said."""

import asyncio
import json
from collections.abc import Awaitable, Callable, Sequence

import pytest

from gateway.core.asked_before import MOST_ASKED, MOST_NOTES, MOST_PASSAGE, AskedTold
from gateway.core.asked_before import asked as naming
from gateway.core.computations import Computed
from gateway.core.controller import config_hash
from gateway.core.interactions import Answer, Interaction, Note, pack
from gateway.core.messages import Reply
from gateway.core.proposal import Evidence
from gateway.core.questions import Choice, usual_choice
from gateway.core.topics import GATEWAY_ASKED
from gateway.mailbox.port import MAX_PAYLOAD
from gateway.mailbox.unix import UnixMailbox
from gateway.supervisor.asked_desk import AskedDesk
from gateway.supervisor.interactions import FILE_NAME, Interactions
from tests.unit.deployer_gateway import Gateway, started
from tests.unit.deployer_support import FIRST, hash_of, proposal
from tests.unit.language_model_support import QUESTION
from tests.unit.supervisor_support import short_folder

Ask = Callable[..., Awaitable[bytes]]


def note(key: str, score: float = 0.5, passage: str = "It swings.", **more: object) -> Note:
    return Note.model_validate(
        {"key": key, "title": f"Title of {key}", "tier": 2, "score": score, "passage": passage, **more}
    )


def interaction(number: int, *notes: Note, by: str = "rules", instead: str = "", choice: Choice | None = None):
    return Interaction(
        format=1, id=f"{number:016x}", agent="adaptation", at="2026-01-05T10:00:00.000+00:00", question=QUESTION,
        notes=list(notes), prompt="", seconds=1.0,
        answer=Answer(choice=choice or usual_choice(QUESTION), by=by, instead=instead),
    )  # fmt: skip


def computation(number: int) -> Interaction:
    done = Computed(call={"call": "margins"}, number=1, seconds=0.1)
    return Interaction(
        format=1, id=f"{number:016x}", agent="code", at="2026-01-05T10:00:00.000+00:00", prompt="", seconds=1.0,
        asked_by="adaptation", task="margins", computations=[done],
    )  # fmt: skip


def told(kept: Sequence[Interaction], story: Callable[[Interactions, Ask], Awaitable[None]]) -> None:
    """`Ask` makes a proposal with that evidence, and asks what it rests on."""

    async def whole() -> None:
        with short_folder() as folder:
            log, served, way, gateway = Interactions(folder), UnixMailbox(), UnixMailbox(), await started()
            for one in kept:
                log.keep(pack(one), one)
            AskedDesk(served, lambda: gateway.deployer, log)
            await served.listen(folder / "gateway.sock")
            way.connect((GATEWAY_ASKED,), folder / "gateway.sock")

            async def ask(*evidence: Evidence, again: bool = False) -> bytes:
                payload = json.dumps({"proposal": await _proposed(gateway, evidence, again)}).encode()
                return await way.request(GATEWAY_ASKED, payload, 5.0)

            await story(log, ask)
            await way.close()
            await served.close()

    asyncio.run(whole())


async def _proposed(gateway: Gateway, evidence: Sequence[Evidence], again: bool) -> str:
    one = proposal(1, config_hash(FIRST), gateway.loop.now_s).model_copy(update={"evidence": list(evidence)})
    assert (await gateway.propose(one)).ok is not again
    return hash_of(one)


def test_what_was_asked_stands_in_the_order_of_the_proposal_and_what_was_chosen_in_words():
    chosen = Choice(option=QUESTION.options[-1].id, reason="It has served before.")
    first, second = interaction(1), interaction(2, by="adaptation", choice=chosen)
    third = interaction(3, instead="the model was silent")

    async def story(_: Interactions, ask: Ask) -> None:
        numbers = (Evidence(what="rmse", value=3.0), naming(second.id), naming(first.id), naming(third.id))
        found = AskedTold.model_validate_json(await ask(*numbers))
        assert [one.interaction for one in found.asked] == [second.id, first.id, third.id]
        assert [one.by_rules for one in found.asked] == [False, True, True]
        assert {one.agent for one in found.asked} == {"adaptation"}
        assert found.asked[0].chosen == QUESTION.options[-1].title and found.asked[0].task == QUESTION.task
        assert [one.instead for one in found.asked] == ["", "", "the model was silent"]
        assert found.missing == []

    told([first, second, third], story)


def test_each_note_is_told_once_with_the_passage_that_fitted_best():
    kept = [
        interaction(1, note("a", 0.3, "weaker"), note("b", 0.4, overruled_by=["c"])),
        interaction(2, note("a", 0.9, "stronger", speaks_to_a_model=["order: obey"]), note("c", 0.5, tier=3)),
    ]

    async def story(_: Interactions, ask: Ask) -> None:
        found = AskedTold.model_validate_json(await ask(*(naming(one.id) for one in kept)))
        assert [(one.key, one.passage) for one in found.notes] == [
            ("a", "stronger"), ("c", "It swings."), ("b", "It swings."),
        ]  # fmt: skip
        assert [one.speaks_to_a_model for one in found.notes] == [True, False, False]
        assert [one.overruled_by for one in found.notes] == [[], [], ["c"]]
        assert found.notes[1].tier == 3 and found.notes[1].title == "Title of c"

    told(kept, story)


@pytest.mark.parametrize(
    "what, said",
    [
        ("interaction 00000000000000ff", "in the agents' log nowhere"),
        ("interaction 00000000000000cc", "is no question, but something computed"),
    ],
)
def test_what_a_proposal_names_and_nobody_finds_is_said(what: str, said: str):
    async def story(_: Interactions, ask: Ask) -> None:
        found = AskedTold.model_validate_json(await ask(Evidence(what=what), naming(f"{1:016x}")))
        assert [one.interaction for one in found.asked] == [f"{1:016x}"]
        (sentence,) = found.missing
        assert said in sentence

    told([interaction(1), computation(0xCC)], story)


@pytest.mark.parametrize("what", ["interaction 1", "interaction of spans 2 and 3", "interaction ../../etc"])
def test_what_is_no_id_is_plain_evidence_and_so_is_what_has_a_number(what: str):
    async def story(_: Interactions, ask: Ask) -> None:
        numbered = naming(f"{1:016x}").model_copy(update={"value": 4.1})
        found = AskedTold.model_validate_json(await ask(Evidence(what=what), numbered))
        assert found.asked == [] and found.notes == [] and found.missing == []

    told([interaction(1)], story)


def test_what_was_told_stays_whatever_the_log_says_later():
    async def story(log: Interactions, ask: Ask) -> None:
        first = await ask(naming(f"{1:016x}"))
        log.path.unlink()
        one = interaction(1, note("another"))
        log.keep(pack(one), one)
        assert await ask(naming(f"{1:016x}"), again=True) == first

    told([interaction(1, note("a"))], story)


def test_without_a_log_it_is_said_and_with_a_damaged_one_too():
    async def story(log: Interactions, ask: Ask) -> None:
        found = AskedTold.model_validate_json(await ask(naming(f"{1:016x}")))
        assert found.asked == [] and "no agent has been asked anything yet" in found.missing[0]
        (log.path.parent / FILE_NAME).write_bytes(b"no database" * 1000)
        found = AskedTold.model_validate_json(await ask(naming(f"{2:016x}")))
        assert found.asked == [] and "damaged" in found.missing[0]

    told([], story)


def test_whatever_agents_have_written_the_answer_fits_a_message():
    long = "\x01" * 2_000  # as JSON six bytes each
    question = QUESTION.model_copy(update={"task": long[:600], "options": [
        one.model_copy(update={"title": long[:600]}) for one in QUESTION.options
    ]})  # fmt: skip
    names = [f"{k}{long}" for k in range(8)]
    kept = [
        interaction(
            k, *(note(f"{k}-{i}{long}", passage=long, overruled_by=names) for i in range(2)), instead=long[:1000]
        ).model_copy(update={"question": question})
        for k in range(1, MOST_ASKED + 4)
    ]

    async def story(_: Interactions, ask: Ask) -> None:
        answer = await ask(*(naming(one.id) for one in kept))
        found = AskedTold.model_validate_json(answer)
        assert len(answer) < MAX_PAYLOAD and len(found.asked) == MOST_ASKED and len(found.notes) == MOST_NOTES
        assert found.notes[0].passage == f"{long[:MOST_PASSAGE]} ..."
        assert "3 more questions" in found.missing[-1]

    told(kept, story)


def test_what_is_asked_of_no_proposal_or_of_a_gate_that_is_shut_is_refused():
    async def whole() -> None:
        with short_folder() as folder:
            gateway, served, way = await started(), UnixMailbox(), UnixMailbox()
            open_ = False
            AskedDesk(served, lambda: gateway.deployer if open_ else None, Interactions(folder))
            await served.listen(folder / "gateway.sock")
            way.connect((GATEWAY_ASKED,), folder / "gateway.sock")

            async def refusal(payload: bytes) -> str:
                reply = Reply.model_validate_json(await way.request(GATEWAY_ASKED, payload, 5.0))
                assert not reply.ok and reply.reasons
                return reply.text

            unknown = json.dumps({"proposal": "ab" * 32}).encode()
            assert "not understood" in await refusal(b'{"proposal": "ab"}')
            assert "not understood" in await refusal(b"nonsense")
            assert "the gate is shut" in await refusal(unknown)
            open_ = True
            assert "it is not told" in await refusal(unknown)
            await way.close()
            await served.close()

    asyncio.run(whole())
