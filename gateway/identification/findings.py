"""What an assessment of data says: findings with numbers, and whether a model may be made from the data."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

from gateway.identification.alignment import Alignment
from gateway.identification.regressions import EquationFit

EXCITATION = "excitation"  #: kind of a finding: these data do not move the line enough to tell


class Severity(IntEnum):
    NOTE = 0  #: good to know
    WARNING = 1  #: a model can be made; what is said of it holds with this in mind
    REFUSAL = 2  #: no model is made from these data


@dataclass(frozen=True)
class Finding:
    kind: str  #: one word for machines: "gap", "frozen", "unit", "swapped", "mixed", "excitation", ...
    severity: Severity
    what: str  #: a sentence
    where: str  #: channel and samples, or the equation
    value: float
    limit: float
    mend: str = ""  #: what would mend it
    experiment: str = ""  #: which experiment would provide what is missing

    def __str__(self) -> str:
        parts = [f"{self.where}: {self.what}"]
        parts += [self.mend] if self.mend else []
        parts += [f"experiment: {self.experiment}"] if self.experiment else []
        return "; ".join(parts)


@dataclass(frozen=True)
class Assessment:
    """`predicted` has relative half-widths of 95 % by the names of `Estimate.intervals`, as the simple regressions
    say; all estimators together do better."""

    findings: tuple[Finding, ...]  #: the gravest first
    alignments: tuple[Alignment, ...]
    fits: tuple[EquationFit, ...]
    predicted: dict[str, float]

    @property
    def usable(self) -> bool:
        return not self.refusals

    @property
    def refusals(self) -> tuple[Finding, ...]:
        return tuple(f for f in self.findings if f.severity is Severity.REFUSAL)

    def kinds(self, least: Severity = Severity.REFUSAL) -> set[str]:
        return {f.kind for f in self.findings if f.severity >= least}


def gravest_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    return tuple(sorted(findings, key=lambda finding: -finding.severity))
