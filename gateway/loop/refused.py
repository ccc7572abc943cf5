"""A command that is not carried out."""

from collections.abc import Iterable

from gateway.core.finding import Finding
from gateway.core.messages import Reply
from gateway.wording.catalogue import sentence, sentences


class Refused(Exception):
    """Nothing was changed. The text is what was found; or a title, and what was found are its `reasons`."""

    def __init__(self, *findings: Finding, title: str = "") -> None:
        super().__init__(title or sentences(findings))
        self.findings = list(findings)
        self.reasons = said(findings) if title else []

    def reply(self, state: str) -> Reply:
        """What the loop answers, in `state`."""
        return Reply(ok=False, state=state, text=str(self), reasons=self.reasons, findings=self.findings)


def said(reasons: Iterable[str | Finding]) -> list[str]:
    """Reasons as sentences; those of drivers may be sentences already."""
    return [reason if isinstance(reason, str) else sentence(reason) for reason in reasons]


def coded(reasons: Iterable[str | Finding]) -> list[Finding]:
    """Those of them that are data."""
    return [reason for reason in reasons if isinstance(reason, Finding)]
