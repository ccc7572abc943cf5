"""A fake gateway on a real mailbox, the OPC UA server in front of it, and clients of every kind."""

import asyncio
import gc
import json
import logging
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from asyncua import Client, ua
from asyncua.crypto import security_policies as policies
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from gateway.cli.certificates import Pair
from gateway.cli.pki_opcua import self_signed, trust
from gateway.core.access import AT_THE_DOOR
from gateway.core.alarms import BY_NAME, AlarmStatus
from gateway.core.decisions import QUERY, InServiceTold, ListProposals, ProposalLine, ProposalList, ProposalShown
from gateway.core.line import Line
from gateway.core.line_past import PAST_QUERY, RecordsAfter, RecordsTold, RecordTold, TensionsTold
from gateway.core.messages import Reply
from gateway.core.people import FOR_PERSON, ForPerson
from gateway.core.proposal import Proposal, proposal_hash
from gateway.core.states import STATE_OF, Phase
from gateway.core.status import (
    BusStatus,
    EventStatus,
    GatewayStatus,
    HistorianStatus,
    LimitsStatus,
    LinkStatus,
    LoopStatus,
    SpanStatus,
    TimingStatus,
)
from gateway.core.topics import GATEWAY_ACCESS, GATEWAY_FOR_PERSON, GATEWAY_PAST, GATEWAY_PROPOSALS, GATEWAY_STATUS
from gateway.core.verdict import RuleFinding, ScenarioFigures, Verdict
from gateway.mailbox.unix import UnixMailbox
from gateway.operator.access import Access
from gateway.operator.line_side import TOPICS, LineSide
from gateway.operator.opcua.service import OpcUa
from gateway.operator.opcua.space import NAMESPACE
from gateway.operator.users import UsersFile
from tests.operator.names import PASSWORD
from tests.unit.supervisor_support import line_of, short_folder

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
SHOWN = "5" * 64
NUMBER = 2  #: of the namespace of the line's nodes
USERS = {"vera": "viewer", "otto": "operator", "emma": "engineer"}
logging.getLogger("asyncua").setLevel(logging.CRITICAL)


class FakeGateway:
    """Says what the tests set, and keeps what people have said."""

    def __init__(self, line: Line, mailbox: UnixMailbox) -> None:
        self.line = line
        self.heard: list[ForPerson] = []
        self.reply = Reply(ok=True, state="RUN", text="done")
        self.running, self.quality, self.tension_n = True, "GOOD", 20.0
        self.phase, self.by_person, self.standstill = Phase.RUNNING, False, False
        self.waiting: list[ProposalShown] = []
        self.hidden: set[str] = set()  #: proposals that are listed, and not shown
        self.lists = True  #: proposals, when it is asked
        self.epoch = 3
        self.controller: InServiceTold | None = None
        self.alarms: list[AlarmStatus] = []
        self.records: list[RecordTold] = []
        self.hold: asyncio.Event | None = None  #: until then nothing that people say is answered
        self.hold_past: asyncio.Event | None = None  #: until then no tensions are told
        self.asked_past: list[Any] = []
        self.past_quality: list[list[int]] = []
        mailbox.serve(GATEWAY_STATUS, self._status)
        mailbox.serve(GATEWAY_PROPOSALS, self._proposals)
        mailbox.serve(GATEWAY_PAST, self._past)
        self.at_the_door: list[Any] = []
        mailbox.serve(GATEWAY_FOR_PERSON, self._person)
        mailbox.serve(GATEWAY_ACCESS, self._access)

    async def _status(self, _: bytes) -> bytes:
        return self.status().model_dump_json().encode()

    def status(self) -> GatewayStatus:
        spans = [
            SpanStatus(
                number=k + 1, name=span.name, control=span.control, tension_n=self.tension_n + k, setpoint_n=20.0 + k,
                error_n=self.tension_n - 20.0, quality=self.quality, roller=self.line.rollers[k].name,
                speed_m_per_s=0.1, torque_nm=5.0, torque_actual_nm=5.1, drive="ENABLED",
            )
            for k, span in enumerate(self.line.spans)
        ]  # fmt: skip
        limits = self.line.limits
        return GatewayStatus(
            format=1, site=self.line.site, line=self.line.line, wall_s=datetime.now(UTC).timestamp(), uptime_s=9.0,
            loop=LoopStatus(running=self.running, state=STATE_OF[self.phase].name if self.running else "UNKNOWN",
                            phase=self.phase.name if self.running else "UNKNOWN",
                            by_person=self.by_person, standstill=self.standstill, text="controlled",
                            next="hold", age_s=0.01, period_s=0.01, held=0, saturated=False, doubts=[], restarts=0),
            unwind_speed_m_per_s=0.1, speed_setpoint_m_per_s=0.1, stands=True, change=None,
            limits=LimitsStatus(tension_min_n=limits.tension_min_n, tension_max_n=limits.tension_max_n,
                                torque_nm=limits.torque_nm),
            spans=spans, timing=TimingStatus(frames=0, cycle=None, lateness=None, missed=0, missed_total=0),
            link=LinkStatus(frames=1, dropped_frames=0, malformed=0, refused=0), buses=[],
            agents_bus=BusStatus(open=True, text="", agents=[], refused=0),
            historian=HistorianStatus(storing=True, text="", path="", frames_stored=0, frames_lost=0, events_lost=0,
                                      last_stored_age_s=None, moved_aside=""),
            alarms=self.alarms, events=[EventStatus(wall_s=1.0, kind="state", text="RUN")],
        )  # fmt: skip

    async def _proposals(self, payload: bytes) -> bytes:
        query = QUERY.validate_json(payload)
        if isinstance(query, ListProposals):
            told = self._list() if self.lists else Reply(ok=False, state="", text="the storage does not answer")
            return told.model_dump_json().encode()
        for one in self.waiting:
            if one.proposal_hash.startswith(query.proposal) and one.proposal_hash not in self.hidden:
                return one.model_dump_json().encode()
        return Reply(ok=False, state="", text="there is no such proposal").model_dump_json().encode()

    def _list(self) -> ProposalList:
        rows = [
            ProposalLine(proposal=one.proposal_hash, kind=one.proposal.kind, author=one.proposal.author,
                         stage=one.stage, why="", created=one.proposal.created, expires=one.proposal.expires,
                         epoch=None)
            for one in self.waiting
        ]  # fmt: skip
        return ProposalList(format=1, site=self.line.site, line=self.line.line, in_service="a" * 64,
                            last_known_good="b" * 64, epoch=self.epoch, model=None, since_change=0,
                            controller=self.controller, proposals=rows)  # fmt: skip

    async def _past(self, payload: bytes) -> bytes:
        query = PAST_QUERY.validate_json(payload)
        self.asked_past.append(query)
        last = self.records[-1].sequence if self.records else 0
        if isinstance(query, RecordsAfter):
            newer = [one for one in self.records if query.after is None or one.sequence > query.after]
            return RecordsTold(format=1, last=last, records=newer).model_dump_json().encode()
        if query.from_wall_s < 1.0e9:  # before there was a line
            return (
                TensionsTold(format=1, wall_s=[], tension_n=[], setpoint_n=[], speed_m_per_s=[])
                .model_dump_json()
                .encode()
            )
        if self.hold_past is not None:
            await self.hold_past.wait()
        n = self.line.n
        return TensionsTold(
            format=1, wall_s=[query.from_wall_s, query.from_wall_s + 1.0, query.to_wall_s],
            tension_n=[[19.0 + k, None, 21.0 + k] for k in range(n)], setpoint_n=[[20.0, 20.0, 20.0]] * n,
            speed_m_per_s=[0.1, 0.1, 0.1], quality=self.past_quality,
        ).model_dump_json().encode()  # fmt: skip

    async def _person(self, payload: bytes) -> bytes:
        if self.hold is not None:
            await self.hold.wait()
        self.heard.append(FOR_PERSON.validate_json(payload))
        return self.reply.model_dump_json().encode()

    async def _access(self, payload: bytes) -> bytes:
        self.at_the_door.append(AT_THE_DOOR.validate_json(payload))
        return Reply(ok=True, state="", text="recorded").model_dump_json().encode()


def alarm(name: str, acknowledged_by: str = "", shelved: bool = False) -> AlarmStatus:
    row = BY_NAME[name]
    return AlarmStatus(
        name=name, priority=row.priority, means=row.means, text="span 1 has 3 N", cause=row.cause,
        consequence=row.consequence, action=row.action, active=True, acknowledged=bool(acknowledged_by),
        first_out=True, since_wall_s=1.7e9, ended_wall_s=None, acknowledged_by=acknowledged_by,
        shelved_until_wall_s=1.8e9 if shelved else None,
    )  # fmt: skip


def shown(epoch: int = 3, reason: str = "span 2 swings") -> ProposalShown:
    document = json.loads((EXAMPLES / "proposal.json").read_text(encoding="utf-8"))
    proposal = Proposal.model_validate(document | {"reason": reason})
    verdict = Verdict(
        format=1, proposal=proposal_hash(proposal), payload="c" * 64, context="d" * 64, line="e" * 64, kind="gains",
        seed=1, accepted=True, judged="2026-01-01T00:00:00Z", program_version="1",
        findings=[
            RuleFinding(rule="delay margin", passed=True, text="6 ms", value=0.006, limit=0.004, margin=0.002,
                        unit="s"),
            RuleFinding(rule="shape", passed=True, text="it fits the line"),
        ],
        figures=[
            ScenarioFigures(scenario="tension step", configuration="in service", rmse_n=2.0, overshoot_pct=30.0,
                            settling_s=None, effort_n2m2s=9.0),
            ScenarioFigures(scenario="tension step", configuration="proposed", rmse_n=1.0, overshoot_pct=5.0,
                            settling_s=2.0, effort_n2m2s=8.0),
        ],
    )  # fmt: skip
    return ProposalShown(
        format=1, stage="waiting", why="", proposal_hash=proposal_hash(proposal), shown=SHOWN, epoch=epoch,
        difference=["gain of span 2 from 1 to 2"], proposal=proposal, verdict=verdict,
    )  # fmt: skip


@cache
def pair(name: str, uri: str = "") -> Pair:
    return self_signed(name, uri or f"urn:test:{name}", ["127.0.0.1", "localhost"], datetime.now(UTC))


def der(of: Pair) -> bytes:
    return x509.load_pem_x509_certificate(of.certificate).public_bytes(Encoding.DER)


class Bench:
    """Everything of a test."""

    def __init__(self, line: Line, folder: Path) -> None:
        self.line, self.folder, self.pki = line, folder, folder / "pki"
        self.said: list[str] = []
        self.gateway_mailbox = UnixMailbox()
        self.gateway = FakeGateway(line, self.gateway_mailbox)
        self.checks = 0
        self.port: int | None = None  #: by which clients go, where it is not the server's own
        mailbox = UnixMailbox()
        mailbox.connect(TOPICS, folder / "gateway.sock")
        self.mailbox = mailbox
        self.side = LineSide(mailbox)
        self.pki.mkdir()
        _write(self.pki, "opcua-server", pair("server", "urn:r2rgate:test:line"))
        trust(self.pki, pair("client").certificate)
        self.users = dict(USERS)  #: as the users' file has them now
        self.access = Access(self.side, UsersFile(folder / "users.toml"), self.said.append, time.monotonic)
        self.opcua = OpcUa(
            line, self.side, self.pki, self._check, self.users.get, self.said.append, self.access
        )  # fmt: skip

    async def _check(self, name: str, password: str):
        self.checks += 1
        return self.users.get(name) if password == PASSWORD else None

    @property
    def url(self) -> str:
        return f"opc.tcp://127.0.0.1:{self.port or self.opcua.server.port}"

    def id(self, path: str) -> Any:
        return ua.NodeId(path, NUMBER)

    async def client(
        self,
        user: str | None = "otto",
        password: str = PASSWORD,
        of: str = "client",
        policy: Any = policies.SecurityPolicyBasic256Sha256,
        mode: Any = ua.MessageSecurityMode.SignAndEncrypt,
        timeout_s: float = 10.0,
    ) -> Client:
        """Not connected yet."""
        client = Client(self.url, timeout=timeout_s)
        client.application_uri = f"urn:test:{of}"
        if policy is not None:
            _write(self.folder, of, pair(of))
            await client.set_security(
                policy, self.folder / f"{of}.pem", self.folder / f"{of}.key.pem",
                server_certificate=self.pki / "opcua-server.pem", mode=mode,
            )  # fmt: skip
        if user is not None:
            client.set_user(user)
            client.set_password(password)
        return client

    @asynccontextmanager
    async def connected(self, *words: Any, **named: Any) -> AsyncIterator[Client]:
        client = await self.client(*words, **named)
        async with client:
            assert (await client.get_namespace_array())[NUMBER] == NAMESPACE
            yield client

    async def read(self, client: Client, path: str) -> Any:
        return await client.get_node(self.id(path)).read_data_value(raise_on_bad_status=False)

    async def value(self, client: Client, path: str) -> Any:
        return (await self.read(client, path)).Value.Value

    async def until(self, client: Client, path: str, right: Callable[[Any], bool]) -> Any:
        """Read until it is so; the test's time limit ends what never comes."""
        while not right(found := await self.read(client, path)):  # noqa: ASYNC110 (it is on the wire)
            await asyncio.sleep(0.02)
        return found

    def sessions(self) -> int:
        return len(self.opcua.server.iserver._external_sessions)  # noqa: SLF001 (there is no other way to count)

    async def looked_at_trust(self) -> None:
        """What is in the folder of the trusted now counts."""
        await asyncio.to_thread(self.opcua.trust.look)

    async def call(self, client: Client, method: str, *arguments: Any) -> tuple[int, list[Any]]:
        """Status code and output arguments of a method of the line."""
        request = ua.CallMethodRequest(self.id("Line"), self.id(f"Line.{method}"), list(arguments))
        (result,) = await client.uaclient.call([request])
        return result.StatusCode.value, [one.Value for one in result.OutputArguments or ()]


async def comes(right: Callable[[], bool]) -> None:
    """What a thread or the other side of a socket does; the test's time limit ends what never comes."""
    while not right():  # noqa: ASYNC110 (there is no event to wait for)
        await asyncio.sleep(0.02)


@asynccontextmanager
async def bench(
    spans: int = 2, gateway: bool = True, begin: bool = True, line: Line | None = None, **operator: Any
) -> AsyncIterator[Bench]:
    """A running server of `line`, or of one with so many spans.

    Without `gateway` nobody answers it, without `begin` it is only made.
    """
    line = line or line_of(spans)
    settings = line.operator.model_copy(update={"opc_ua": "opc.tcp://127.0.0.1:0", **operator})
    with short_folder() as folder:
        found = Bench(line.model_copy(update={"operator": settings}), folder)
        if gateway:
            await found.gateway_mailbox.listen(folder / "gateway.sock")
        tasks: list[asyncio.Task[Any]] = []
        try:
            tasks.append(asyncio.create_task(found.side.watch()))
            if begin:
                await found.opcua.start()
                tasks.append(asyncio.create_task(found.opcua.run()))
            gc.freeze()  # half a million nodes and references that stay, as the operator process does
            yield found
            assert not any(task.done() for task in tasks), [task.exception() for task in tasks if task.done()]
        finally:
            gc.unfreeze()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await found.opcua.stop()
            await found.mailbox.close()
            await found.gateway_mailbox.close()


def _write(folder: Path, name: str, of: Pair) -> None:
    (folder / f"{name}.pem").write_bytes(of.certificate)
    (folder / f"{name}.key.pem").write_bytes(of.private_key)
