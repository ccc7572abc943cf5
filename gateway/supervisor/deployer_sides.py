"""What the deployer works with: an audit, a loop, a judge, and what the line is like."""

from collections.abc import Iterable, Mapping
from typing import Any, Protocol

from gateway.core.audit_record import Who
from gateway.core.deployment import RecoveryPrediction, Region
from gateway.core.judge_context import JudgeContext
from gateway.core.messages import Command, Reply
from gateway.core.proof import Grounds
from gateway.core.proposal import Proposal
from gateway.core.recording import Recording
from gateway.core.verdict import Verdict
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.lifecycle import Book, Entry


class NotTakenUp(Exception):
    """What was to be put into service could not be stored; the text says why."""


class NotKnown(Exception):
    """Something without which nothing can be judged or deployed; the text says what, and what to do."""


class NotAtHand(AuditUnavailable):
    """It was not fetched, or could not be; the text says so."""


class AuditSide(Protocol):
    async def append(
        self, kind: str, who: Who, what: Mapping[str, Any], blobs: Mapping[str, bytes] | None = None
    ) -> object:
        """Stored for good when it returns. Raises AuditUnavailable."""
        ...

    async def fetch(self, ids: Iterable[str]) -> None:
        """So that `blob` of these does not wait. Raises AuditUnavailable."""
        ...

    def blob(self, id_: str) -> bytes | None:
        """What lies beside the records under this hash; None: it is not what was stored. Reads no disk.

        Raises NotAtHand.
        """
        ...

    async def newest(self, most: int, skip: int) -> list[Entry]:
        """Proposals as the records have them, the newest first, but for the first `skip`. Raises AuditUnavailable."""
        ...

    async def recall(self, beginning: str) -> list[Entry]:
        """Those whose hash begins so, as the records have them. Raises AuditUnavailable."""
        ...


class LoopSide(Protocol):
    async def tell(self, command: Command, grounds: Grounds | None = None) -> Reply:
        """`grounds`: by what it is allowed, where a proposal is. Raises Unreachable."""
        ...


class JudgeSide(Protocol):
    async def judge(self, payload: bytes, context: JudgeContext, recordings: list[Recording]) -> Verdict:
        """Always a verdict: none in time is a refusal."""
        ...


class Surroundings(Protocol):
    """What the line is like now, as a verdict needs it."""

    async def context(self, book: Book) -> tuple[JudgeContext, list[Recording]]: ...

    async def at_hand(self, book: Book) -> None:
        """Before `difference`: what it needs of the disk."""
        ...

    def difference(self, proposal: Proposal, book: Book) -> list[str]:
        """What it would change, for a person. Reads no disk."""
        ...

    async def close(self) -> None: ...

    async def recovery(self, fallback: str, region: Region, book: Book) -> RecoveryPrediction | None:
        """Whether configuration `fallback` would recover the line, for the loop to see; None: no model is accepted.

        Raises NotKnown.
        """
        ...

    def begin_probation(self) -> None:
        """A change is about to be put on the line."""
        ...

    def change_taken(self) -> None:
        """The loop has taken the change later than it was put: what was measured in between says nothing of it."""
        ...

    def against_keeping(self, now_s: float) -> str:
        """Look at a deployment on probation, at a monotonic time: why it must go back; empty: nothing that was seen.

        It goes back, too, where too little of it was to be seen for too long.
        """
        ...

    def unseen(self) -> str:
        """What it has not shown yet, and must before it is kept; empty: it may be kept."""
        ...
