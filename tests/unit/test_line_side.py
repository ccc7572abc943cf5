"""What the operator's process asks of a real gateway process: told, done in a person's name, known after a kill."""

import asyncio
import signal
import time
from pathlib import Path

import pytest

from gateway.core.access import CameIn
from gateway.core.alarms import ShelveAlarm
from gateway.core.decisions import Decide
from gateway.core.line_past import TensionsBetween
from gateway.core.messages import Stop
from gateway.core.people import Person
from gateway.core.topics import LOOP_TELEMETRY
from gateway.mailbox.unix import UnixMailbox
from gateway.operator.line_side import TOPICS, LineSide, NotTold
from gateway.supervisor.bounded import AT_ONCE
from tests.unit.supervisor_support import frame_of, until
from tests.unit.test_supervisor_process import gateway, loop_and_client, run

pytestmark = pytest.mark.wires

ANNA = Person(name="anna", role="operator", through="opc-ua", certificate="c" * 64)


def side_of(folder: Path) -> tuple[LineSide, UnixMailbox]:
    mailbox = UnixMailbox()
    mailbox.connect(TOPICS, folder / "gateway.sock")
    return LineSide(mailbox), mailbox


async def told(side: LineSide, kind: str) -> str:
    """The sentence of the newest record of a kind, once there is one."""
    while True:
        try:
            found = [one for one in (await side.records()).records if one.kind == kind]
        except NotTold:
            found = []  # the audit is about to be begun
        if found:
            return found[-1].text
        await asyncio.sleep(0.01)


def test_what_a_person_says_is_done_recorded_and_told_again() -> None:
    async def story(folder: Path) -> None:
        with gateway(folder) as process:
            side, mailbox = side_of(folder)
            await told(side, "gateway-start")
            assert (await side.say(ANNA, ShelveAlarm(alarm="cycles-late", for_s=600.0, because="a trial"))).ok
            assert "loop not running" in (await side.say(ANNA, Stop())).text
            viewer = ANNA.model_copy(update={"role": "viewer"})
            assert "takes an operator" in (await side.say(viewer, Stop())).text
            newest = await side.records()
            assert [one.kind for one in newest.records[-3:]] == ["shelved", "operated", "refused-person"]
            assert newest.records[-3].text.startswith("anna (operator, opc-ua) shelves alarm cycles-late for 10 min")
            assert (await side.records(after=newest.last)).records == []
            process.send_signal(signal.SIGKILL)
            process.wait(10.0)
            assert not (await side.say(ANNA, Stop())).ok
            with pytest.raises(NotTold, match="r2rgate gateway"):
                await side.records()
            await mailbox.close()
        with gateway(folder):
            side, mailbox = side_of(folder)
            watching = asyncio.create_task(side.watch())

            def shelved():
                return [one.name for one in side.status.alarms if one.shelved_until_wall_s] if side.status else []

            await until(lambda: shelved() == ["cycles-late"])  # once the audit has been read, which says so
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)
            await mailbox.close()

    run(story)


def test_tensions_of_the_last_seconds_are_told_and_a_loop_that_is_gone_is_an_alarm() -> None:
    async def story(folder: Path) -> None:
        with gateway(folder):
            async with loop_and_client(folder) as (loop, _):
                side, mailbox = side_of(folder)
                watching = asyncio.create_task(side.watch())
                await until(lambda: side.status is not None)
                for k in range(150):
                    assert loop.publish(LOOP_TELEMETRY, frame_of(k, time.monotonic()))
                await until(lambda: side.status is not None and side.status.historian.frames_stored == 150)
                now_s = time.time()
                found = await side.tensions(TensionsBetween(from_wall_s=now_s - 60.0, to_wall_s=now_s + 60.0))
                known = [value for value in found.tension_n[5] if value is not None]
                assert known and all(39.0 < value < 41.0 for value in known)
                await until(lambda: side.status is not None and "loop-lost" in {one.name for one in side.status.alarms})
                watching.cancel()
                await asyncio.gather(watching, return_exceptions=True)
                await mailbox.close()

    run(story)


def test_a_refused_decision_and_who_came_in_are_on_record_and_no_more_often_than_need_be() -> None:
    async def story(folder: Path) -> None:
        with gateway(folder):
            side, mailbox = side_of(folder)
            await told(side, "gateway-start")
            assert await side.at_the_door(CameIn(person=ANNA, address="192.0.2.7"))
            for _ in range(3 * AT_ONCE):
                assert not (await side.say(ANNA, Decide(proposal="a" * 64, shown="b" * 64, approve=True))).ok
            kinds = [one.kind for one in (await side.records()).records]
            assert kinds.count("refused-decision") == AT_ONCE and kinds.count("logged-in") == 1
            sentence = await told(side, "refused-decision")
            assert sentence.startswith("anna (operator, opc-ua): approval of proposal aaaaaaaaaaaa was refused: ")
            assert await told(side, "logged-in") == "anna (operator, opc-ua) has come in from 192.0.2.7"
            await mailbox.close()

    run(story)
