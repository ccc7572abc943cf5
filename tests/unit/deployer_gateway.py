"""A deployer and everything around it, in one process that can die and begin anew."""

import asyncio

from gateway.core.audit_record import Who
from gateway.core.controller import config_hash
from gateway.core.decisions import Decide
from gateway.core.line_model import model_hash
from gateway.core.proposal import ModelChange, canonical
from gateway.core.verdict import line_hash
from gateway.supervisor.deployer import Deployer
from gateway.supervisor.lifecycle import Stage, book_of
from tests.unit.deployer_support import (
    FIRST,
    LINE,
    Death,
    FakeAudit,
    FakeJudge,
    FakeLoop,
    FakeSurroundings,
    hash_of,
    proposal,
)

ANNA = Who(name="anna", uid=1000, pid=1)
OPERATORS_UID = 900  #: of the gateway, and of the operator's process
BERT = Who(name="bert", uid=1001, pid=2)
PROBATION_S = LINE.gate.probation_s
#: From controller 1 to 2 is a quarter of a number, from 1 to 3 two fifths.
TRUSTING = LINE.model_copy(
    update={"gate": LINE.gate.model_copy(update={"autonomy": "approve-first", "small_share": 0.3})}
)
#: A change takes two people.
FOUR_EYES = LINE.model_copy(update={"gate": LINE.gate.model_copy(update={"approvals": 2})})


async def nothing_to_store(proposal, verdict) -> None: ...


class Gateway:
    """A deployer and everything around it, in one process that can die and begin anew."""

    def __init__(self, line=LINE) -> None:
        self.line = line
        self.death = Death()
        self.audit = FakeAudit(self.death, self._checked)
        self.loop = FakeLoop(self.death)
        self.judge = FakeJudge()
        self.surroundings = FakeSurroundings(self.loop)
        self.proposals = {}
        self.wall_ahead_s = 0.0
        self.roles: dict[str, str] | None = None  #: of the people who may come in
        self.take_up = nothing_to_store  #: StoreWriter.take_up of real stores, or one that fails
        self.notes: list[tuple[str, dict]] = []
        self.begin()

    def _checked(self, kind, what) -> None:
        if kind == "deploying":
            base = self.proposals[what["proposal"]].base
            assert self.loop.runs == what["before"] == base, "it was made for another configuration"

        if kind in ("approved", "approved-once", "deploying", "model-in-service"):
            told = [one for name, one in self.audit.records if name == "accepted"]
            (by,) = [one["line"] for one in told if one["proposal"] == what["proposal"]]
            assert by == line_hash(self.line), "it was judged by another line's file"

    def begin(self) -> None:
        self.judge.line = line_hash(self.line)
        book, clock = book_of(self.audit.records), self._now_s
        args = (self.audit, self.loop, self.judge, self.surroundings, self._take_up, clock, self._wall_s)
        self.deployer = Deployer(
            self.line, book, *args, own_uid=OPERATORS_UID, roles=lambda: self.roles, note=self._note
        )

    async def _take_up(self, proposal, verdict) -> None:
        await self.take_up(proposal, verdict)

    def _note(self, kind, text, **data) -> None:
        self.notes.append((kind, data))

    def _now_s(self) -> float:
        return self.loop.now_s

    def _wall_s(self) -> float:
        return self.loop.now_s + self.wall_ahead_s

    async def propose(self, one):
        self.proposals[hash_of(one)] = one
        if isinstance(one.change, ModelChange):
            self.surroundings.models[model_hash(one.change.model)] = one.change.model
        reply = await self.deployer.propose(canonical(one), ANNA)
        await self.deployer.judged()
        return reply

    async def decide(self, one, approve=True, shown=None, script="", who=ANNA, revision=None):
        view = self.deployer.shown(hash_of(one))
        hash_ = shown or (view.shown if not isinstance(view, str) else None) or "0" * 64
        decision = Decide(proposal=hash_of(one), shown=hash_, approve=approve, script=script, revision=revision)
        return await self.deployer.decide(decision, who)

    def stage(self, one) -> Stage:
        return self.deployer.book.entries[hash_of(one)].stage

    async def pass_time(self, seconds: float) -> None:
        """With the deployer looking twice a second."""
        for _ in range(round(2 * seconds)):
            self.loop.pass_time(0.5)
            await self.look()

    async def look(self) -> None:
        """One turn of each."""
        await self.deployer.hold()
        await self.deployer.watch()


def run(test):
    """An async test."""

    def synchronous():
        asyncio.run(test())

    synchronous.__name__ = test.__name__
    return synchronous


async def started(line=LINE) -> Gateway:
    gateway = Gateway(line)
    await gateway.deployer.watch()
    return gateway


async def deployed(number=1) -> tuple[Gateway, object]:
    gateway = await started()
    one = proposal(number, config_hash(FIRST), gateway.loop.now_s)
    assert (await gateway.propose(one)).ok
    reply = await gateway.decide(one)
    assert reply.ok, reply
    return gateway, one
