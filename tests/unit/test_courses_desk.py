"""Courses of what waits, over a real socket: nobody waits for them, they are drawn once, and of nothing else."""

import asyncio
import json
from collections.abc import Awaitable, Callable

import pytest

from gateway.core.controller import config_hash
from gateway.core.courses import Courses, CoursesTold, DrawnCourse
from gateway.core.messages import Reply
from gateway.core.proposal import canonical
from gateway.core.topics import GATEWAY_COURSES
from gateway.mailbox.port import RemoteError
from gateway.mailbox.unix import UnixMailbox
from gateway.supervisor.courses_desk import MOST_KEPT, CoursesDesk
from gateway.supervisor.judging import TIME_RULE, NoVerdict
from tests.unit.deployer_gateway import Gateway, started
from tests.unit.deployer_support import FIRST, hash_of, proposal
from tests.unit.supervisor_support import short_folder

DRAWN = DrawnCourse(
    scenario="tension", time_s=[0.0], setpoint_n=[[20.0]], tension_n={"in service": [[20.0]], "proposed": [[21.0]]}
)
Ask = Callable[[str], Awaitable[bytes]]


class Draws:
    """Counts; `fails` first."""

    def __init__(self, *fails: Exception) -> None:
        self.fails = list(fails)
        self.asked: list[bytes] = []

    async def courses(self, payload, context, region) -> Courses:
        self.asked.append(payload)
        if self.fails:
            raise self.fails.pop(0)
        return Courses(courses=[DRAWN])


def told(judge: Draws, story: Callable[[Gateway, Ask], Awaitable[None]]) -> None:
    async def whole() -> None:
        with short_folder() as folder:
            served, asked, gateway = UnixMailbox(), UnixMailbox(), await started()
            desk = CoursesDesk(served, lambda: gateway.deployer, judge)
            await served.listen(folder / "gateway.sock")
            asked.connect((GATEWAY_COURSES,), folder / "gateway.sock")

            async def ask(hash_: str) -> bytes:
                return await asked.request(GATEWAY_COURSES, json.dumps({"proposal": hash_}).encode(), 5.0)

            await story(gateway, ask)
            await desk.close()
            await asked.close()
            await served.close()

    asyncio.run(whole())


async def waiting(gateway: Gateway, number: int = 1):
    one = proposal(number, config_hash(FIRST), gateway.loop.now_s)
    assert (await gateway.propose(one)).ok
    return one


async def drawn(ask: Ask, hash_: str) -> CoursesTold:
    while (found := CoursesTold.model_validate_json(await ask(hash_))).drawing:
        assert found.courses == []
    return found


def test_the_first_to_ask_is_told_to_ask_again_and_they_are_drawn_once():
    judge = Draws()

    async def story(gateway: Gateway, ask: Ask) -> None:
        one = await waiting(gateway)
        assert CoursesTold.model_validate_json(await ask(hash_of(one))).drawing
        for _ in range(3):
            found = await drawn(ask, hash_of(one))
            assert found.courses == [DRAWN]
            assert found.verdict == gateway.deployer.book.entries[hash_of(one)].verdict
        assert judge.asked == [canonical(one)]

    told(judge, story)


def test_what_cannot_be_drawn_is_not_tried_again():
    judge = Draws(NoVerdict(TIME_RULE, "too long"))

    async def story(gateway: Gateway, ask: Ask) -> None:
        one = await waiting(gateway)
        assert (await drawn(ask, hash_of(one))).courses == []
        assert (await drawn(ask, hash_of(one))).courses == []
        assert len(judge.asked) == 1

    told(judge, story)


def test_a_fault_while_they_are_drawn_is_told_to_whoever_asks_next_who_may_ask_again():
    judge = Draws(KeyError("gain"))

    async def story(gateway: Gateway, ask: Ask) -> None:
        one = await waiting(gateway)
        with pytest.raises(RemoteError, match="KeyError"):
            await drawn(ask, hash_of(one))
        assert (await drawn(ask, hash_of(one))).courses == [DRAWN]

    told(judge, story)


def test_what_waits_no_more_keeps_its_courses_and_gets_no_new_ones():
    judge = Draws()

    async def story(gateway: Gateway, ask: Ask) -> None:
        seen, unseen = await waiting(gateway), await waiting(gateway, 2)
        await drawn(ask, hash_of(seen))
        for one in (seen, unseen):
            assert (await gateway.decide(one, approve=False)).ok
        assert (await drawn(ask, hash_of(seen))).courses == [DRAWN]
        for hash_ in (hash_of(unseen), "0" * 64):
            refused = Reply.model_validate_json(await ask(hash_))
            assert not refused.ok and refused.reasons
        assert not Reply.model_validate_json(await ask("nonsense")).ok
        assert len(judge.asked) == 1

    told(judge, story)


def test_however_many_wait_each_is_drawn_once_and_of_what_waits_no_more_the_last_asked_for_are_kept():
    judge, count = Draws(), 2 * MOST_KEPT

    async def story(gateway: Gateway, ask: Ask) -> None:
        every = [await waiting(gateway, number) for number in range(1, count + 1)]
        for _ in range(2):
            for one in every:
                assert (await drawn(ask, hash_of(one))).courses == [DRAWN]
        assert len(judge.asked) == count
        for one in every:
            assert (await gateway.decide(one, approve=False)).ok
        await drawn(ask, hash_of(every[0]))
        await drawn(ask, hash_of(await waiting(gateway, count + 1)))  # room is made with the next
        for one in [every[0], *every[-MOST_KEPT + 1 :]]:
            assert (await drawn(ask, hash_of(one))).courses == [DRAWN]
        for one in every[1 : -MOST_KEPT + 1]:
            assert not Reply.model_validate_json(await ask(hash_of(one))).ok

    told(judge, story)
