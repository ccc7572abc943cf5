"""What the pulls of a proof say of the wiring: signs, zeros, factors, and which load cell belongs to which span. Pure.

A pull of drive i tensions spans 1 to i, span i most; spans behind it give way. So the first pull, counted from the
unwinder, to which a load cell answers names its span. A tension is never below that of a slack web: the sign of what a
load cell shows most is its own. The direction of torque to which the web answers is the drive's.

Where few devices are proved anew the others count as they were proved: as the line's file says. They are not judged;
what does not go together with them is found of the drive that pulled.
"""

from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np

from gateway.core.finding import Finding as Coded
from gateway.core.finding import finding
from gateway.core.line import Line
from gateway.core.signals import FloatArray
from gateway.core.wiring_proof import CellProved, DriveProved
from safety.actions import Action, Finding, found
from safety.proving import ANSWERS, Factor, Noise, ProvingLimits, Pull, factor_of, speed_sign_of, way_sign_of

STRONG = 0.2  #: of what answers most to a pull: less may be the web that settles
CERTAIN = 0.75  #: of what counts as an answer while a drive pulls
SURE_NOISE = 8.0  #: times a load cell's noise
PULLED = 0.1  #: of its whole torque for a ramp
OWN = 0.3  #: of the most that a load cell shows of a newton in any pull: less is a web that settles


@dataclass(frozen=True, slots=True)
class Judged:
    """`questions` are what no pull could show: a person is asked, by code and with the device's name.

    `drives` and `cells` as they have shown themselves, whether or not something was found.
    """

    findings: list[Finding]
    questions: list[Coded] = field(default_factory=list[Coded])
    drives: list[DriveProved] = field(default_factory=list[DriveProved])
    cells: list[CellProved] = field(default_factory=list[CellProved])


def judge_zeros(line: Line, limits: ProvingLimits, zero_n: FloatArray) -> list[Finding]:
    """Load cells whose zero (n,) is off, either way, while no drive gives torque."""
    names = _cell_names(line)
    return [
        found(
            "cell-zero-off", Action.TORQUE_OFF, cell=names[j], span=j + 1, zero_n=float(zero_n[j]),
            allowed_n=float(limits.zero_n[j]),
        )
        for j in np.flatnonzero(limits.measured & (np.abs(zero_n) > limits.zero_n)).tolist()
    ]  # fmt: skip


def judge(
    line: Line, limits: ProvingLimits, noise: Noise, zero_n: FloatArray, pulls: list[Pull], only: Collection[str] = ()
) -> Judged:
    """All pulls, one of every drive, in any order; of a proof of `only` these devices one of each that it needs."""
    return _Judgement(line, limits, noise, zero_n, pulls, only).judged()


def _cell_names(line: Line) -> list[str]:
    names = {cell.span: cell.name for cell in line.load_cells}
    return [names.get(j + 1, f"load cell {j + 1}") for j in range(line.n)]


def _drive_names(line: Line) -> list[str]:
    names = {drive.roller: drive.name for drive in line.drives}
    return [names.get(i + 1, f"drive {i + 1}") for i in range(line.n)]


class _Judgement:
    def __init__(
        self, line: Line, limits: ProvingLimits, noise: Noise, zero_n: FloatArray, pulls: list[Pull],
        only: Collection[str],
    ) -> None:  # fmt: skip
        self._limits, self._noise, self._zero_n = limits, noise, zero_n
        self._pulls = {pull.drive: pull for pull in pulls}
        self._cells, self._drives = _cell_names(line), _drive_names(line)
        self._trusted = [bool(only) and name not in only for name in self._cells]  #: load cells, as they were proved
        self._trusted_drive = [bool(only) and name not in only for name in self._drives]
        self._shown = {pull.drive: pull for pull in pulls if pull.direction and not pull.held}
        self._sign = [self._sign_of(j) for j in range(line.n)]
        self._answered = {i: self._answers_to(pull) for i, pull in self._shown.items()}
        self._of_span = [self._span_of(j) for j in range(line.n)]
        self._findings: list[Finding] = []
        self._questions: list[Coded] = []

    def judged(self) -> Judged:
        measured = np.flatnonzero(self._limits.measured).tolist()
        anew = [j for j in measured if not self._trusted[j]]
        self._judge_swaps(anew)
        factors = {j: self._judge_cell(j) for j in anew}
        for i in sorted(self._pulls):
            if self._trusted_drive[i]:
                self._judge_trusted(i)
            elif not self._answers_otherwise(i):
                self._judge_drive(i)
        drives = [
            DriveProved(
                drive=self._drives[i],
                roller=i + 1,
                torque_nm=pull.torque_nm,
                way_m=(pull.speed_sign * pull.direction or 1) * pull.way_m,
                answered=[j + 1 for j in self._answered.get(i, [])],
            )
            for i, pull in sorted(self._pulls.items())
            if not self._trusted_drive[i]
        ]
        cells = [
            CellProved(
                cell=self._cells[j],
                span=j + 1,
                zero_n=float(self._zero_n[j]),
                factor=factors[j].value,
                answered_to=[i + 1 for i in self._answering(j)],
            )
            for j in anew
        ]
        return Judged(self._findings, self._questions, drives, cells)

    def _sign_of(self, j: int) -> int:
        """Of load cell `j`; 0: it has shown nothing. A web shows a cell most in the pull of its own span."""
        if self._trusted[j]:
            return int(self._limits.measured[j])
        ends = [float(pull.end_n[j]) for pull in self._shown.values()]
        most = max(ends, key=abs, default=0.0)
        least = max((ANSWERS * self._limits.tension_n[i] for i in self._shown if i >= j), default=0.0)
        sure = max(0.5 * least, SURE_NOISE * float(self._noise.tension_n[j]))
        return 0 if abs(most) < sure or not self._limits.measured[j] else (1 if most > 0.0 else -1)

    def _risen_n(self, pull: Pull) -> FloatArray:
        risen: FloatArray = np.array(self._sign) * (pull.end_n - pull.start_n)
        return risen

    def _answers_to(self, pull: Pull) -> list[int]:
        risen = self._risen_n(pull)
        # A load cell that shows too much ends a pull before its whole torque.
        share = min(1.0, abs(pull.torque_nm) / float(self._limits.torque_nm[pull.drive]))
        least = max(STRONG * float(risen.max()), CERTAIN * ANSWERS * share * float(self._limits.tension_n[pull.drive]))
        shown = np.array(self._sign) * pull.end_n  # what only gives way may rise, too, to nothing
        return np.flatnonzero((risen >= least) & (shown >= least)).tolist()

    def _answering(self, j: int) -> list[int]:
        return sorted(i for i, answered in self._answered.items() if j in answered)

    def _span_of(self, j: int) -> int | None:
        if self._trusted[j]:
            return j if self._limits.measured[j] else None
        answering = [i for i in self._answering(j) if self._has_pulled(self._shown[i])]
        shown = {i: self._share(self._shown[i], j) for i in answering}
        own = (i for i in answering if shown[i] >= OWN * max(shown.values()))
        return next(own, None)

    def _share(self, pull: Pull, j: int) -> float:
        """Of the tension that its torque explains, what load cell `j` has shown, from when the web was tight.

        Over the whole of it and its release: at one moment a web that swings shows anything.
        """
        explained_ns = float(pull.windows[:, 0].sum() / self._limits.prior[pull.drive, 0])
        return self._sign[j] * float(pull.windows[:, 5 + j].sum()) / explained_ns

    def _has_pulled(self, pull: Pull) -> bool:
        """Whether so much of its torque was there for so long that tensions over it say anything."""
        least = PULLED * float(self._limits.torque_nm[pull.drive] * self._limits.ramp_s[pull.drive])
        return float(pull.windows[:, 0].sum()) >= least

    def _expected(self, j: int) -> int | None:
        """The first pull that load cell `j` ought to answer to."""
        return min((i for i in self._shown if i >= j), default=None)

    def _judge_swaps(self, anew: list[int]) -> None:
        wrong = {
            j: span
            for j in anew
            if (span := self._of_span[j]) is not None and span != self._expected(j)
        }  # fmt: skip
        for j, span in wrong.items():
            if wrong.get(span) == j:
                if j < span:
                    cells = {"cell": self._cells[j], "other": self._cells[span]}
                    self._find("cells-swapped", **cells, span=j + 1, other_span=span + 1)
            else:
                self._find("cell-of-another-span", cell=self._cells[j], span=j + 1, answers_as=span + 1)

    def _judge_cell(self, j: int) -> Factor:
        cell, of_span = self._cells[j], self._of_span[j]
        own = self._shown.get(j if of_span is None else of_span)
        if of_span is None or own is None:
            return self._judge_silent(j)
        if self._sign[j] < 0:
            self._find("cell-inverted", cell=cell, span=j + 1)
        return self._judge_factor(j, own, of_span)

    def _judge_factor(self, j: int, own: Pull, of_span: int) -> Factor:
        cell = self._cells[j]
        factor = factor_of(self._limits, self._noise, own, j, self._sign[j], self._behind(of_span))
        most = float(self._limits.factor[of_span])
        if factor.is_surely_off(most):
            drive = self._drives[of_span]
            self._find("cell-factor-off", cell=cell, span=j + 1, factor=factor.value, most=most, drive=drive)
        elif not factor.is_told() and self._trusted[j]:
            self._ask("drive-torque-unseen", drive=self._drives[of_span], roller=of_span + 1)
        elif not factor.is_told():
            self._ask("cell-factor-unseen", cell=cell, span=j + 1)
        return factor

    def _behind(self, i: int) -> tuple[int, int] | None:
        """The load cell that shows the span behind roller `i`, and its sign."""
        return next(((j, self._sign[j]) for j, span in enumerate(self._of_span) if span == i + 1), None)

    def _before(self, i: int) -> list[tuple[int, int]]:
        """Load cells of the spans up to roller `i`, in order, and their signs; fewer where one shows nothing."""
        of = {span: j for j, span in enumerate(self._of_span) if span is not None}
        return [(of[span], self._sign[of[span]]) for span in range(i + 1) if span in of]

    def _judge_silent(self, j: int) -> Factor:
        expected = self._expected(j)
        tight = [i for i in self._pulls if i >= j and (self._pulls[i].held or self._answered.get(i))]
        if expected in tight or j in tight:
            self._find("cell-silent", cell=self._cells[j], span=j + 1)
        else:
            self._ask("cell-unseen", cell=self._cells[j], span=j + 1)
        return Factor(1.0, np.inf)

    def _judge_trusted(self, i: int) -> None:
        """The pull of a drive that is proved, for a load cell that is not: whether it says anything."""
        pull = self._pulls[i]
        if not self._answers_otherwise(i) and pull.moved and pull.direction == 0 and self._limits.measured[i]:
            self._find("no-answer", drive=self._drives[i], roller=i + 1, way_m=abs(pull.way_m))

    def _answers_otherwise(self, i: int) -> bool:
        """Whether load cells that are proved answer to drive `i` as to that of another roller. It is found."""
        pull, answered = self._pulls[i], [j for j in self._answered.get(i, []) if self._trusted[j]]
        behind = [j for j in answered if j > i and self._has_pulled(pull) and self._share(pull, j) >= OWN]
        tight = pull.held or pull.direction != 0  # whatever has answered, and with whatever sign
        silent = tight and self._trusted[i] and bool(self._limits.measured[i]) and i not in answered
        if not behind and not silent:
            return False
        shown = max((behind or [j for j in answered if j < i]), default=-1) + 1
        self._find("drive-answered-otherwise", drive=self._drives[i], roller=i + 1, shown_span=shown)
        return True

    def _judge_drive(self, i: int) -> None:
        pull, drive = self._pulls[i], self._drives[i]
        named = {"drive": drive, "roller": i + 1}
        if not pull.moved and not self._answered.get(i):
            self._ask("roller-did-not-move", **named, torque_nm=float(self._limits.torque_nm[i]))
            return
        if pull.direction == 0 or pull.held or not self._answered.get(i):
            self._judge_unanswered(i, pull)
            return
        speed_sign = way_sign_of(self._limits, self._noise, pull, self._before(i))
        speed_sign = speed_sign or pull.speed_sign or self._speed_sign(i, pull)
        if speed_sign == 0:
            self._ask("speed-sign-unseen", **named)
        if pull.direction < 0:
            self._find("torque-reversed" if speed_sign < 0 else "drive-reversed", **named)
        elif speed_sign < 0:
            self._find("speed-reversed", **named)
        if self._trusted[i] and i in self._answered[i]:  # which tells the drive's own scale: gear and rated torque
            self._judge_factor(i, pull, i)

    def _speed_sign(self, i: int, pull: Pull) -> int:
        own = next((j for j, span in enumerate(self._of_span) if span == i), None)
        if own is None:
            return 0
        return speed_sign_of(self._limits, self._noise, pull, own, self._sign[own], self._behind(i))

    def _judge_unanswered(self, i: int, pull: Pull) -> None:
        """It has moved, and no load cell has shown it."""
        named = {"drive": self._drives[i], "roller": i + 1}
        if pull.direction == 0 and self._limits.measured[i]:
            self._find("no-answer", **named, way_m=abs(pull.way_m))
        elif pull.speed_sign < 0:
            self._find("speed-reversed", **named)
        else:
            self._ask("drive-direction-unseen", **named)

    def _find(self, code: str, **parameters: float | str) -> None:
        self._findings.append(found(code, Action.TORQUE_OFF, **parameters))

    def _ask(self, code: str, **parameters: float | str) -> None:
        self._questions.append(finding(code, **parameters))
