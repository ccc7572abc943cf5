"""The stage in which the wiring is proved: at standstill, one drive at a time pulls, from the last to the first.

Zeros first, with every drive at no torque. Then each drive pulls until load cells answer: a little either way, then as
far as slack may let it. What came of it is judged as a whole (`safety.proving_judgement`). From the last roller to the
first, so that what one has taken up leaves no slack to the next; who answers to whom makes a triangle.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gateway.core.line import Line
from gateway.core.signals import FloatArray, Inputs
from gateway.loop.pull import BLIND_RAMPS, End, PullRun, Release, Ways, longest_pull_s, slowed_where_blind
from safety.actions import Finding
from safety.proving import ZERO_S, Noise, Pull, proving_limits, slack_of_one_span
from safety.proving_judgement import Judged, judge, judge_zeros

SETTLE_S = 2.0  #: from a release to the next pull, at most: its roller's drift is looked at meanwhile
SETTLE_LAGS = 20.0  #: in which a roller under its own friction loses its momentum
PROVED = "the wiring has been proved"  #: nothing speaks against it
AFAR = 0.3  #: of what answers most
ANSWERS_A_LITTLE = 0.1  #: of the tension that a torque explains


@dataclass(frozen=True, slots=True)
class Leg:
    """Of a drive's pulls."""

    direction: int
    far: bool


@dataclass(frozen=True, slots=True)
class Begun:
    """A pull of drive `i` (from 0), in `direction` of its torque command: so far, and for so long, at most."""

    i: int
    direction: int
    reach_m: float
    longest_s: float


LEGS = (Leg(1, False), Leg(-1, False), Leg(1, True), Leg(-1, True))
ANEW_LEGS = (Leg(1, True), Leg(-1, True))  #: of a drive that alone is proved anew: most are wired as the one before
#: Of a drive that is proved its direction is known; again where slack that ended with a jerk was taken for an answer.
PROVED_LEGS = (Leg(1, True), Leg(1, True))
ANEW_S = 180.0  #: for one device that is proved anew, where what pulls is answered to at once


class ProvingStage:
    """`judged` once it is `over`; `news` is what has been told of it since it was asked last."""

    def __init__(self, line: Line) -> None:
        self._all_limits = self.limits = proving_limits(line)
        each = [
            longest_pull_s(limits, i, float((limits.far_m if leg.far else limits.near_m)[i]))
            + float(limits.hold_s[i] + (2.0 * BLIND_RAMPS - 1.0) * limits.ramp_s[i]) + SETTLE_S
            for limits in (self.limits,) for i in range(line.n) for leg in LEGS
        ]  # fmt: skip
        self.longest_s = ZERO_S + sum(each)  #: of a whole proof, with all the slack that may be there
        self.over = True
        self.judged: Judged | None = None
        self.only: frozenset[str] = frozenset()  #: devices that are proved anew; empty: all
        self._line = line
        self._reset()

    def choose(self, only: Iterable[str]) -> None:
        """The next proof is of these devices alone; of none: of all."""
        self.only = frozenset(only)

    def pulled(self) -> list[int]:
        """Drives (from 0) that pull, the last roller first.

        For a load cell those of the roller at the end of its span, to which it answers, and of the one before, to which
        it does not.
        """
        if not self.only:
            return list(reversed(range(self._line.n)))
        rollers = {drive.roller for drive in self._line.drives if drive.name in self.only}
        spans = {cell.span for cell in self._line.load_cells if cell.name in self.only}
        return sorted((r - 1 for r in rollers | spans | {span - 1 for span in spans} if r > 0), reverse=True)

    def _legs(self, i: int) -> tuple[Leg, ...]:
        if not self.only:
            return LEGS
        named = any(drive.roller == i + 1 and drive.name in self.only for drive in self._line.drives)
        return ANEW_LEGS if named else PROVED_LEGS

    def _longest_pull_s(self, leg: Leg) -> float:
        """For a device that is proved anew one or two drives pull; one that pulls back has a way to go back first."""
        longest_s = longest_pull_s(self.limits, self._drive, self._reach_m(leg))
        if not self.only:
            return longest_s
        ramp_s, hold_s = float(self.limits.ramp_s[self._drive]), float(self.limits.hold_s[self._drive])
        forwards_s = (ANEW_S - ZERO_S) / min(2, len(self.pulled())) - ramp_s - hold_s - SETTLE_S
        forwards_s = max(forwards_s, longest_pull_s(self.limits, self._drive, 0.0))  # where friction is heavy
        return min(longest_s, forwards_s if leg.direction > 0 else 2.0 * forwards_s)

    def _reach_m(self, leg: Leg) -> float:
        return float((self.limits.far_m if leg.far else self.limits.near_m)[self._drive])

    def _reset(self) -> None:
        n = self._line.n
        self._samples: list[FloatArray] = []
        self._zero_n, self._noise = np.zeros(n), Noise(np.zeros(n), np.zeros(n), np.zeros(n))
        self._run: PullRun | None = None
        self._release: Release | None = None
        self._pulls: list[Pull] = []
        self._tried: list[PullRun] = []  #: legs of the drive at work
        self._next = self.pulled()
        self._drive = self._next.pop(0) if self._next else 0
        self._settled: list[float] = []  #: speeds of the roller of the drive that is next, since the release before
        self._settle_s = 0.0
        self._news: list[Begun] = []

    def begin(self) -> None:
        """The drives have taken over, at zero torque."""
        self._reset()
        self.over, self.judged = False, None

    def forget(self) -> None:
        """A person arms: what was proved before was of devices that may be others now."""
        self.over, self.judged = True, None

    def take_news(self) -> list[Begun]:
        """Pulls that have begun since this was asked last."""
        news, self._news = self._news, []
        return news

    def step(self, inputs: Inputs) -> FloatArray:
        """The torque (n,) of a period."""
        torque_nm = np.zeros(inputs.n)
        if self.over:
            return torque_nm
        tension_n = np.where(self.limits.measured, inputs.tension.value, 0.0)
        if len(self._samples) * self.limits.period_s < ZERO_S:
            self._samples.append(np.concatenate((tension_n, inputs.speed.value)))
            return torque_nm
        if self._run is None and self._release is None and not self._pulls and not self._tried:
            self._take_zeros()
            if self.over:
                return torque_nm
        torque_nm[self._drive] = self._drive_torque(tension_n - self._zero_n, inputs.speed.value)
        return torque_nm

    def _take_zeros(self) -> None:
        samples, n = np.array(self._samples), self._line.n
        mean, spread = samples.mean(axis=0), samples.std(axis=0)
        ways_m = np.abs(np.cumsum(samples[:, n:], axis=0)).max(axis=0) * self.limits.period_s
        self._zero_n, self._noise = mean[:n], Noise(spread[:n], spread[n:], ways_m)
        limits = slack_of_one_span(self._line, self._all_limits) if self.only else self._all_limits
        self.limits = slowed_where_blind(limits, self._noise)
        findings = judge_zeros(self._line, self.limits, self._zero_n)
        if findings:
            self._end(Judged(findings))
        elif not self.pulled():
            self._judge()

    def _drive_torque(self, tension_n: FloatArray, speed_m_per_s: FloatArray) -> float:
        i = self._drive
        speed = float(speed_m_per_s[i])
        if self._release is not None:
            torque = self._release.step(tension_n, speed)
            if self._release.over:
                self._release, self._settle_s = None, self._settles_s()
            return torque
        if self._settle_s > 0.0:
            self._settle_s -= self.limits.period_s
            self._settled.append(float(speed_m_per_s[self._next[0] if self._next else 0]))
            return 0.0
        if self._run is None:
            if not self._next_leg():
                return 0.0
            assert self._run is not None
        run = self._run
        torque = run.step(tension_n, speed)
        if run.end is not None:
            self._tried.append(run)
            self._release, self._run = Release(self.limits, self._noise, run), None
        return torque

    def _next_leg(self) -> bool:
        """Begin the next pull, of this drive or of the next one. False: there is none."""
        legs, tried = self._legs(self._drive), self._tried
        if tried and (self._is_decided() or self._is_shown(tried[-1]) or len(tried) == len(legs)):
            self._pulls.append(self._best())
            # Found where a load cell ought to have shown it; else a person is asked, and the others have their turn.
            no_web = all(run.end is End.AWAY for run in tried) and bool(self.limits.measured[self._drive])
            self._tried = []
            if not self._next or no_web:
                self._judge()
                return False
            self._drive = self._next.pop(0)
            legs = self._legs(self._drive)
        i, limits = self._drive, self.limits
        leg = legs[len(self._tried)]
        before = self._tried[-1].ways if self._tried else Ways(speed_m_per_s=self._drift_m_per_s())
        reach_m, longest_s = self._reach_m(leg), self._longest_pull_s(leg)
        self._run = PullRun(limits, self._noise, i, leg.direction, reach_m, before, longest_s)
        self._news.append(Begun(i, leg.direction, reach_m, longest_s))
        return True

    def _settles_s(self) -> float:
        prior = self.limits.prior[self._drive]
        self._settled = []
        return float(min(SETTLE_S, max(20.0 * self.limits.period_s, SETTLE_LAGS * prior[2] / prior[1])))

    def _drift_m_per_s(self) -> float:
        """At which the roller that is next turns while no drive pulls."""
        return float(np.mean(self._settled)) if self._settled else 0.0

    def _is_decided(self) -> bool:
        """Whether one direction was answered to, and in the other it went away."""
        ends = [run.end for run in self._tried]
        return len(ends) == 2 and End.ANSWERED in ends and ends[0] is End.ANSWERED and ends[1] is End.AWAY

    def _is_shown(self, run: PullRun) -> bool:
        """Whether the other direction need not be tried: a span before the roller answers, or nothing moves."""
        if self._legs(run.i) is PROVED_LEGS and run.end is not End.ANSWERED:
            return True
        if run.end is End.STUCK:
            return len(self._tried) >= 2  # either way
        if run.end is End.HELD:
            return not self.limits.measured[run.i]
        if run.end is not End.ANSWERED:
            return False
        before = self._answers_before(run) or self._answers_afar(run)
        # Only a span behind it: its load cell may be another one's. Or the roller turns backwards and drags free ones
        # along; then it goes away in this direction, and is held in the other.
        return before or (len(self._tried) == 2 and self._tried[0].end is End.ANSWERED)

    def _answers_afar(self, run: PullRun) -> bool:
        """Whether one load cell far behind answers, and the next one does not: it is another span's.

        A roller that drags the free ones behind it along tensions the next span most.
        """
        risen_n, behind = run.risen_n(), run.i + 1
        most = int(risen_n.argmax())
        answers = risen_n[most] >= ANSWERS_A_LITTLE * self.limits.tension_n[run.i]
        afar = most > behind and bool(self.limits.measured[behind]) and bool(risen_n[behind] < AFAR * risen_n[most])
        return afar and bool(answers)

    def _answers_before(self, run: PullRun) -> bool:
        """Whether a load cell of a span up to its roller has answered."""
        risen_n = run.risen_n()[: run.i + 1]
        return bool(risen_n.max() >= ANSWERS_A_LITTLE * self.limits.tension_n[run.i])

    def _best(self) -> Pull:
        """What speaks most of this drive: the pull that the web has answered to most."""
        answered = [run for run in self._tried if run.end is End.ANSWERED]
        held = [run for run in self._tried if run.end is End.HELD]
        afar = [run for run in answered if self._answers_afar(run)]
        before = afar or [run for run in answered if self._answers_before(run)]
        # What holds a roller against all of its torque is its own web, though no load cell may show it.
        if not before and held:
            return held[0].result()
        return max(before or answered or self._tried[-1:], key=lambda run: float(run.risen_n().max())).result()

    def _judge(self) -> None:
        self._end(judge(self._line, self.limits, self._noise, self._zero_n, self._pulls, self.only))

    def _end(self, judged: Judged) -> None:
        self.judged, self.over = judged, True

    def findings(self) -> list[Finding]:
        """Of what was judged; empty while it goes on."""
        return [] if self.judged is None else self.judged.findings

    def ending(self) -> str:
        """That it is over, in words; empty while it goes on."""
        if self.judged is None:
            return ""
        if self.judged.findings:
            return "; ".join(finding.text for finding in self.judged.findings)
        return PROVED

    def as_data(self) -> dict[str, object]:
        """What was judged, for an event: `findings` and `questions` by code, `drives` and `cells` as they are proved.

        Where something was found, those are what they have shown, and no proof.
        """
        judged = self.judged or Judged([])
        return {
            "findings": [each.as_data().model_dump(mode="json") for each in judged.findings],
            "questions": [each.model_dump(mode="json") for each in judged.questions],
            "drives": [each.model_dump(mode="json") for each in judged.drives],
            "cells": [each.model_dump(mode="json") for each in judged.cells],
        }
