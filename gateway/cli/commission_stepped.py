"""The commissioning chain on a simulated line in stepped time, through a whole gate: audit, stores, judge, deployer.

Everything is what a gateway has, but for the clock, which only this moves, and the judge, which is in this process.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from gateway.cli.commission_changes import LineNow
from gateway.cli.commission_side import CannotGoOn
from gateway.cli.stepped import SteppedLoop
from gateway.core.audit_record import Who
from gateway.core.controller import canonical as canonical_controller
from gateway.core.decisions import Archive, Decide, LineChanged, ProposalShown
from gateway.core.finding import Finding
from gateway.core.judge_context import JudgeContext
from gateway.core.line import Line
from gateway.core.messages import Command, Reply
from gateway.core.proof import Proof
from gateway.core.recording import Recording, recording_of
from gateway.core.states import Phase
from gateway.core.steady_clock import SteadyClock
from gateway.core.telemetry import Frame, frame_dtype, unpack
from gateway.core.topics import GATEWAY_DECISION, LOOP_COMMAND, LOOP_HELLO
from gateway.core.verdict import Verdict
from gateway.loop.door import Door
from gateway.loop.refused import coded, said
from gateway.mailbox.inprocess import Hub, InProcessMailbox
from gateway.mailbox.keys import PublicKey
from gateway.mailbox.seal import LineName, Signer
from gateway.mailbox.to_loop import ToLoop
from gateway.supervisor.configurations import Configurations
from gateway.supervisor.deployer import Deployer
from gateway.supervisor.experiments import ENDS, MOST_EXPERIMENTS
from gateway.supervisor.gate import Gate
from gateway.supervisor.lifecycle import Stage
from gateway.supervisor.models import Models
from gateway.supervisor.recent import Recent
from gateway.supervisor.store import boot_id
from gateway.supervisor.surroundings import LineSurroundings
from safety.draws import seed_of
from safety.judge import failed, judge

BEGIN = datetime(2026, 1, 5, 6, 0, tzinfo=UTC)  #: of the stepped clock
STOPPED_S = 1800.0  #: from one loop to the next on the same line
LOOK_S = 0.5  #: from one look of the gate to the next
ANSWER_S = 5.0  #: within this process
READY_WITHIN_S = 300.0
LEAST_S = 5.0  #: for which the line must have stood anyway before a change, and before one is kept
MOST_DECISIONS = 3  #: on one proposal, where carrying it out is refused for the moment
ENGINEERS, RULES = (Who(name="engineer"), Who(name="second engineer")), Who(name="rules")

Approves = Callable[[ProposalShown], bool]


def impatient(line: Line) -> Line:
    """`line` with as short a probation and cool-down as can be: a simulated line has nothing to show later."""
    shorter = {"probation_s": min(line.gate.probation_s, LEAST_S), "cool_down_s": min(line.gate.cool_down_s, LEAST_S)}
    return line.model_copy(update={"gate": line.gate.model_copy(update=shorter)})


def approve_all(shown: ProposalShown) -> bool:
    """What the verdict has let through."""
    return True


class SteppedJudge:
    """The judge in this process. `seed`: from which those of its verdicts follow."""

    def __init__(self, loop: SteppedLoop, seed: int) -> None:
        self._line = loop.line
        self._secret = str(seed).encode()

    async def judge(self, payload: bytes, context: JudgeContext, recordings: list[Recording]) -> Verdict:
        seed = seed_of(self._secret, payload, context, self._line)
        try:
            return judge(payload, context, self._line, recordings, seed)
        except Exception as error:  # whatever it is, it is no yes
            return failed(payload, context, self._line, seed, error)


class SteppedGate:
    """A gate over `loop`, which is in production, with its records in `folder`. `async with`; see GateSide.

    `before`: the gate that was there until now, where the line was stopped and started again (another web, a new part).
    """

    def __init__(
        self, loop: SteppedLoop, folder: Path, seed: int = 0, approves: Approves = approve_all,
        before: "SteppedGate | None" = None,
    ) -> None:  # fmt: skip
        self.loop = loop
        self.approvals = 0
        self.line = loop.line
        self._folder = folder
        self._approves = approves
        self._recent = Recent(self.line.n, self.line.control.period_s)
        self._seen_frames = self._seen_events = 0
        self._begin_s = BEGIN.timestamp() if before is None else before.wall_s + STOPPED_S
        self._experiments: list[tuple[Recording, float]] = [] if before is None else list(before.experiments)
        self._refused: dict[str, int] = {}
        (folder / "controller.json").write_bytes(canonical_controller(loop.config))
        hub = Hub()
        self._mailboxes = InProcessMailbox(hub), InProcessMailbox(hub)
        if before is not None:
            _go_on(loop, before.loop)
        key, of = Ed25519PrivateKey.generate(), LineName(self.line.site, self.line.line)
        self._door = Door(
            _Behind(loop), of, lambda: PublicKey(key.public_key(), folder), lambda: self.wall_s
        )  # fmt: skip
        self._mailboxes[0].serve(LOOP_COMMAND, self._door.command)
        self._mailboxes[0].serve(LOOP_HELLO, self._door.introduce)
        to_loop = ToLoop(self._mailboxes[1], Signer(key, of, lambda: self.wall_s))
        self._gate = Gate(
            self.line, self._mailboxes[1], to_loop, folder, SteppedJudge(loop, seed), self._around, _unnoted,
            lambda: self.wall_s, lambda: self.wall_s,  # of one boot, however often the loop is started anew
            folder,
        )  # fmt: skip

    async def __aenter__(self) -> "SteppedGate":
        await self._gate.look()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._gate.close()
        for mailbox in self._mailboxes:
            await mailbox.close()
        self._door.close()

    @property
    def gate(self) -> Gate:
        return self._gate

    @property
    def deployer(self) -> Deployer:
        """Raises CannotGoOn where the gate is shut."""
        if self._gate.deployer is None:
            raise CannotGoOn(f"the gate is shut: see the audit in {self._folder}")
        return self._gate.deployer

    async def proposals(self) -> list[ProposalShown]:
        found = [await self._shown(entry.proposal) for entry in list(self.deployer.book.since_change)]
        return [one for one in found if isinstance(one, ProposalShown)]

    async def now(self) -> LineNow:
        book, setpoints = self.deployer.book, self.loop.cycle.setpoints
        site, name = self.line.site, self.line.line
        controller = self._configurations.find(book.in_service or "", site, name).controller
        if controller is None:
            raise CannotGoOn("the configuration in service is damaged in the store")
        model = None if book.model is None else self._models.find(book.model, site, name).model
        return LineNow(
            controller, model, setpoints.tension_target_n.tolist(), setpoints.speed_target_m_per_s,
            datetime.fromtimestamp(self.wall_s, UTC),
        )  # fmt: skip

    async def state(self) -> str:
        return self.loop.cycle.machine.state.name

    async def folder(self) -> Path:
        return self._folder

    async def recordings(self) -> list[Recording]:
        changed_s = self.deployer.book.line_changed_s or 0.0
        return [one for one, end_s in self._kept(self.line.gate.data_max_age_s) if end_s > changed_s]

    async def ready(self) -> None:
        began_s = self.loop.now_s
        while True:
            book = self.deployer.book
            changed_s = -np.inf if book.changed_s is None else book.changed_s
            cool = self.wall_s - changed_s >= self.line.gate.cool_down_s
            if cool and book.on_the_line is None and (self._recent.stands() or not self._runs):
                return
            if self.loop.now_s - began_s > READY_WITHIN_S:
                raise CannotGoOn(f"the line does not come to rest within {READY_WITHIN_S:g} s")
            await self.pass_time(LOOK_S)

    async def propose(self, payload: bytes) -> Reply:
        reply = await self.deployer.propose(payload, RULES)
        await self.deployer.judged()
        return reply

    async def line_changed(self, because: str) -> None:
        """The line is no longer as it was. Raises CannotGoOn where the gate does not take that."""
        reply = await self._told(LineChanged(because=because))
        if not reply.ok:
            raise CannotGoOn("; ".join([reply.text, *reply.reasons]))

    async def archive(self, command: Archive) -> Reply:
        return await self._told(command)

    async def _told(self, command: Archive | LineChanged) -> Reply:
        payload = command.model_dump_json().encode()
        return Reply.model_validate_json(await self._mailboxes[0].request(GATEWAY_DECISION, payload, ANSWER_S))

    async def _shown(self, proposal: str) -> ProposalShown | str:
        """A sentence where there is none."""
        await self.deployer.at_hand(proposal, difference=True)
        return self.deployer.shown(proposal)

    async def is_back(self, why: str) -> bool:
        return True  # in this process: never away

    async def wait_for(self, proposal: str) -> None:
        shown = await self._shown(proposal)
        if isinstance(shown, str):
            raise CannotGoOn(shown)
        if shown.stage == Stage.RECEIVED:
            await self.deployer.judged()
        elif shown.stage == Stage.WAITING and shown.shown is not None:
            await self._decide(shown, shown.shown)
        else:
            await self.pass_time(LOOK_S)

    async def pass_time(self, seconds: float) -> None:
        """The line goes on as it is, with the gate looking at it. Raises CannotGoOn where it runs, and stops."""
        ran = self._runs
        period_s = self.line.control.period_s
        for _ in range(max(1, round(seconds / LOOK_S))):
            self.loop.step(round(LOOK_S / period_s))
            for frame in self.loop.frames[self._seen_frames :]:
                self._recent.take(self._by_gates_clock(frame))
            self._seen_frames = len(self.loop.frames)
            await self._hear()
            await self._gate.hold()
            await self._gate.look()
        if ran and not self._runs:
            raise CannotGoOn(f"the line has stopped: {self.loop.cycle.machine.reason}")

    @property
    def _runs(self) -> bool:
        return self.loop.cycle.machine.phase is Phase.RUNNING

    async def _decide(self, shown: ProposalShown, hash_: str) -> None:
        await self.ready()
        tries = self._refused.get(shown.proposal_hash, 0)
        approve = self._approves(shown) and tries < MOST_DECISIONS
        decision = Decide(proposal=shown.proposal_hash, shown=hash_, approve=approve)
        first, second = ENGINEERS
        reply = await self.deployer.decide(decision, first)
        if approve and reply.ok and self.line.gate.approvals > 1:
            reply = await self.deployer.decide(decision, second)
        self.approvals += approve
        if not reply.ok:
            self._refused[shown.proposal_hash] = tries + 1

    async def _hear(self) -> None:
        events = self.loop.events[self._seen_events :]
        self._seen_events += len(events)
        for event in events:
            if event.kind in ENDS:
                begin_s, end_s = event.data["begin_s"], event.data["end_s"]
                if begin_s is not None:
                    self._experiments.append((self._between(begin_s, end_s), self._begin_s + end_s))
                await self.deployer.experiment_ended(str(event.data["hash"]), str(event.data["reason"]))

    def _between(self, begin_s: float, end_s: float) -> Recording:
        period_s = self.line.control.period_s
        first, last = round(begin_s / period_s), round(end_s / period_s)
        frames = np.frombuffer(b"".join(self.loop.frames[first : last + 1]), frame_dtype(self.line.n))
        return recording_of(frames, period_s, f"experiment on {self.loop.plant.name} at {begin_s:.1f} s")

    def _kept(self, most_s: float) -> list[tuple[Recording, float]]:
        least_s = self.wall_s - most_s
        return [one for one in reversed(self._experiments) if one[1] >= least_s][:MOST_EXPERIMENTS]

    def _around(self, configurations: Configurations, models: Models) -> LineSurroundings:
        self._configurations, self._models = configurations, models
        return LineSurroundings(
            self.line,
            self._newest,
            self._recent,
            self._kept,
            configurations,
            models,
            SteadyClock(lambda: self.wall_s, lambda: self.wall_s, boot_id()),
        )

    def _newest(self) -> Frame | None:
        return unpack(self.loop.frames[-1]) if self.loop.frames else None

    @property
    def wall_s(self) -> float:
        """Unix time."""
        return self._begin_s + self.loop.now_s

    def _by_gates_clock(self, frame: bytes) -> bytes:
        """The loop's own begins anew with each loop; on a computer both are one."""
        row = np.frombuffer(frame, frame_dtype(self.line.n)).copy()
        row["time_s"] += self._begin_s
        return row.tobytes()

    @property
    def experiments(self) -> list[tuple[Recording, float]]:
        """All that have been run, the oldest first, each with its end in Unix time."""
        return self._experiments


def _go_on(loop: SteppedLoop, before: SteppedLoop) -> None:
    """As a loop that is started anew goes on with what the one before has kept: its epoch, and as far as it went."""
    then, now = before.cycle.configurations, loop.cycle.configurations
    if now.running.hash == then.good.hash:
        now.running = now.good = replace(now.running, region=then.good.region)
    now.epoch = then.epoch


class _Behind:
    """A loop in stepped time behind its door. It keeps nothing on a disk, and so no proof."""

    def __init__(self, loop: SteppedLoop) -> None:
        self._loop = loop

    async def submit(self, command: Command, proof: Proof | None = None) -> Reply:
        return self._loop.command(command)

    def refused(self, text: str, reasons: Sequence[str | Finding] = ()) -> Reply:
        state = self._loop.cycle.machine.state.name
        return Reply(ok=False, state=state, text=text, reasons=said(reasons), findings=coded(reasons))


def _unnoted(*_: object, **__: object) -> None:
    """The audit has it."""
