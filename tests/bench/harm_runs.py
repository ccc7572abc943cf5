"""What may hurt by itself, one fault and one healthy life at a time, on a drawn line in stepped time.

The recorder at the simulated devices judges, and the truth of the simulated web; never what the loop says of itself.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from math import inf

import numpy as np

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import DesignRefused, design_lqi, task_of
from gateway.core.braking import brakes_of, braking_s
from gateway.core.controller import Controller
from gateway.core.line_rules_braking import AT_REST_S
from gateway.core.messages import Command, Hold, SetSpeed, SetTension, Start, Stop
from gateway.core.states import LoopState, Phase
from safety.tensioning import TensioningState, longest_tensioning_s, surely_stretched_m, tensioning_limits
from sim_plant.faults.parse import parse_fault
from sim_plant.faults.stepped import injector_of
from tests.bench.harm_lines import Drawn, drawn, is_refused

STANDS = 0.01  #: of the top speed: what is slower stands
AT_MOST_S = 40.0  #: that is waited for a line to come to rest
NEVER_S = inf


@dataclass(frozen=True)
class Outcome:
    """What came of one injection, or of one healthy life. Times in s from the injection."""

    row: str
    seed: int
    unsafe: dict[str, int]  #: events at the recorder, but those that the fault itself is
    code: str  #: the first rule that was told; empty: none was
    found_s: float  #: until then; NEVER_S: it was not
    rest_s: float  #: until every roller and the unwinder stand and no torque is given; NEVER_S: they do not
    fastest: float  #: speed of a roller afterwards, over the line's top speed
    note: str = ""


class NotStarted(Exception):
    """A healthy line that did not come to production: the text says why."""


@lru_cache(maxsize=8)
def configuration(seed: int) -> Controller:
    """The design for what the line's file says. Raises DesignRefused."""
    return design_lqi(task_of(drawn(seed).line))


def drawable(seed: int) -> bool:
    """Whether `check` takes the file of this seed's line, whatever it advises, and there is a controller for it."""
    if is_refused(drawn(seed).line):
        return False
    try:
        configuration(seed)
    except DesignRefused:
        return False
    return True


def rest_bound_s(seed: int) -> float:
    """When everything must be at rest after a web break: in 10 s, or when `check` says where it takes longer."""
    brakes = brakes_of(drawn(seed).line)
    return max(AT_REST_S, float(braking_s(brakes).max()))


def begun(seed: int, speed_share: float) -> SteppedLoop:
    """In production at the recipe's tensions, at a share of the top speed."""
    found = drawn(seed)
    loop = SteppedLoop(found.line, configuration(seed), found.plant, seed)
    tension_n = np.array(found.line.recipes[0].tension_n)
    loop.begin_in_production(tension_n, speed_share * found.line.limits.speed_max_m_per_s)
    loop.step(round(2.0 / found.line.control.period_s))
    if loop.cycle.machine.phase is not Phase.RUNNING:
        raise NotStarted(loop.cycle.machine.reason)
    return loop


def threaded(seed: int) -> SteppedLoop:
    """Slack and silent."""
    found = drawn(seed)
    loop = SteppedLoop(found.line, configuration(seed), found.plant, seed)
    loop.step(3)
    return loop


def ordered(loop: SteppedLoop, command: Command, phase: Phase, within_s: float) -> str:
    """Give a command and wait for a phase. Empty, or why it is not reached."""
    reply = loop.command(command)
    if not reply.ok:
        return "; ".join([reply.text, *reply.reasons])
    if loop.step_until(phase, within_s):
        return ""
    return loop.cycle.machine.reason or f"still {loop.cycle.machine.phase.name} after {within_s:g} s"


def armed(loop: SteppedLoop) -> str:
    reply = loop.arm()
    if not reply.ok:
        return "; ".join([reply.text, *reply.reasons])
    return "" if loop.step_until(Phase.READY, 2.0) else loop.cycle.machine.reason


class Watched:
    """A loop from the injection on."""

    def __init__(self, row: str, seed: int, loop: SteppedLoop, faults: list[str]) -> None:
        self.row, self.seed, self.loop = row, seed, loop
        self.top_m_per_s = loop.line.limits.speed_max_m_per_s
        self._alarms, self._stopped_by = len(loop.alarms), len(loop.stopped_by)
        self.begin_s, self.fastest = loop.now_s, 0.0
        self._unsafe = dict(loop.truth.recorder.unsafe_events)
        for fault in faults:
            injector_of(loop.truth).add(parse_fault(fault), loop.truth.world.now_s)

    def step_until(self, done: Callable[[], bool], within_s: float) -> float:
        """The time from the injection when it is so; NEVER_S: not within that time."""
        loop = self.loop
        while loop.now_s - self.begin_s < within_s:
            loop.step()
            speed = float(np.abs(loop.truth.world.speed_m_per_s).max())
            self.fastest = max(self.fastest, speed / self.top_m_per_s)
            if done():
                return loop.now_s - self.begin_s
        return NEVER_S

    def rests(self) -> bool:
        world = self.loop.truth.world
        slow = STANDS * self.top_m_per_s
        stands = np.abs(world.speed_m_per_s).max() <= slow and abs(world.unwind_speed_m_per_s) <= slow
        return bool(stands) and not self.loop.cycle.outputs.torque_nm.any()

    def first(self) -> tuple[str, float]:
        """The first rule that was told since, and when; one that only warns counts, too."""
        since = [*self.loop.alarms[self._alarms :], *self.loop.stopped_by[self._stopped_by :]]
        if not since:
            return "", NEVER_S
        at_s, finding = min(since, key=lambda told: (told[0], -told[1].action))
        return finding.rule, at_s - self.begin_s

    def outcome(self, rest_s: float, spared: tuple[str, ...] = (), note: str = "") -> Outcome:
        """`spared`: kinds of unsafe events that the fault itself is."""
        code, found_s = self.first()
        now = self.loop.truth.recorder.unsafe_events
        unsafe = {kind: count - self._unsafe.get(kind, 0) for kind, count in now.items() if kind not in spared}
        note = note or self.loop.cycle.machine.reason
        return Outcome(
            self.row, self.seed, {kind: count for kind, count in unsafe.items() if count}, code, found_s, rest_s,
            self.fastest, note[:300],
        )  # fmt: skip


def at_start(row: str, seed: int, broken: list[int]) -> Outcome:
    """Armed and started with the web missing in these spans, from 1.

    Times are from when the slack that may be there, and what radii leave open, had been used up in one of them.
    """
    loop = threaded(seed)
    watched = Watched(row, seed, loop, [f"web {span} web-break" for span in broken])
    loop.step(3)
    if refused := armed(loop) or started(loop):
        return watched.outcome(0.0, ("tension-band",), refused)
    taken_up = TakenUp(loop, broken)

    def rests() -> bool:
        taken_up.look()
        return loop.cycle.machine.state is LoopState.STOP and watched.rests()

    rest_s = watched.step_until(rests, 2.0 * loop.line.longest_stop_s + longest_tensioning_s(loop.line) + AT_MOST_S)
    found, used_up_s = watched.outcome(rest_s, ("tension-band",)), taken_up.used_up_s - watched.begin_s
    return replace(found, found_s=max(0.0, found.found_s - used_up_s), rest_s=max(0.0, found.rest_s - used_up_s))


class TakenUp:
    """When the slack that may be there had been taken up in one of some spans: `used_up_s`; until then now."""

    def __init__(self, loop: SteppedLoop, spans: list[int]) -> None:
        self._loop, self._spans = loop, np.array(spans) - 1
        self._state, self._limits = TensioningState(way_m=np.zeros(loop.line.n + 1)), tensioning_limits(loop.line)
        self._is_used_up = False
        self.used_up_s = loop.now_s

    def look(self) -> None:
        """Once a period."""
        world = self._loop.truth.world
        speeds = np.concatenate(((world.unwind_speed_m_per_s,), world.surface_speed_m_per_s))
        self._state.way_m += self._loop.line.control.period_s * speeds
        self._is_used_up |= bool((surely_stretched_m(self._limits, self._state)[self._spans] >= 0.0).any())
        if not self._is_used_up:
            self.used_up_s = self._loop.now_s


def started(loop: SteppedLoop) -> str:
    reply = loop.command(Start())
    return "" if reply.ok else "; ".join([reply.text, *reply.reasons])


def in_production(row: str, seed: int, fault: Callable[[Drawn, np.random.Generator], str], within_s: float,
                  spared: tuple[str, ...] = (), stopped_at_once: bool = False) -> Outcome:  # fmt: skip
    """A fault at a random speed and phase; watched until the line rests, or for `within_s`.

    `stopped_at_once`: by a person who knows of it in the very period; what no rule can be quicker than.
    """
    dice = np.random.default_rng([seed, 33])
    loop = begun(seed, float(dice.uniform(0.1, 0.9)))
    loop.step(int(dice.integers(1, 100)))
    watched = Watched(row, seed, loop, [fault(drawn(seed), dice)])
    if stopped_at_once:
        loop.command(Stop())
    rest_s = watched.step_until(lambda: loop.cycle.machine.state is LoopState.STOP and watched.rests(), within_s)
    return watched.outcome(rest_s, spared)


def healthy(row: str, seed: int) -> Outcome:
    """A start, a grade change, a change of speed, a hold, a stop: nothing may be found."""
    loop, dice = threaded(seed), np.random.default_rng([seed, 34])
    line = loop.line
    watched = Watched(row, seed, loop, [])
    way_s = line.limits.speed_max_m_per_s / line.moves.speed_rate_m_per_s2
    refused = armed(loop)
    refused = refused or ordered(loop, Start(), Phase.RUNNING, longest_tensioning_s(line) + 10.0)
    if not refused:
        loop.step(round(way_s / line.control.period_s))
        for span, value in enumerate(line.recipes[0].tension_n, start=1):
            loop.command(SetTension(span=span, tension_n=value * float(dice.uniform(0.85, 1.15))))
        loop.command(SetSpeed(speed_m_per_s=float(dice.uniform(0.1, 0.9)) * line.limits.speed_max_m_per_s))
        loop.step(round((way_s + 3.0) / line.control.period_s))
        refused = ordered(loop, Hold(), Phase.HOLDING, 1.0)
    if not refused:
        loop.step(round(1.0 / line.control.period_s))
    watched_code, _ = watched.first()  # before the stop, which is wanted
    loop.command(Stop())
    rest_s = watched.step_until(watched.rests, loop.now_s + line.longest_stop_s + AT_MOST_S)
    found = watched.outcome(rest_s, note=refused)
    code = watched_code or ("refused" if refused else "")
    return replace(found, code=code, rest_s=rest_s)
