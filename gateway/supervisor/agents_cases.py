"""What goes wrong with agents, for the audit: one record of a case in `RECORD_EVERY_S` at most, with how often it came.

Whoever floods, hangs or talks nonsense is on record, and fills no disk.
"""

import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from math import inf
from typing import Any, Literal

from gateway.core.audit_record import Who
from gateway.core.topics import AgentName
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.peers import GATEWAY

Case = Literal["gone", "turned-away", "refused", "unanswered", "rules-instead"]
RECORD_EVERY_S = 60.0  #: of each case
MOST_LETTERS = 400

#: As `Audit.append`. Raises AuditUnavailable.
Append = Callable[[str, Who, dict[str, Any]], Awaitable[object]]


@dataclass
class _Open:
    """What has come of a case since its last record."""

    times: int = 0
    agents: tuple[AgentName, ...] = ()
    newest: str = ""


class AgentsCases:
    """`note` from the event loop as often as anybody likes, `look` a few times a second.

    gone: an agent answers questions no more. turned-away: requests beyond the allowed rate or length. refused: what an
    agent sent is not what its topic takes. unanswered: a phase went on by the rules, because its agent failed.
    rules-instead: an agent answered by the rules, because its language model or its knowledge failed.
    """

    def __init__(self, append: Append, clock: Callable[[], float] = time.monotonic) -> None:
        self._append = append
        self._clock = clock
        self._open: dict[Case, _Open] = {}
        self._recorded_s: dict[Case, float] = {}

    def note(self, case: Case, text: str, agent: AgentName | None = None, times: int = 1) -> None:
        found = self._open.setdefault(case, _Open())
        found.times += times
        found.newest = text[:MOST_LETTERS]
        if agent is not None and agent not in found.agents:
            found.agents += (agent,)

    async def look(self) -> None:
        """Stores what is due. What could not be stored is tried again with the case's next record."""
        for case in tuple(self._open):
            if self._clock() - self._recorded_s.get(case, -inf) < RECORD_EVERY_S:
                continue
            self._recorded_s[case] = self._clock()
            found = self._open.pop(case)
            what = {"case": case, "times": found.times, "agents": list(found.agents), "newest": found.newest}
            try:
                await self._append("agents", GATEWAY, what)
            except AuditUnavailable:
                self._merge(case, found)

    def _merge(self, case: Case, before: _Open) -> None:
        since = self._open.get(case, _Open())
        agents = tuple(dict.fromkeys((*before.agents, *since.agents)))
        self._open[case] = _Open(before.times + since.times, agents, since.newest or before.newest)
