"""A loop, an audit and a judge for tests of the deployer: they keep their promises, fail when told to, and no more."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field

from gateway.control.design import design_lqi, task_of
from gateway.core.controller import config_hash
from gateway.core.deployment import Deployment, InService, RecoveryNode, RecoveryPrediction, Region
from gateway.core.finding import finding
from gateway.core.judge_context import JudgeContext, LineState, context_hash
from gateway.core.line_model import LineModel
from gateway.core.messages import (
    Command,
    Confirmed,
    Deploy,
    Keep,
    Narrow,
    Renew,
    Reply,
    Rollback,
    RunExperiment,
    WatchGood,
)
from gateway.core.proof import Grounds
from gateway.core.proposal import GainsChange, ModelChange, Proposal, proposal_hash
from gateway.core.verdict import RuleFinding, Verdict
from gateway.mailbox.port import NotSent, Unreachable
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.deployer_sides import NotKnown
from gateway.supervisor.lifecycle import entry_of
from gateway.supervisor.proposal_records import iso
from tests.unit.model_support import model as fitted
from tests.unit.supervisor_support import line_of

LINE = line_of(2)
FIRST = design_lqi(task_of(LINE))
LIFETIME_S = 600.0


def controller(number: int):
    """Another configuration than all others with another number."""
    return FIRST.model_copy(update={"antiwindup": 1.0 / (2.0 + number)})


def proposal(number: int, base: str, now_s: float, nonce: int = 0, lifetime_s: float = LIFETIME_S) -> Proposal:
    return Proposal(
        format=1, site=LINE.site, line=LINE.line, change=GainsChange(controller=controller(number)), base=base,
        model=None, reason=f"trial {nonce}", author="rules", created=iso(now_s), expires=iso(now_s + lifetime_s),
    )  # fmt: skip


def model_proposal(number: int, base: str, now_s: float, nonce: int = 0) -> Proposal:
    """That proposals be judged by another model than all others with another number."""
    model = fitted(LINE.n, 1.0 + 0.01 * number, site=LINE.site, line=LINE.line)
    return proposal(number, base, now_s, nonce).model_copy(update={"change": ModelChange(model=model)})


class Killed(BaseException):
    """The process has died here."""


@dataclass
class Death:
    """Comes at the n-th effect from now on, before or after it; never where n is 0."""

    effects: int = 0
    after: bool = False

    def due(self) -> bool:
        if self.effects == 0:
            return False
        self.effects -= 1
        return self.effects == 0


@dataclass
class FakeAudit:
    death: Death
    check: Callable[[str, dict], None]  #: of what is about to be recorded
    records: list[tuple[str, dict]] = field(default_factory=list)
    blobs: dict[str, bytes] = field(default_factory=dict)
    whos: list[str] = field(default_factory=list)  #: of the records
    available: bool = True

    @property
    def kinds(self) -> list[str]:
        return [kind for kind, _ in self.records]

    async def append(self, kind, who, what, blobs=None):
        if not self.available:
            raise AuditUnavailable("the disk is full")
        self.check(kind, what)
        due = self.death.due()
        if due and not self.death.after:
            raise Killed
        self.records.append((kind, dict(what)))
        self.whos.append(who.name)
        self.blobs |= {hashlib.sha256(blob).hexdigest(): blob for blob in (blobs or {}).values()}
        if due:
            raise Killed

    async def fetch(self, ids): ...

    async def newest(self, most, skip):
        return list(reversed(await self.recall("")))[skip : skip + most]

    async def recall(self, beginning):
        names = dict.fromkeys(what["proposal"] for kind, what in self.records if kind == "proposed")
        return [
            entry_of((kind, what) for kind, what in self.records if what.get("proposal") == name)
            for name in names if name.startswith(beginning)
        ]  # fmt: skip

    def blob(self, id_):
        return self.blobs.get(id_)


class FakeLoop:
    """What the loop promises: a successor is taken on probation, and left again when nobody renews it."""

    def __init__(self, death: Death) -> None:
        self.death = death
        self.now_s = 0.0
        self.runs = self.good = config_hash(FIRST)
        self.region = self.good_region = Region()
        self.epoch = 0
        self.predictive: set[str] = set()  #: hashes
        self.lease_end_s: float | None = None
        self.why = "start"
        self.reachable = True
        self.answers = True
        self.loses = False  #: what it is told does not come through
        self.late_s = 0.0  #: it does what it is told so much later, and does not answer
        self.waiting: list[tuple[float, Command]] = []
        self.spoiled: set[str] | None = None  #: the commands that `answers`, `loses` and `late_s` are for; None: all
        self.takes = True
        self.refuses_by = [finding("configuration-misfit", because="a test")]  #: what it does not take
        self.fast = False
        self.narrows = True
        self.watches: list[tuple[str, RecoveryPrediction | None]] = []  #: by command
        self.watched = self.good_watched = False
        self.tension_moved = self.speed_changed = False  #: what the configuration has shown
        self.confirmed: set[str] | None = None  #: hashes, of a loop that guards what nobody has confirmed
        self.watch_refusal = ""  #: why it does not take a watch of what is good

    async def tell(self, command: Command, grounds: Grounds | None = None) -> Reply:
        due = self.death.due()
        if due and not self.death.after:
            raise Killed
        if not self.reachable:
            raise NotSent("loop not running")
        spoiled = self.spoiled is None or command.command in self.spoiled
        no_answer = Unreachable("no answer; what was asked may have been done all the same")
        if spoiled and self.loses:
            raise no_answer
        if spoiled and self.late_s:
            self.waiting.append((self.now_s + self.late_s, command))
            raise no_answer
        reply = self._done(command)
        if due:
            raise Killed
        if spoiled and not self.answers:
            raise no_answer
        return reply

    def pass_time(self, seconds: float) -> None:
        self.now_s += seconds
        due = [command for at_s, command in self.waiting if at_s <= self.now_s]
        self.waiting = [one for one in self.waiting if one[0] > self.now_s]
        for command in due:
            self._done(command)
        if self.lease_end_s is not None and self.now_s >= self.lease_end_s:
            self.go_back("rolled back: the lease is over")

    def restart(self) -> None:
        self.go_back("start")

    def in_service(self) -> InService:
        probation = self.lease_end_s is not None
        return InService(
            hash=self.runs, kind="lqi", epoch=self.epoch, on_probation=probation,
            lease_left_s=self.lease_end_s - self.now_s if probation else None, last_known_good=self.good,
            good_if_kept=self.good if self.runs in self.predictive else self.runs,
            region=self.region, watched=self.watched, why=self.why,
            confirmed=self.confirmed is None or self.runs in self.confirmed,
            tension_moved=self.tension_moved, speed_changed=self.speed_changed,
        )  # fmt: skip

    def go_back(self, why: str) -> None:
        self.runs, self.region, self.lease_end_s, self.why = self.good, self.good_region, None, why
        self.watched = self.good_watched

    def _told_of(self, command: Narrow | Confirmed) -> tuple[bool, str]:
        if isinstance(command, Narrow):
            return self._narrowed(command)
        assert self.confirmed is not None
        self.confirmed.add(command.configuration)
        return True, "confirmed"

    def _narrowed(self, command: Narrow) -> tuple[bool, str]:
        if self.lease_end_s is not None or (self.fast and not command.confine):
            return False, "the line shall run at 1 m/s"
        if not self.narrows:
            return False, "the loop is ending"
        self.region, self.good_region = (one.no_further(command.region) for one in (self.region, self.good_region))
        self.watched = self.good_watched = False
        return True, "narrowed"

    def _deployed(self, deployment: Deployment) -> tuple[bool, str]:
        self.watches.append(("deploy", deployment.watch))
        if not self.takes or deployment.epoch != self.epoch + 1 or self.lease_end_s is not None:
            return False, "not its successor, or not now"
        self.runs, self.epoch, self.why = deployment.hash, deployment.epoch, "deployed"
        self.region, self.watched = deployment.region, deployment.watch is not None
        self.lease_end_s = self.now_s + deployment.lease_s
        self.lease_s = deployment.lease_s
        return True, "deployed"

    def _done(self, command: Command) -> Reply:
        ok, text = True, "done"
        if isinstance(command, Narrow | Confirmed):
            ok, text = self._told_of(command)
        if isinstance(command, WatchGood | Keep):
            self.watches.append((command.command, command.watch))
        if isinstance(command, Deploy):
            ok, text = self._deployed(command.deployment)
        elif isinstance(command, Renew | Keep) and (command.epoch != self.epoch or self.lease_end_s is None):
            ok, text = False, "nothing is on probation under this epoch"
        elif isinstance(command, Renew):
            self.lease_end_s = self.now_s + self.lease_s
        elif isinstance(command, Keep):
            self.good = self.in_service().good_if_kept
            self.good_region = self.region
            self.lease_end_s, self.why = None, "kept"
            self.watched = self.good_watched = command.watch is not None
        elif isinstance(command, WatchGood):
            ok, text = not self.watch_refusal, self.watch_refusal
            self.watched = self.good_watched = ok or self.watched
        elif isinstance(command, Rollback):
            self.go_back(f"rolled back: {command.reason}")
        elif isinstance(command, RunExperiment):
            ok, text = False, "no experiment in these tests"
        findings = self.refuses_by if isinstance(command, Deploy) and not ok else []
        return Reply(ok=ok, state="RUN", text=text, in_service=self.in_service(), findings=findings)


@dataclass
class FakeJudge:
    """Accepts those whose reason it was told to accept."""

    refuses: set[str] = field(default_factory=set)
    region: Region = Region(speed_max_m_per_s=0.1)
    line: str = "0" * 64  #: hash of its file

    async def judge(self, payload, context, recordings) -> Verdict:
        hash_ = hashlib.sha256(payload).hexdigest()
        accepted = hash_ not in self.refuses
        finding = RuleFinding(rule="test", passed=accepted, text="as the test wants it")
        return Verdict(
            format=1, proposal=hash_, payload=hash_, context=context_hash(context), line=self.line, kind="gains",
            seed=1, accepted=accepted, findings=[finding], region=self.region if accepted else None,
            judged=context.now, program_version="0",
        )  # fmt: skip


@dataclass
class FakeSurroundings:
    """A line that stands in READY."""

    loop: FakeLoop
    against: str = ""
    hidden: str = ""  #: what it has not shown yet
    unknown: str = ""  #: why no recovery can be predicted
    models: dict[str, LineModel] = field(default_factory=dict)  #: that were proposed, by hash

    async def context(self, book):
        state = LineState(state="READY", tension_n=[30.0] * LINE.n, speed_m_per_s=0.0)
        model = None if book.model is None else self.models[book.model]
        return JudgeContext(format=1, now=iso(self.loop.now_s), state=state, in_service=FIRST, model=model), []

    async def at_hand(self, book) -> None:
        """There is no disk."""

    def difference(self, one, book) -> list[str]:
        return ["a test"]

    async def close(self) -> None:
        """There is nothing to be closed."""

    async def recovery(self, fallback, region, book):
        if self.unknown:
            raise NotKnown(self.unknown)
        return None if book.model is None else prediction(fallback)

    def begin_probation(self) -> None: ...

    def change_taken(self) -> None: ...

    def unseen(self) -> str:
        return self.hidden

    def against_keeping(self, now_s: float) -> str:
        return self.against


def prediction(fallback: str) -> RecoveryPrediction:
    """Of the fake line, as an accepted model would have it; nobody computes with it."""
    n, period_s = LINE.n, LINE.control.period_s
    zeros = [[0.0] * n for _ in range(2 * n)]
    node = RecoveryNode(speed_m_per_s=0.01, transition=[[0.0] * (2 * n) for _ in range(2 * n)], inputs=[zeros, zeros])
    return RecoveryPrediction(
        fallback=fallback, period_s=period_s, horizon_s=0.6, margin_n=6.0, model=FIRST.feedforward,
        coulomb_nm=[0.0] * n, nodes=[node],
    )  # fmt: skip


def hash_of(one: Proposal) -> str:
    return proposal_hash(one)
