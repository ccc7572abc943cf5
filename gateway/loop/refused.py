"""A command that is not carried out."""

from collections.abc import Iterable

from gateway.core.finding import Finding
from gateway.wording.catalogue import sentence


class Refused(Exception):
    """Nothing was changed. The text is one sentence; `reasons` has every one where there are several."""

    def __init__(self, text: str, reasons: Iterable[str | Finding] = ()) -> None:
        super().__init__(text)
        self.told = told = list(reasons)
        self.reasons = said(told)
        self.findings = coded(told)


def said(reasons: Iterable[str | Finding]) -> list[str]:
    """Reasons as sentences."""
    return [reason if isinstance(reason, str) else sentence(reason) for reason in reasons]


def coded(reasons: Iterable[str | Finding]) -> list[Finding]:
    """Those of them that are data."""
    return [reason for reason in reasons if isinstance(reason, Finding)]
