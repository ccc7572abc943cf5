"""Gateway processes killed at random instants of proposals' lives, in front of a loop that runs on.

The loop is the product's on a simulated line, in this process and in fast time, behind its real socket; the files are
real. After each kill, and again when the next gateway has found out what runs, what the loop does is held against the
records of the audit as they lie on the disk, by rules of this file's own.
"""

import asyncio
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.controller import canonical, config_hash
from gateway.core.decisions import Decide, ListProposals, ProposalList, ProposalShown, RollBackNow, ShowProposal
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.messages import Event, Reply
from gateway.core.proposal import GainsChange, Proposal, proposal_hash
from gateway.core.proposal import canonical as canonical_proposal
from gateway.core.telemetry import Frame, pack
from gateway.core.topics import (
    GATEWAY_DECISION,
    GATEWAY_PROPOSALS,
    GATEWAY_PROPOSE,
    LOOP_COMMAND,
    LOOP_EVENT,
    LOOP_HELLO,
    LOOP_SHOWN,
    LOOP_TELEMETRY,
)
from gateway.loop.door import Door
from gateway.loop.identity import Identity
from gateway.loop.kept import Kept, Store
from gateway.loop.pacer import Tick
from gateway.loop.runner import Runner
from gateway.loop.voice import Voice
from gateway.mailbox.keys import public_key
from gateway.mailbox.loop_proof import make_key
from gateway.mailbox.paths import GATEWAY_DATA, GATEWAY_SOCKET, LOOP_DATA, LOOP_SOCKET
from gateway.mailbox.port import Unreachable
from gateway.mailbox.seal import LineName
from gateway.mailbox.unix import UnixMailbox
from gateway.supervisor.audit_file import AuditFile
from gateway.supervisor.audit_verify import verify
from gateway.supervisor.audit_writer import NOT_DONE
from sim_plant.plant import load_plant
from tests.closed_loop.gate_victim import BAD, TOLD, TOLD_FILE, FastTime

SCALE = 6.0  #: how much faster than the machine's their time runs
SAME_FOLDER = 25  #: kills until everything is begun anew
PERIODS_AT_ONCE = 20
TRIED_S = 20.0  #: for a gateway to come up, on a busy machine
GAP_S = 0.004  #: between two looks, of the machine's time
CONFIGURATIONS = 6


@dataclass
class Tally:
    kills: int = 0
    told: int = 0  #: records that a gateway was told are stored
    lost: int = 0  #: of these: not there afterwards, or another one in their place
    replies: int = 0  #: that somebody was given: "proposed", "it controls the line", ..
    denied: int = 0  #: of these: nothing in the records says so
    looks: int = 0  #: at what the loop runs, beside the records
    unexplained: int = 0  #: of these: the records do not say how it came to run
    unsound: int = 0  #: chains that do not verify
    shut: int = 0  #: gateways that did not come up, or left something half-way
    stages: dict[str, int] = field(default_factory=dict[str, int])  #: kinds of the last record at each kill
    problems: list[str] = field(default_factory=list[str])

    def problem(self, text: str) -> None:
        if len(self.problems) < 20:
            self.problems.append(text)


class FastLoop(SteppedLoop):
    """A line in production, and its loop behind a socket."""

    def talk(self, mailbox: UnixMailbox, fast: FastTime, data: Path) -> None:
        self._mailbox = mailbox
        self.runner = Runner(self.cycle, Store(data / LOOP_DATA, self.config))
        site, line = self.line.site, self.line.line
        self.door = Door(
            self.runner, LineName(site, line), lambda: public_key(site, line, data / GATEWAY_DATA), fast.clock
        )
        tension_n = np.array(self.line.recipes[0].tension_n)
        self.begin_in_production(tension_n, self.line.recipes[0].speed_m_per_s)
        self._fast = fast
        self._voice = Voice(mailbox, self.cycle.links, self.line.control.period_s)
        mailbox.serve(LOOP_COMMAND, self.door.command)
        mailbox.serve(LOOP_HELLO, self.door.introduce)
        mailbox.serve(LOOP_SHOWN, Identity(make_key(data.with_name("run")), self.cycle).answer)

    async def live(self) -> None:
        """Periods as they come due; a machine that is too slow makes the line's time slower, not its periods."""
        period_s = self.line.control.period_s
        while True:
            for _ in range(PERIODS_AT_ONCE):
                self.now_s = self.periods * period_s
                if self.now_s > self._fast.clock():
                    break
                await self.runner.period(Tick(self.now_s, self.now_s, 0))
                self.periods += 1
            await asyncio.sleep(0.5 * period_s / self._fast.scale)

    def _record(self, frame: Frame) -> None:
        # When the line's time is slower than the gateway's, its frames are new all the same.
        self._mailbox.publish(LOOP_TELEMETRY, pack(replace(frame, time_s=self._fast.clock())))

    def _tell(self, kind: str, text: str, **data: object) -> None:
        event = Event(time_s=self.now_s, kind=kind, text=text, data=data)
        self._mailbox.publish(LOOP_EVENT, event.model_dump_json().encode())


def line_text() -> str:
    gate = "probation_s = 5.5\ncool_down_s = 0.5\nexpiry_max_s = 1e6\n"
    return line_template(1, "line.toml").replace('autonomy = "approve-all" ', f'{gate}autonomy = "approve-all" ')


@dataclass
class Site:
    """A folder with a line, its loop, and gateways one after the other."""

    folder: Path
    line: Line
    fast: FastTime
    loop: FastLoop
    mailbox: UnixMailbox
    forks: subprocess.Popen[str]
    rng: random.Random
    tally: Tally
    told: dict[int, str] = field(default_factory=dict[int, str])
    replies: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])  #: kind of a record, proposal
    made: int = 0

    @property
    def data(self) -> Path:
        return self.folder / "data" / GATEWAY_DATA

    async def fork(self) -> int:
        """A gateway that answers. Raises TimeoutError."""
        assert self.forks.stdin is not None and self.forks.stdout is not None
        self.forks.stdin.write("go\n")
        self.forks.stdin.flush()
        pid = int(await asyncio.to_thread(self.forks.stdout.readline))
        deadline_s = time.monotonic() + TRIED_S
        while time.monotonic() < deadline_s:
            with suppress(Unreachable, ValueError):
                if (await self.listed()).in_service is not None:
                    return pid
            await asyncio.sleep(GAP_S)
        raise TimeoutError(f"no gateway: {(self.folder / 'victims.log').read_text()[-1500:]}")

    async def listed(self) -> ProposalList:
        answer = await self.mailbox.request(GATEWAY_PROPOSALS, ListProposals().model_dump_json().encode(), 2.0)
        return ProposalList.model_validate_json(answer)

    # whoever proposes and decides

    async def people(self) -> None:
        """For ever; what they were told is kept, and what was not answered they take for undone."""
        while True:
            with suppress(Unreachable, ValueError):
                await self._one_life()
            await asyncio.sleep(GAP_S)

    async def _one_life(self) -> None:
        found = await self.listed()
        waiting = [one.proposal for one in found.proposals if one.stage == "waiting"]
        busy = any(one.stage in ("received", "probation", "keeping", "deploying") for one in found.proposals)
        if waiting and (not busy or self.rng.random() < 0.1):
            await self._decide(self.rng.choice(waiting))
        elif self.rng.random() < 0.02:
            await self._reply("rollback-asked", "", GATEWAY_DECISION, RollBackNow().model_dump_json().encode())
        elif found.in_service is not None and (not busy or self.rng.random() < 0.05) and len(waiting) < 3:
            proposal = self._proposal(found.in_service)
            hash_ = proposal_hash(proposal)
            await self._reply("proposed", hash_, GATEWAY_PROPOSE, canonical_proposal(proposal))

    async def _decide(self, proposal: str) -> None:
        query = ShowProposal(proposal=proposal).model_dump_json().encode()
        shown = ProposalShown.model_validate_json(await self.mailbox.request(GATEWAY_PROPOSALS, query, 2.0))
        if shown.shown is None:
            return
        approve = self.rng.random() < 0.9
        decision = Decide(proposal=proposal, shown=shown.shown, approve=approve)
        kind = "deploying" if approve else "rejected"
        await self._reply(kind, proposal, GATEWAY_DECISION, decision.model_dump_json().encode())

    async def _reply(self, kind: str, proposal: str, topic: Any, payload: bytes) -> None:
        reply = Reply.model_validate_json(await self.mailbox.request(topic, payload, 5.0))
        if reply.ok:
            self.replies.append((kind, proposal))

    def _proposal(self, base: str) -> Proposal:
        self.made += 1
        variant = self.loop.config.model_copy(update={"antiwindup": 1.0 / (2.0 + self.rng.randrange(CONFIGURATIONS))})
        now_s = self.fast.wall_clock()
        return Proposal(
            format=1, site=self.line.site, line=self.line.line, change=GainsChange(controller=variant), base=base,
            model=None, reason=f"{BAD if self.rng.random() < 0.1 else 'good'} {self.made}", author="rules",
            created=_iso(now_s), expires=_iso(now_s + self.rng.choice((5.0, 3600.0))),
        )  # fmt: skip

    # kills and their judgement

    async def kill(self, pid: int) -> None:
        """At a random instant: some time after it has begun, or just after it was told of a record."""
        way = self.rng.random()
        if way < 0.4:
            await asyncio.sleep(self.rng.uniform(0.0, 9.0) / self.fast.scale)
        elif way < 0.8:
            wanted = len(self._told_now()) + self.rng.randint(1, 7)
            await self._until(lambda: len(self._told_now()) >= wanted)
        else:
            kept = self._kept()
            await self._until(lambda: self._kept() > kept)
        if way >= 0.4:
            await asyncio.sleep(self.rng.uniform(0.0, 0.012))
        os.kill(pid, signal.SIGKILL)
        await self._until(lambda: not _alive(pid))  # whoever forked it has seen it end

    async def _until(self, enough: Callable[[], bool]) -> None:
        """Or until it takes too long."""
        deadline_s = time.monotonic() + 20.0 / self.fast.scale
        while not enough() and time.monotonic() < deadline_s:  # noqa: ASYNC110 - another process is looked at
            await asyncio.sleep(0.5 * GAP_S)

    def _kept(self) -> int:
        """How many configurations were about to be kept, by the records."""
        return sum(kind == "keeping" for kind, _ in self.records())

    def _told_now(self) -> list[tuple[int, str]]:
        content = (self.data / TOLD_FILE).read_bytes() if (self.data / TOLD_FILE).exists() else b""
        whole = len(content) // TOLD.size * TOLD.size
        return [(sequence, head.decode()) for sequence, head in TOLD.iter_unpack(content[:whole])]

    def judge_files(self) -> None:
        """After a kill: what was told is there, and the chain is sound."""
        tally = self.tally
        told = self._told_now()
        tally.told += len(told) - len(self.told)
        self.told = dict(told)
        found = verify(self.data)
        if not found.sound:
            tally.unsound += 1
            tally.problem("; ".join(found.problems))
        with AuditFile(self.data) as file:
            rows = list(file.rows())
        heads = {row.sequence: row.head for row in rows}
        lost = [n for n, head in self.told.items() if heads.get(n) != head]
        tally.lost += len(lost)
        kinds = [row.record().kind for row in rows]
        tally.stages[kinds[-1]] = tally.stages.get(kinds[-1], 0) + 1
        records = self.records()
        said = {(kind, str(what.get("proposal", ""))) for kind, what in records}
        for reply in self.replies:
            tally.replies += 1
            if reply not in said:
                tally.denied += 1
                tally.problem(f"{reply} was answered, and is not in the records")
        self.replies.clear()

    def records(self) -> list[tuple[str, dict[str, Any]]]:
        """Kinds and contents of those that were done."""
        with AuditFile(self.data) as file:
            records = [row.record() for row in file.rows()]
        undone = {n for one in records if one.kind == NOT_DONE for n in one.what["sequences"]}
        return [(one.kind, dict(one.what)) for one in records if one.sequence not in undone]

    def judge_loop(self) -> None:
        """Whether the records say how the loop came to run what it runs, and to hold for good what it does."""
        configurations, records = self.loop.cycle.configurations, self.records()
        first = config_hash(self.loop.config)
        approved: set[str] = set()
        deployed: dict[int, str] = {}
        kept = {first}
        for kind, what in records:
            if kind == "approved":
                approved.add(str(what["proposal"]))
            elif kind == "deploying" and what["proposal"] in approved:
                deployed[int(what["epoch"])] = str(what["configuration"])
            elif kind == "keeping":
                kept.add(deployed[int(what["epoch"])])
        runs, good, epoch = configurations.running.hash, configurations.good.hash, configurations.epoch
        self._explained(good in kept, f"{good[:8]} is the last known good, and was not kept on record")
        self._explained(runs in (good, deployed.get(epoch)), f"{runs[:8]} runs as epoch {epoch}, not on record")
        if (path := self.data.with_name(LOOP_DATA) / "configuration.json").exists():
            on_disk = config_hash(Kept.model_validate_json(path.read_bytes()).controller)
            self._explained(on_disk in kept, f"{on_disk[:8]} is kept by the loop's file, not on record")

    def _explained(self, is_so: bool, problem: str) -> None:
        self.tally.looks += 1
        if not is_so:
            self.tally.unexplained += 1
            self.tally.problem(problem)

    async def judge_next(self) -> None:
        """The next gateway comes to what the loop says, and leaves nothing lying."""
        found, running = await self.listed(), self.loop.cycle.configurations.running.hash
        deadline_s = time.monotonic() + TRIED_S
        while found.in_service != running or any(one.stage in ("approved", "deploying") for one in found.proposals):
            if time.monotonic() > deadline_s:
                self.tally.shut += 1
                self.tally.problem(f"{running[:8]} runs; the gateway says {found}"[:600])
                return
            await asyncio.sleep(GAP_S)
            found, running = await self.listed(), self.loop.cycle.configurations.running.hash


@asynccontextmanager
async def site(tally: Tally, rng: random.Random) -> AsyncIterator[Site]:
    """Everything that was begun is ended."""
    folder = Path(tempfile.mkdtemp(prefix="r2r-kill-"))
    for name in ("run", f"data/{LOOP_DATA}", f"data/{GATEWAY_DATA}"):
        (folder / name).mkdir(parents=True)
    (folder / "line.toml").write_text(line_text())
    line = load_line(line_text(), "line.toml")
    config = design_lqi(task_of(line))
    (folder / "data" / LOOP_DATA / "controller.json").write_bytes(canonical(config))
    plant = load_plant("sim_plant/plants/s_real.toml").model_copy(update={"spans": 1})
    fast = FastTime(SCALE, time.monotonic())
    arguments = [sys.executable, "-m", "tests.closed_loop.gate_victim", folder, str(SCALE), str(fast.began_s)]
    forks = _started(arguments)
    loop = FastLoop(line, config, plant, rng.randrange(1 << 30))
    wire, mailbox = UnixMailbox(fast.clock), UnixMailbox()
    loop.talk(wire, fast, folder / "data")
    await wire.listen(folder / "run" / LOOP_SOCKET)
    wire.connect({LOOP_TELEMETRY, LOOP_EVENT}, folder / "run" / GATEWAY_SOCKET)
    mailbox.connect({GATEWAY_PROPOSE, GATEWAY_PROPOSALS, GATEWAY_DECISION}, folder / "run" / GATEWAY_SOCKET)
    found = Site(folder, line, fast, loop, mailbox, forks, rng, tally)
    tasks = [asyncio.create_task(loop.live()), asyncio.create_task(found.people())]
    try:
        yield found
    finally:
        for task in tasks:
            task.cancel()
        for ended in await asyncio.gather(*tasks, return_exceptions=True):
            if isinstance(ended, Exception):
                tally.problem(f"{type(ended).__name__}: {ended}")
                tally.shut += 1
        loop.runner.close()
        loop.door.close()
        await mailbox.close()
        await wire.close()
        assert forks.stdin is not None and forks.stdout is not None
        forks.stdin.close()
        forks.stdout.close()
        forks.wait(10.0)
        shutil.rmtree(folder)


async def _campaign(kills: int, seed: int, minutes: float) -> Tally:
    rng, tally, end_s = random.Random(seed), Tally(), time.monotonic() + 60.0 * minutes
    while tally.kills < kills and time.monotonic() < end_s:
        async with site(tally, rng) as one:
            for _ in range(min(SAME_FOLDER, kills - tally.kills)):
                pid = await one.fork()
                await one.judge_next()
                await one.kill(pid)
                tally.kills += 1
                one.judge_files()
                one.judge_loop()
                if rng.random() < 0.2:  # long enough for a lease to end
                    await asyncio.sleep(6.0 / SCALE)
                    one.judge_loop()
    return tally


def _started(arguments: list[Any]) -> subprocess.Popen[str]:
    return subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def campaign(kills: int, seed: int, minutes: float = inf) -> Tally:
    """As many as come within `minutes`, about. Raises TimeoutError where no gateway comes up."""
    return asyncio.run(_campaign(kills, seed, minutes))


def _alive(pid: int) -> bool:
    """Not ended, or not yet seen to be."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def _iso(wall_s: float) -> str:
    return datetime.fromtimestamp(wall_s, UTC).isoformat()
