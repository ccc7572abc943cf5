"""The gate of a gateway process: audit, stores, judge and deployer, and what of them is asked over the mailbox."""

import pwd
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from gateway.core.audit_record import Who
from gateway.core.controller import Controller
from gateway.core.decisions import DECISION, QUERY, Decide, ListProposals
from gateway.core.line import Line
from gateway.core.messages import Command, Reply, command_bytes
from gateway.core.proposal import GainsChange, ModelChange, Proposal
from gateway.core.topics import GATEWAY_DECISION, GATEWAY_PROPOSALS, GATEWAY_PROPOSE, LOOP_COMMAND
from gateway.mailbox.port import PEER, Mailbox, Peer, RemoteError
from gateway.supervisor import configurations as configurations_store
from gateway.supervisor import models as models_store
from gateway.supervisor.audit import Audit
from gateway.supervisor.audit_file import AuditFile, AuditUnavailable
from gateway.supervisor.configurations import Origin, begin_configurations
from gateway.supervisor.deployer import GATEWAY, Deployer, JudgeSide
from gateway.supervisor.lifecycle import Book, Impossible, book_of
from gateway.supervisor.models import begin_repository
from gateway.supervisor.recent import Recent
from gateway.supervisor.surroundings import LineSurroundings

LOOP_TIME_S = 2.5


class CannotBegin(Exception):
    """The gate stays shut: its records cannot be read, or do not fit together. The text says why."""


class KeptAudit:
    """The audit of a folder: written by its own thread, read where it lies."""

    def __init__(self, folder: Path, audit: Audit) -> None:
        self._folder = folder
        self._audit = audit

    async def append(
        self, kind: str, who: Who, what: Mapping[str, Any], blobs: Mapping[str, bytes] | None = None
    ) -> object:
        return await self._audit.append(kind, who, what, blobs)

    def blob(self, id_: str) -> bytes | None:
        with AuditFile(self._folder) as file:
            return file.blob(id_)


class LoopOverMailbox:
    def __init__(self, mailbox: Mailbox) -> None:
        self._mailbox = mailbox

    async def tell(self, command: Command) -> Reply:
        answer = await self._mailbox.request(LOOP_COMMAND, command_bytes(command), LOOP_TIME_S)
        try:
            return Reply.model_validate_json(answer)
        except ValidationError as error:
            raise RemoteError("the loop answered what is no reply: it is of another version") from error


class Gate:
    """`begin` after the audit has started; `look` a few times a second; `close` at the end."""

    def __init__(
        self,
        line: Line,
        mailbox: Mailbox,
        folder: Path,
        audit: Audit,
        judge: JudgeSide,
        recent: Recent,
        surroundings: Callable[..., LineSurroundings],
        clock: Callable[[], float],
        wall_clock: Callable[[], float],
        note: Callable[..., None],
    ) -> None:
        """Raises CannotBegin, and the stores' errors."""
        self._line = line
        self._wall_clock = wall_clock
        self._note = note
        self._configurations = begin_configurations(folder / configurations_store.FILE_NAME)
        self._models = begin_repository(folder / models_store.FILE_NAME)
        self._told = ""
        kept = KeptAudit(folder, audit)
        around = surroundings(configurations=self._configurations, models=self._models)
        self.deployer = Deployer(
            line, book_in(folder), kept, LoopOverMailbox(mailbox), judge, around, self._take_up, clock, wall_clock
        )
        mailbox.serve(GATEWAY_PROPOSE, self._answer_propose)
        mailbox.serve(GATEWAY_PROPOSALS, self._answer_query)
        mailbox.serve(GATEWAY_DECISION, self._answer_decision)

    def know(self, controller: Controller, why: str) -> None:
        """A configuration that the loop may have been started with."""
        origin = Origin(self._wall_clock(), GATEWAY.name, why)
        self._configurations.store(self._line.site, self._line.line, controller, origin)

    async def look(self) -> None:
        await self.deployer.watch()
        if self.deployer.trouble != self._told:
            self._told = self.deployer.trouble
            if self._told:
                self._note("gate", f"the gate waits: {self._told}")

    async def close(self) -> None:
        await self.deployer.close()
        self._configurations.close()
        self._models.close()

    def _take_up(self, proposal: Proposal, verdict: str | None) -> None:
        """What is about to be put into service goes into the stores."""
        change, now_s = proposal.change, self._wall_clock()
        if isinstance(change, GainsChange):
            origin = Origin(now_s, proposal.author, proposal.reason[:400], proposal.base, proposal.model, verdict)
            self._configurations.store(self._line.site, self._line.line, change.controller, origin)
        elif isinstance(change, ModelChange):
            entry = self._models.store(change.model, now_s)
            for other in self._models.entries(self._line.site, self._line.line):
                if other.state == "accepted" and other.id != entry.id:
                    self._models.mark(other.id, "superseded", now_s, f"by version {entry.version}")
            self._models.mark(entry.id, "accepted", now_s, proposal.reason[:400])

    async def _answer_propose(self, payload: bytes) -> bytes:
        who = _who(PEER.get())
        reply = await self.deployer.propose(payload, who)
        self._note("proposal", f"{who.name}: {reply.text}", ok=reply.ok, reasons=reply.reasons)
        return reply.model_dump_json().encode()

    async def _answer_query(self, payload: bytes) -> bytes:
        try:
            query = QUERY.validate_json(payload)
        except ValidationError as error:
            return _not_understood(error)
        if isinstance(query, ListProposals):
            return self.deployer.listed(query.most).model_dump_json().encode()
        found = self.deployer.shown(query.proposal)
        if isinstance(found, str):
            return Reply(ok=False, state="", text=found, reasons=[found]).model_dump_json().encode()
        return found.model_dump_json().encode()

    async def _answer_decision(self, payload: bytes) -> bytes:
        try:
            decision = DECISION.validate_json(payload)
        except ValidationError as error:
            return _not_understood(error)
        who = _who(PEER.get())
        if isinstance(decision, Decide):
            reply = await self.deployer.decide(decision, who)
        else:
            reply = await self.deployer.roll_back(decision.comment, who)
        self._note("decision", f"{who.name}: {reply.text}", ok=reply.ok, reasons=reply.reasons)
        return reply.model_dump_json().encode()


def book_in(folder: Path) -> Book:
    """What the audit of a folder says. Raises CannotBegin."""
    try:
        with AuditFile(folder) as file:
            records = [row.record() for row in file.rows()]
        return book_of((record.kind, record.what) for record in records)
    except AuditUnavailable as error:
        raise CannotBegin(str(error)) from error
    except (Impossible, ValueError, KeyError) as error:
        raise CannotBegin(f"the records of the audit do not fit together: {error}; `r2rgate audit verify`") from error


def _who(peer: Peer | None) -> Who:
    if peer is None:
        return GATEWAY
    try:
        name = pwd.getpwuid(peer.uid).pw_name
    except KeyError:
        name = f"user {peer.uid}"
    return Who(name=name, uid=peer.uid, pid=peer.pid)


def _not_understood(error: ValidationError) -> bytes:
    reasons = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
    return Reply(ok=False, state="", text="not understood", reasons=reasons[:20]).model_dump_json().encode()
