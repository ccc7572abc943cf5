"""Trials of the trials' benchmark: which configuration goes on which line, what is true of it, and what becomes of it.

The wires are those of a line with late answers: all load cells in one, each drive, and the line PLC. Deployer, looks at
the telemetry and loop are the product's; the judge lets everything through, and no model is accepted by which the loop
would foresee anything: what is left to notice a bad configuration is what it shows.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivers.memory import MemoryLink, MemoryPlant
from gateway.cli.stepped import SteppedLoop
from gateway.control.design.task import task_on
from gateway.core.audit_record import Who
from gateway.core.controller import Controller, config_hash
from gateway.core.controller_fit import misfits
from gateway.core.decisions import Decide
from gateway.core.deployment import RecoveryPrediction, Region
from gateway.core.judge_context import JudgeContext, LineState
from gateway.core.line import Line
from gateway.core.messages import Command, Reply
from gateway.core.proof import Grounds
from gateway.core.proposal import GainsChange, Proposal, canonical, proposal_hash
from gateway.core.recording import Recording
from gateway.core.signals import Inputs, Quality
from gateway.core.states import Phase
from gateway.core.telemetry import Frame, unpack
from gateway.core.verdict import line_hash
from gateway.supervisor.deployer import Deployer
from gateway.supervisor.lifecycle import Book, Entry, Stage, book_of
from gateway.supervisor.proposal_records import iso
from gateway.supervisor.recent import STANDING_S, WINDOW_S, Recent
from gateway.supervisor.surroundings import LineSurroundings
from safety.monitor import MonitorState, look, monitor_limits
from safety.probation import Standing, standing
from tests.bench.monitor_runs import DESIGNS, SPEED_M_PER_S, TENSION_N, Case, draw_case
from tests.unit.deployer_support import Death, FakeAudit, FakeJudge

QUIET = ("weak", "no integral", "integral")  #: kinds that a monitor of torques hardly notices: three of four draws
KINDS = ("gain", "integral", "speed gain", "sign", "torque memory", "wrong model")
LOOK_S = 0.25  #: from one look of the gateway to the next
ALONE_S, SETTLED_S = 11.0, 5.0  #: of a run that shows what is true of a configuration, and of it until it counts
BEFORE_S = STANDING_S + 1.0  #: of a trial, on the good configuration
TRIES = 6  #: to spoil one
BAD, GOOD = 1.2, 0.8  #: of what is allowed: truly beyond, or within; what lies between is not drawn
MOST_REFUSED = 8  #: times in a row that a deployment is refused
NEVER = 1_000_000_000  #: periods
ANNA = Who(name="anna", uid=1000, pid=1)


class LateLink(MemoryLink):
    """Answers come too late, each with probability `share`: what was told before stays, as STALE."""

    def __init__(self, line: Line, plant: MemoryPlant, share: float, generator: np.random.Generator) -> None:
        super().__init__(line, plant)
        self.share, self._generator = share, generator
        self.late = self.answers = 0

    async def collect(self, inputs: Inputs, deadline_s: float) -> None:
        channels = (inputs.tension, inputs.speed, inputs.torque, inputs.unwind_speed)
        before = [(one.value.copy(), one.time_s.copy()) for one in channels]
        await super().collect(inputs, deadline_s)
        late = self._generator.uniform(size=2 + inputs.n) < self.share  # load cells, PLC, drives
        self.late, self.answers = self.late + int(late.sum()), self.answers + len(late)
        of_channel = (np.full(inputs.n, late[0]), late[2:], late[2:], late[1:2])
        for channel, (value, time_s), which in zip(channels, before, of_channel, strict=True):
            for i in np.flatnonzero(which & ~np.isnan(time_s)):  # what was never told cannot be what was told before
                channel.value[i], channel.time_s[i] = value[i], time_s[i]
                channel.miss(int(i))
        if late[1]:
            inputs.plc.quality = Quality.STALE


class Around(LineSurroundings):
    """Of a stepped loop: no stores, and no model."""

    def __init__(self, loop: SteppedLoop, recent: Recent, good: Controller) -> None:
        nothing: Any = None
        super().__init__(loop.line, lambda: None, recent, lambda _: [], nothing, nothing, lambda: loop.now_s)
        self._good, self._loop = good, loop

    async def context(self, book: Book) -> tuple[JudgeContext, list[Recording]]:
        state = LineState(state="RUN", tension_n=TENSION_N.tolist(), speed_m_per_s=SPEED_M_PER_S)
        return JudgeContext(format=1, now=iso(self._loop.now_s), state=state, in_service=self._good), []

    def difference(self, proposal: Proposal, book: Book) -> list[str]:
        return ["a trial"]

    async def close(self) -> None:
        """There is nothing to be closed."""

    async def recovery(self, fallback: str, region: Region, book: Book) -> RecoveryPrediction | None:
        return None


async def _take_up_nothing(*_: object) -> None:
    """There are no models in a trial."""


@dataclass
class LoopSide:
    loop: SteppedLoop

    async def tell(self, command: Command, grounds: Grounds | None = None) -> Reply:
        return self.loop.command(command)


@dataclass(frozen=True)
class Trial:
    """What became of one."""

    stage: Stage  #: at its end
    why: str
    decided_s: float  #: from the deployment to the end
    ran_s: float  #: virtual time, all in all
    late: int  #: answers
    answers: int
    stops: int  #: that the envelope would have made for want of samples
    refused: int  #: times that the loop did not take it, because a sample was late just then


@dataclass(frozen=True)
class Truth:
    """What a configuration does on its own line, as the recorder there has it: the worst figure to what is allowed."""

    share: float  #: of most whiles; infinite where the line did not stay up
    most: float  #: of any
    figure: str
    noticed: bool  #: the loop would notice it by its torques alone, in whichever period


def draw_good(line: Line, seed: int) -> tuple[Case, str, Controller, Truth]:
    """A line, and a design for it, with what is true of it. Raises DesignRefused."""
    case = draw_case(line, seed, seed % 3 == 0)
    law = ("lqi", "lqg", "pid", "lqr")[int(np.random.default_rng([seed, 3]).integers(4))]
    config = DESIGNS[law](task_on(line, case.theta))
    return case, law, config, truth_of(case, config)


def draw_bad(line: Line, seed: int) -> tuple[Case, str, Controller, Truth]:
    """A line, and a configuration that is spoilt until it is bad on it, if it can be without that the line stops.

    How badly is drawn; then halves of what is left are tried. What is true of it decides, and nothing else. Raises
    DesignRefused.
    """
    case = draw_case(line, seed, seed % 3 == 0)
    generator = np.random.default_rng([seed, 3])
    law = ("lqi", "lqg", "pid", "lqr")[int(generator.integers(4))]
    kinds = QUIET if generator.uniform() < 0.75 else KINDS
    kind, severity = kinds[int(generator.integers(len(kinds)))], float(generator.uniform())
    least, most, tries = 0.0, 1.0, 1
    while True:
        config = _spoilt(case, law, kind, severity, np.random.default_rng([seed, 5]))
        truth = truth_of(case, config)
        if tries == TRIES or (truth.share >= BAD and truth.share != np.inf):
            return case, kind, config, truth
        least, most = (least, severity) if truth.share == np.inf else (severity, most)
        severity, tries = 0.5 * (least + most), tries + 1


def _spoilt(case: Case, law: str, kind: str, severity: float, generator: np.random.Generator) -> Controller:
    """Of a kind; `severity` from 0 to 1."""

    def times(low: float, high: float) -> float:
        return float(low * (high / low) ** severity)

    config = DESIGNS[law](task_on(case.line, case.theta))
    n = config.n
    gains = {name: np.array(getattr(config, name)) for name in type(config).model_fields if name.startswith("gain_")}
    if kind == "wrong model":
        web = case.theta.web
        wrong = replace(web, inertia_kg_m2=web.inertia_kg_m2 * times(0.2, 5.0), length_m=web.length_m * times(0.2, 5.0))
        return DESIGNS[law](task_on(case.line, replace(case.theta, web=wrong)))
    if kind == "gain":
        factor = times(1.3, 20.0)
        gains = {name: factor * gain for name, gain in gains.items()}
    elif kind == "integral" and "gain_integral" in gains:
        gains["gain_integral"] = times(2.0, 60.0) * gains["gain_integral"]
    elif kind == "torque memory" and "gain_input" in gains:
        gains["gain_input"][:, :n] += times(0.4, 1.2) * np.eye(n)
    elif kind == "sign":
        row = int(generator.integers(n))
        gains = {name: np.where(np.arange(n)[:, np.newaxis] == row, -gain, gain) for name, gain in gains.items()}
    elif kind in ("weak", "no integral"):  # and the feed-forward knows little of friction
        integral = 0.0 if kind == "no integral" else 1.0
        softer = times(0.7, 0.005)
        gains = {name: (integral if name == "gain_integral" else 1.0) * softer * gain for name, gain in gains.items()}
        feedforward = config.feedforward
        factor = times(2.0, 15.0) if generator.uniform() < 0.5 else times(0.5, 0.02)
        friction = (np.array(feedforward.friction_nms_per_rad) * factor).tolist()
        config = config.model_copy(
            update={"feedforward": feedforward.model_copy(update={"friction_nms_per_rad": friction})}
        )
    else:
        main = next(name for name in ("gain_state", "gain_proportional") if name in gains)
        gains[main][:, n:] *= times(1.5, 10.0)
    return config.model_copy(update={name: gain.tolist() for name, gain in gains.items()})


def truth_of(case: Case, config: Controller, late: float = 0.0) -> Truth:
    """Alone on the line, where a share of answers is late; nobody looks after it."""
    line, period_s = case.line, case.line.control.period_s
    loop = SteppedLoop(line, config, case.plant, case.seed)
    if late:
        loop.cycle.links[0] = LateLink(line, loop.truth, late, np.random.default_rng([case.seed, 6]))
        loop.cycle.limits = replace(loop.cycle.limits, hold_periods=NEVER)
    loop.begin_in_production(TENSION_N, SPEED_M_PER_S)
    while loop.periods * period_s < ALONE_S:
        loop.step(round(1.0 / period_s))
        if loop.transitions:
            return Truth(np.inf, np.inf, "the line stops", noticed=True)
    frames = [unpack(one) for one in loop.frames]
    recording = loop.truth.recorder.recording()
    at = np.searchsorted(recording.time_s, [frame.time_s - 1e-6 for frame in frames])
    tension_n = recording.tension_n[np.minimum(at, len(recording.tension_n) - 1)]
    torque_nm = np.array([frame.torque_nm for frame in frames])
    shares: list[tuple[float, str]] = []
    window = round(WINDOW_S / period_s)
    for begin in range(round(SETTLED_S / period_s), len(frames) - window + 1, window // 2):
        rows = slice(begin, begin + window)
        setpoint_n = np.broadcast_to(TENSION_N, tension_n[rows].shape)
        shares.append(_share(standing(tension_n[rows], setpoint_n, torque_nm[rows]), line))
    shares.sort()
    return Truth(shares[len(shares) // 2][0], shares[-1][0], shares[-1][1], _noticed(line, frames))


def _noticed(line: Line, frames: list[Frame]) -> bool:
    limits, state = monitor_limits(line), MonitorState()
    return any([look(limits, state, frame.torque_nm, frame.saturated) for frame in frames])


def _share(found: Standing, line: Line) -> tuple[float, str]:
    """The worst figure to what is allowed, and which."""
    gate = line.gate
    return max(
        (float(found.offset_n.max()) / gate.tail_error_max_n, "off"),
        (float(found.swing_n.max()) / gate.tail_oscillation_max_n, "swings"),
        (float(found.chatter_nm.max()) / gate.chatter_max_nm, "chatters"),
    )


class TrialRun:
    """A gateway and a loop on one clock that only this moves."""

    def __init__(self, case: Case, config: Controller, share: float, envelope: bool) -> None:
        self._case, self._config, self._line = case, config, case.line
        self._loop = SteppedLoop(case.line, case.good, case.plant, case.seed)
        self._link = LateLink(case.line, self._loop.truth, share, np.random.default_rng([case.seed, 4]))
        self._loop.cycle.links[0] = self._link
        self._hold = self._loop.cycle.limits.hold_periods
        if not envelope:
            self._loop.cycle.limits = replace(self._loop.cycle.limits, hold_periods=NEVER)
        self._loop.begin_in_production(TENSION_N, SPEED_M_PER_S)
        self._recent = Recent(case.line.n, case.line.control.period_s)
        self._seen = 0
        self._audit, self._judge = FakeAudit(Death(), lambda kind, what: None), FakeJudge()
        self._judge.region, self._judge.line = Region(), line_hash(case.line)
        around = Around(self._loop, self._recent, case.good)
        self._deployer = Deployer(
            case.line, book_of([]), self._audit, LoopSide(self._loop), self._judge, around, _take_up_nothing,
            self._clock, self._clock, own_uid=0,
        )  # fmt: skip

    def _clock(self) -> float:
        return self._loop.now_s

    async def run(self, lasting_s: float) -> Trial:
        """Until it is decided, or after `lasting_s`."""
        assert not misfits(self._config, self._line)
        await self._deployer.watch()
        await self._pass_time(BEFORE_S)
        refused, entry = 0, await self._propose(0)
        while entry.stage is Stage.NOT_DEPLOYED and refused < MOST_REFUSED and self._runs():
            await self._pass_time(LOOK_S)
            refused += 1
            entry = await self._propose(refused)
        began_s = self._loop.now_s
        while self._loop.now_s < lasting_s and entry.stage is Stage.PROBATION and self._runs():
            await self._pass_time(LOOK_S)
            entry = self._deployer.book.entries[entry.proposal]
        await self._deployer.watch()
        entry = self._deployer.book.entries[entry.proposal]
        return Trial(
            entry.stage, entry.why, self._loop.now_s - began_s, self._loop.now_s, self._link.late, self._link.answers,
            stops(self._loop.recorded(), self._hold), refused,
        )  # fmt: skip

    def _runs(self) -> bool:
        return self._loop.cycle.machine.phase is Phase.RUNNING

    async def _propose(self, nonce: int) -> Entry:
        """Judged, approved and deployed, or not."""
        now_s = self._loop.now_s
        proposal = Proposal(
            format=1, site=self._line.site, line=self._line.line, change=GainsChange(controller=self._config),
            base=config_hash(self._case.good), model=None, reason=f"trial {nonce}", author="engineer",
            created=iso(now_s), expires=iso(now_s + 3600.0),
        )  # fmt: skip
        hash_ = proposal_hash(proposal)
        reply = await self._deployer.propose(canonical(proposal), ANNA)
        assert reply.ok, reply
        await self._deployer.judged()
        shown = self._deployer.shown(hash_)
        assert not isinstance(shown, str) and shown.shown is not None, shown
        await self._deployer.decide(Decide(proposal=hash_, shown=shown.shown, approve=True), ANNA)
        return self._deployer.book.entries[hash_]

    async def _pass_time(self, seconds: float) -> None:
        for _ in range(round(seconds / LOOK_S)):
            self._loop.step(round(LOOK_S / self._line.control.period_s))
            for frame in self._loop.frames[self._seen :]:
                self._recent.take(frame)
            self._seen = len(self._loop.frames)
            await self._deployer.hold()
            await self._deployer.watch()


def stops(frames: list[Frame], hold_periods: int) -> int:
    """How often so many periods in a row were without a sample: each would have stopped the line."""
    return sum(frame.held == hold_periods for frame in frames)
