"""Drives that answer with what they said before: correctly framed, in time, and old. Pure; time is counted in periods.

The measured speed of a turning roller jitters: it hardly ever comes twice, to the last count. Whether that is so for a
drive is learnt from its own samples, for each range of the line's speed apart, because jitter changes with it: a coarse
or filtered speed repeats itself, and nothing can be told this way. Only reversals teach that there is jitter: in a ramp
a coarse speed changes with every sample, too.

So a drive that freezes before its jitter is known, some seconds at a new speed, is not found by this rule.
"""

from dataclasses import dataclass, field
from math import log2, nan

from gateway.core.line import Line
from gateway.core.signals import Inputs, Quality
from safety.actions import Action, Finding, found

REPEATS = 7  #: of one sample until a drive counts as frozen
LEARNT_REVERSALS = 150  #: of the speed, until a drive is judged
REMEMBERED_REVERSALS = 10_000  #: then half of what was learnt is forgotten
#: Reversals to which at most one repeat belongs. Gaussian jitter reverses two times in three; with this many repeats it
#: shows eight equal samples once in a century on six drives at 100 Hz.
RARE = 60
RANGES_PER_OCTAVE = 2  #: of the line's speed
TURNING = 0.02  #: of the line's greatest speed; slower, an encoder may well count nothing between two samples
_GOOD = int(Quality.GOOD)


@dataclass(slots=True)
class Jitter:
    """What is known of the speed of a drive in one range of the line's speed."""

    reversals: int = 0  #: changes against the one before
    repeats: int = 0  #: samples like the one before, in runs that have ended: before, a run may be the fault

    def learn(self, reversals: int, repeats: int) -> None:
        self.reversals += reversals
        self.repeats += repeats
        if self.reversals > REMEMBERED_REVERSALS:
            self.reversals, self.repeats = self.reversals // 2, self.repeats // 2

    def forbids_repeats(self) -> bool:
        return self.reversals >= LEARNT_REVERSALS and RARE * self.repeats <= self.reversals


@dataclass(slots=True)
class Encoder:
    """The speed of one drive."""

    speed_m_per_s: float = nan  #: last sample
    change_m_per_s: float = 0.0  #: the last one that was not zero
    same: int = 0  #: repeats in a row
    known: dict[int, Jitter] = field(default_factory=dict[int, Jitter])  #: by range of the line's speed

    def sample(self, speed_m_per_s: float, jitter: Jitter) -> None:
        """One that has come while the line runs in the range of `jitter`."""
        change = speed_m_per_s - self.speed_m_per_s
        self.speed_m_per_s = speed_m_per_s
        if change == 0.0:
            self.same += 1
            return
        jitter.learn(change * self.change_m_per_s < 0.0, self.same)
        self.same, self.change_m_per_s = 0, change


@dataclass(slots=True)
class FrozenState:
    encoders: list[Encoder] = field(default_factory=list[Encoder])  #: one per roller


def turning_m_per_s(line: Line) -> float:
    """The speed of the line from which on its rollers turn fast enough for their samples to be judged."""
    return TURNING * line.limits.speed_max_m_per_s


def restart(state: FrozenState) -> None:
    """Samples from before count no more; what was learnt of the encoders stays."""
    state.encoders = [Encoder(known=encoder.known) for encoder in state.encoders]


def find_frozen(turning_from_m_per_s: float, state: FrozenState, inputs: Inputs) -> list[Finding]:
    """Drives whose samples stand still while the line runs, as its unwinder says. Brings `state` up to date."""
    if len(state.encoders) != inputs.n:
        state.encoders = [Encoder() for _ in range(inputs.n)]
    line_m_per_s = abs(inputs.unwind_speed.value.item(0))
    if not line_m_per_s > turning_from_m_per_s:  # NaN, too
        for encoder in state.encoders:
            encoder.same = 0
        return []
    at = round(RANGES_PER_OCTAVE * log2(line_m_per_s))
    findings: list[Finding] = []
    speeds, qualities = inputs.speed.value.tolist(), inputs.speed.quality.tolist()
    for i, (encoder, speed_m_per_s, quality) in enumerate(zip(state.encoders, speeds, qualities, strict=True)):
        jitter = encoder.known.setdefault(at, Jitter())
        if quality == _GOOD:
            encoder.sample(speed_m_per_s, jitter)
        if encoder.same >= REPEATS and jitter.forbids_repeats():
            findings.append(_finding(encoder, i))
    return findings


def _finding(encoder: Encoder, i: int) -> Finding:
    values = {"speed_m_per_s": encoder.speed_m_per_s, "in_a_row": encoder.same + 1}
    return found("drive-frozen", Action.STOP, roller=i + 1, **values)
