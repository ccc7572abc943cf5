"""The audit's head leaves the machine's reach: a line of the log when it has changed, which a journal takes away.

Whoever may write database and anchor can make a chain anew that is sound. What was told elsewhere before, they cannot
take back: `r2rgate audit verify --against HEAD` finds that the chain no longer has it.
"""

from collections.abc import Callable

from gateway.core.audit_head import AuditHead
from gateway.supervisor.audit import AuditState

EVERY_S = 60.0  #: at most, but for decisions
DECISION_S = 1.0  #: at most, also for decisions


class HeadTold:
    """`look` a few times a second. `tell` gets each line."""

    def __init__(
        self, state: Callable[[], AuditState], tell: Callable[[str], None], clock: Callable[[], float]
    ) -> None:
        self._state = state
        self._tell = tell
        self._clock = clock
        self._told = AuditHead(0, "")
        self._told_s: float | None = None
        self._decided = 0

    @property
    def head(self) -> str:
        """NUMBER:HASH as of now; empty: nothing is recorded yet."""
        last = self._state().last
        return str(AuditHead(last.sequence, last.head)) if last.sequence else ""

    def look(self) -> None:
        """Tell the head where it has changed, and enough time has passed, or something was decided."""
        state = self._state()
        head = AuditHead(state.last.sequence, state.last.head)
        if not head.sequence or head == self._told:
            return
        passed_s = float("inf") if self._told_s is None else self._clock() - self._told_s
        if passed_s >= EVERY_S or (state.decided > self._decided and passed_s >= DECISION_S):
            self._told, self._told_s, self._decided = head, self._clock(), state.decided
            self._tell(f"audit head: {head}")
