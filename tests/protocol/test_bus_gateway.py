"""The gateway process on the agents' bus: it serves agents, tells who is there, and does all else without the bus."""

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import apsw
import pytest
from typer.testing import CliRunner

from gateway.cli.asked_agents import AskedAgents
from gateway.cli.audit_against import head_in
from gateway.cli.main import app
from gateway.control.design import design_lqi, task_of
from gateway.core.audit_head import parse_head
from gateway.core.audit_record import BEFORE_FIRST, Who, head_of
from gateway.core.audit_record import canonical as canonical_record
from gateway.core.decisions import ProposalList
from gateway.core.messages import Reply
from gateway.core.proposal import Proposal, canonical
from gateway.core.status import GatewayStatus
from gateway.core.topics import AGENT_DECIDE, ASK_JUDGE, ASK_LOG, ASK_PROPOSALS, ASK_PROPOSE, ASK_STATUS, GATEWAY_STATUS
from gateway.mailbox.paths import BUS_SOCKET, GATEWAY_DATA, GATEWAY_SOCKET
from gateway.mailbox.port import RemoteError
from gateway.mailbox.unix import UnixMailbox
from gateway.mailbox.zenoh_mailbox import ZenohMailbox
from gateway.supervisor.audit_anchor import Anchor, write_anchor
from gateway.supervisor.audit_file import FILE_NAME, AuditFile
from gateway.supervisor.proposal_records import iso
from tests.protocol.bus_support import AGENT, LINE, LONG_S, client, is_here, run
from tests.unit.language_model_support import QUESTION
from tests.unit.supervisor_support import child, until

pytestmark = pytest.mark.wires

GATEWAY = """
import sys
from pathlib import Path
from gateway.core.line import Network
from gateway.supervisor.process import run_gateway
from tests.protocol.bus_support import LINE
network = None
if len(sys.argv) > 2:
    network = Network(listen="tls/127.0.0.1:1", certificate="/no/a.pem", private_key="/no/k.pem",
                      authority="/no/c.pem", names=["agents"])
line = LINE.model_copy(update={"network": network})
sys.exit(run_gateway(line, Path(sys.argv[1]), Path(sys.argv[1]) / "data"))
"""

AGENTS = """
import sys
from pathlib import Path
from agents.process import run_agents
from tests.protocol.bus_support import LINE
sys.exit(run_agents(LINE, Path(sys.argv[1]), Path(sys.argv[2]) / "knowledge", Path(sys.argv[2]) / "heads.txt"))
"""


@contextmanager
def gateway(*arguments: Path) -> Iterator[None]:
    with child(GATEWAY, *arguments) as (process, said):
        assert said.startswith("gateway of demo/line-1")
        yield
        process.terminate()
        assert process.wait(LONG_S) == 0


async def status_with(folder: Path, condition: Callable[[GatewayStatus], bool]) -> GatewayStatus:
    """As a person is told it, once it is so."""
    mailbox = UnixMailbox()
    mailbox.connect((GATEWAY_STATUS,), folder / GATEWAY_SOCKET)
    try:
        while True:
            status = GatewayStatus.model_validate_json(await mailbox.request(GATEWAY_STATUS, b"", LONG_S))
            if condition(status):
                return status
            await asyncio.sleep(0.01)
    finally:
        await mailbox.close()


def told(text: str) -> Callable[[GatewayStatus], bool]:
    return lambda status: text in {event.text for event in status.events}


def of_agents() -> Proposal:
    return Proposal.model_validate(
        {
            "format": 1, "site": LINE.site, "line": LINE.line, "base": "0" * 64, "model": None, "reason": "a test",
            "change": {"kind": "gains", "controller": design_lqi(task_of(LINE)).model_dump()}, "author": "agents",
            "created": iso(1.7e9), "expires": iso(4e9),
        }
    )  # fmt: skip


async def proposed(agents: ZenohMailbox) -> Reply:
    """Once the gate is open."""
    while True:
        reply = Reply.model_validate_json(await agents.request(ASK_PROPOSE.of("sysid"), canonical(of_agents()), LONG_S))
        if reply.text != "the gate is shut":
            return reply
        await asyncio.sleep(1.0 / ASK_PROPOSE.most_per_s)


def test_agents_propose_look_and_try_over_the_bus_and_are_named_in_the_audit() -> None:
    async def story(folder: Path) -> None:
        with gateway(folder):
            await status_with(folder, lambda status: status.agents_bus.open)
            async with client(folder) as agents:
                seen = GatewayStatus.model_validate_json(await agents.request(ASK_STATUS.of("sysid"), b"", LONG_S))
                assert (seen.site, seen.line) == ("demo", "line-1")
                reply = await proposed(agents)
                assert reply.ok, reply
                query = b'{"command": "list"}'
                listed = await agents.request(ASK_PROPOSALS.of("sysid"), query, LONG_S)
                (entry,) = ProposalList.model_validate_json(listed).proposals
                assert entry.author == "agents"
                tried = await agents.request(ASK_JUDGE.of("sysid"), canonical(of_agents()), LONG_S)
                assert "start it" in Reply.model_validate_json(tried).reasons[0]  # there is no loop
            after = await status_with(folder, lambda status: "dry-run" in {event.kind for event in status.events})
            assert any(one.kind == "proposal" and one.text.startswith("agent sysid: ") for one in after.events)
        with AuditFile(folder / "data" / GATEWAY_DATA) as file:
            who = [record.who for record in (row.record() for row in file.rows()) if record.kind == "proposed"]
        assert who == [Who(name="agent sysid")]

    run(story)


def test_people_see_which_agents_are_there() -> None:
    async def story(folder: Path) -> None:
        with gateway(folder):
            await status_with(folder, lambda status: status.agents_bus.open)
            with child(AGENT, folder) as (process, said):
                assert said == "up\n"
                await status_with(folder, lambda status: status.agents_bus.agents == ["sysid"])
                await status_with(folder, told("agent sysid answers questions"))
                async with client(folder) as phases:
                    assert await phases.request(AGENT_DECIDE.of("sysid"), b"x", LONG_S) == b"chosen: x"
                process.kill()
                await status_with(folder, lambda status: status.agents_bus.agents == [])
            await status_with(folder, told("agent sysid answers no questions any more"))

    run(story)


def test_certificates_that_cannot_be_read_close_the_bus_beyond_this_machine_alone() -> None:
    async def story(folder: Path) -> None:
        with gateway(folder, Path("with a network")):
            status = await status_with(folder, lambda status: status.agents_bus.open)
            assert status.agents_bus.text.startswith("it is not open on tls/127.0.0.1:1: ")
            (event,) = [event for event in status.events if event.kind == "agents-bus"]
            assert status.agents_bus.text in event.text and ".rs" not in event.text
            async with client(folder) as agents:
                assert await agents.request(ASK_STATUS.of("sysid"), b"", LONG_S)

    run(story)


def test_without_its_bus_the_gateway_does_all_else_and_says_why_it_is_closed() -> None:
    async def story(folder: Path) -> None:
        (folder / BUS_SOCKET).mkdir()
        with gateway(folder):
            status = await status_with(folder, lambda status: "could not be opened" in status.agents_bus.text)
            assert not status.agents_bus.open
            (event,) = [event for event in status.events if event.kind == "agents-bus"]
            assert "the agents' bus is closed" in event.text
            assert ".rs" not in event.text

    run(story)


def test_a_flood_of_requests_is_told_once_and_people_are_answered_meanwhile() -> None:
    async def story(folder: Path) -> None:
        with gateway(folder):
            await status_with(folder, lambda status: status.agents_bus.open)
            async with client(folder) as agents:
                asked = [agents.request(ASK_STATUS.of("sysid"), b"", LONG_S) for _ in range(300)]
                flood = asyncio.gather(*asked, return_exceptions=True)
                await status_with(folder, lambda status: status.agents_bus.refused > 0)
                await flood
            status = await status_with(
                folder, lambda status: any(event.kind == "agents-refused" for event in status.events)
            )
            texts = [event.text for event in status.events if event.kind == "agents-refused"]
            assert len(texts) <= 5 and "requests of agents were turned away" in texts[0]

    run(story)


def test_agents_that_die_flood_or_talk_nonsense_are_on_record_and_so_is_who_went_on_without_them() -> None:
    def recorded(folder: Path) -> dict[str, dict[str, Any]]:
        with AuditFile(folder / "data" / GATEWAY_DATA) as file:
            found = [record.what for record in (row.record() for row in file.rows()) if record.kind == "agents"]
        assert len(found) == len({str(what["case"]) for what in found})  # no case twice in a minute
        return {str(what["case"]): dict(what) for what in found}

    async def story(folder: Path) -> None:
        with gateway(folder):
            await status_with(folder, lambda status: status.agents_bus.open)
            async with client(folder) as agents, client(folder) as phases:
                with child(AGENT, folder) as (process, _):
                    await status_with(folder, lambda status: status.agents_bus.agents == ["sysid"])
                    process.kill()
                    await status_with(folder, lambda status: status.agents_bus.agents == [])
                question = QUESTION.model_copy(update={"decision": "identify.data"})
                decider = AskedAgents(LINE, phases, asyncio.get_running_loop())
                assert (await asyncio.to_thread(decider.decide, question)).by == "rules"
                assert not Reply.model_validate_json(await agents.request(ASK_LOG.of("code"), b"garbage", LONG_S)).ok
                asked = [agents.request(ASK_STATUS.of("sysid"), b"", LONG_S) for _ in range(300)]
                answers = await asyncio.gather(*asked, return_exceptions=True)
            refused = sum(isinstance(answer, RemoteError) for answer in answers)
            await until(lambda: len(recorded(folder)) == 4)
            found = recorded(folder)
            assert found["gone"]["agents"] == found["unanswered"]["agents"] == ["sysid"]
            assert "nobody answers" in found["unanswered"]["newest"]
            assert found["refused"]["agents"] == ["code"]
            # It may be the record of the flood's beginning: the rest belongs to the next one, a minute later.
            assert 0 < found["turned-away"]["times"] <= refused
            await status_with(folder, lambda status: status.agents_bus.refused == refused)

    run(story)


def test_a_gateway_that_is_killed_while_an_agent_thinks_leaves_the_question_to_the_rules_at_once() -> None:
    async def story(folder: Path) -> None:
        asked = asyncio.Event()

        async def think(_: bytes) -> bytes:
            asked.set()
            await asyncio.sleep(1000.0)
            return b""

        with child(GATEWAY, folder) as (first, _):
            await status_with(folder, lambda status: status.agents_bus.open)
            async with client(folder) as agent, client(folder) as phases:
                agent.serve(AGENT_DECIDE.of("adaptation"), think)
                await is_here(phases, AGENT_DECIDE.of("adaptation"))
                decider = AskedAgents(LINE, phases, asyncio.get_running_loop(), within_s=2.0 * LONG_S)
                deciding = asyncio.create_task(asyncio.to_thread(decider.decide, QUESTION))
                await asked.wait()
                first.kill()
                first.wait()
                assert (await asyncio.wait_for(deciding, LONG_S)).by == "rules"
                with gateway(folder):  # both are back by themselves
                    await status_with(folder, lambda status: status.agents_bus.agents == ["adaptation"])
                    await is_here(phases, AGENT_DECIDE.of("adaptation"))

    run(story)


def test_after_a_gateway_was_killed_the_next_one_takes_its_socket_and_its_agents_are_back() -> None:
    async def story(folder: Path) -> None:
        with child(GATEWAY, folder) as (first, _):
            await status_with(folder, lambda status: status.agents_bus.open)
            with child(AGENT, folder):
                await status_with(folder, lambda status: status.agents_bus.agents == ["sysid"])
                first.kill()
                first.wait()
                with gateway(folder):
                    await status_with(folder, lambda status: status.agents_bus.agents == ["sysid"])

    run(story)


def test_the_heads_that_a_peer_has_kept_show_a_history_that_was_made_anew_from_some_record_on(tmp_path: Path) -> None:
    kept = tmp_path / "heads.txt"

    async def story(folder: Path) -> None:
        data = folder / "data" / GATEWAY_DATA
        with gateway(folder):
            await status_with(folder, lambda status: bool(status.audit_head))
            with child(AGENTS, folder, tmp_path):
                await until(lambda: kept.exists() and kept.read_text().endswith("\n"))
            async with client(folder) as agents:
                assert (await proposed(agents)).ok
            await status_with(folder, lambda status: status.audit_head not in kept.read_text())
            with child(AGENTS, folder, tmp_path):  # as one that was started anew: what was kept before stays
                await until(lambda: len(kept.read_text().splitlines()) == 2)
        assert verified(data, kept) == verified(data) == 0
        first = parse_head(kept.read_text().split()[1])
        made_anew(data, from_=first.sequence + 1)  # it holds the older head still
        assert (verified(data), verified(data, kept)) == (0, 1)
        line, *_ = kept.read_text().splitlines()
        kept.write_text(f"{line}\n")
        assert verified(data, kept) == 0
        made_anew(data, from_=first.sequence)
        kept.write_text(f"{line}\n2026-01-01T00:00:00Z {head_in(data)} demo/line-1\n")  # the last one is good
        assert (verified(data), verified(data, kept)) == (0, 1)

    run(story)


def verified(data: Path, *against: Path) -> int:
    options = [word for path in against for word in ("--against", str(path))]
    return CliRunner().invoke(app, ["audit", "verify", "--data-dir", str(data), *options]).exit_code


def made_anew(data: Path, from_: int) -> None:
    """As whoever may write both files can: sound, and another from this record on."""
    with AuditFile(data) as file:
        rows = list(file.rows())
    previous = rows[from_ - 2].head if from_ > 1 else BEFORE_FIRST
    with apsw.Connection(str(data / FILE_NAME)) as file:
        file.execute("DROP TRIGGER IF EXISTS record_stays")
        for row in rows[from_ - 1 :]:
            record = row.record()
            what = {**record.what, "version": "another"}
            content = canonical_record(record.model_copy(update={"what": what, "previous": previous}))
            previous = head_of(content)
            set_ = "UPDATE record SET content = ?, head = ? WHERE sequence = ?"
            file.execute(set_, (content, previous, row.sequence))
    write_anchor(data, Anchor(len(rows), previous))
