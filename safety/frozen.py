"""Drives that answer with what they said before: correctly framed, in time, and old. Pure; time is counted in periods.

The measured speed of a turning roller jitters: it hardly ever comes twice, to the last count. Whether that is so for a
drive is learnt from its own samples: one with a coarse or filtered speed repeats itself, and nothing can be told this
way. Only reversals teach that there is jitter: in a ramp a coarse speed changes with every sample, too.
"""

from dataclasses import dataclass, field
from math import nan

from gateway.core.line import Line
from gateway.core.signals import Inputs, Quality
from safety.actions import Action, Finding

REPEATS = 7  #: of one sample until a drive counts as frozen: by chance once in decades, at one in RARE
LEARNT_REVERSALS = 150  #: of the speed, until a drive is judged
REMEMBERED_REVERSALS = 10_000  #: then half of what was learnt is forgotten
RARE = 30  #: reversals to which at most one repeat belongs; jitter reverses two times in three
TURNING = 0.02  #: of the line's greatest speed; slower, an encoder may well count nothing between two samples
_GOOD = int(Quality.GOOD)


@dataclass(slots=True)
class Encoder:
    """What is known of the speed of one drive."""

    speed_m_per_s: float = nan  #: last sample
    change_m_per_s: float = 0.0  #: the last one that was not zero
    reversals: int = 0  #: changes against the one before
    repeats: int = 0  #: in runs that have ended: before, a run may be the fault
    same: int = 0  #: repeats in a row

    def sample(self, speed_m_per_s: float, turning: bool) -> None:
        """One that has come. `turning`: it is fast enough to be judged, and learnt from."""
        change = speed_m_per_s - self.speed_m_per_s
        self.speed_m_per_s = speed_m_per_s
        if change == 0.0 and turning:
            self.same += 1
            return
        self.repeats += self.same
        self.same = 0
        if change != 0.0:
            self.reversals += turning and change * self.change_m_per_s < 0.0
            self.change_m_per_s = change
        if self.reversals > REMEMBERED_REVERSALS:
            self.reversals, self.repeats = self.reversals // 2, self.repeats // 2

    def frozen(self) -> bool:
        return self.same >= REPEATS and self.reversals >= LEARNT_REVERSALS and RARE * self.repeats <= self.reversals


@dataclass(slots=True)
class FrozenState:
    encoders: list[Encoder] = field(default_factory=list[Encoder])  #: one per roller


def turning_m_per_s(line: Line) -> float:
    """The speed from which on a roller turns fast enough for its samples to be judged."""
    return TURNING * line.limits.speed_max_m_per_s


def find_frozen(turning_from_m_per_s: float, state: FrozenState, inputs: Inputs) -> list[Finding]:
    """Drives whose samples stand still while their rollers turn. Brings `state` up to date."""
    if len(state.encoders) != inputs.n:
        state.encoders = [Encoder() for _ in range(inputs.n)]
    findings: list[Finding] = []
    speeds, qualities = inputs.speed.value.tolist(), inputs.speed.quality.tolist()
    for i, (encoder, speed_m_per_s, quality) in enumerate(zip(state.encoders, speeds, qualities, strict=True)):
        if quality == _GOOD:
            encoder.sample(speed_m_per_s, abs(speed_m_per_s) > turning_from_m_per_s)
        if encoder.frozen():
            findings.append(_finding(encoder, i))
    return findings


def _finding(encoder: Encoder, i: int) -> Finding:
    text = (
        f"the drive of roller {i + 1} has shown {encoder.speed_m_per_s:.6f} m/s {encoder.same + 1} times in a row: "
        "its samples are frozen; restart the drive, and check what lies between"
    )
    return Finding("drive frozen", Action.STOP, text)
