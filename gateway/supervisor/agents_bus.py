"""The agents' bus of a gateway process: opened beside everything else, and told of in events and in the status."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

from gateway.core.line import Line
from gateway.core.status import BusStatus
from gateway.core.topics import AGENT_DECIDE, AGENT_NAMES, AgentName
from gateway.mailbox.allowance import Allowance
from gateway.mailbox.bus import BusUnavailable, open_router
from gateway.mailbox.port import Mailbox
from gateway.mailbox.zenoh_mailbox import ZenohMailbox
from gateway.supervisor.agents_cases import AgentsCases
from gateway.supervisor.patience import Patience

MOST_EVENTS_PER_S = 0.1  #: of each kind: whoever comes and goes all the time, or floods, does not flood the history


class Desk(Protocol):
    def serve_on(self, bus: Mailbox) -> None:
        """Answer what agents ask of it."""
        ...


class AgentsBus:
    """`keep_open` and `watch` a few times a second, `close` at the end. Without it the gateway does all else."""

    def __init__(
        self, line: Line, run_folder: Path, desks: Sequence[Desk], note: Callable[..., None], cases: AgentsCases,
        clock: Callable[[], float],
    ) -> None:  # fmt: skip
        self._line = line
        self._run_folder = run_folder
        self._desks = desks
        self._note = note
        self._cases = cases
        self._clock = clock
        self._mailbox: ZenohMailbox | None = None
        self._opening = Patience(clock)
        self._text = "it is about to be opened"
        self._agents: set[AgentName] = set()
        self._told_agents: set[AgentName] = set()
        self._told_refused = 0
        self._of_agents = Allowance(MOST_EVENTS_PER_S)
        self._of_refused = Allowance(MOST_EVENTS_PER_S)

    async def keep_open(self) -> None:
        """Open it, where it is not open and it is time to try; what stands in its way is told once."""
        if self._mailbox is None and self._opening.is_due():
            await self._open()

    async def _open(self) -> None:
        """What cannot be opened raises nothing: a gateway without the bus is better than none."""
        mailbox: ZenohMailbox | None = None
        open_to, trouble = self._line.network, ""
        try:
            try:
                mailbox = await open_router(self._line, self._run_folder)
            except BusUnavailable as error:
                if open_to is None:
                    raise
                # Certificates of a bus beyond this machine are no reason to have none on it.
                open_to, trouble = None, f"it is not open on {open_to.listen}: {error}"
                mailbox = await open_router(self._line.model_copy(update={"network": None}), self._run_folder)
            for desk in self._desks:
                desk.serve_on(mailbox)
            for agent in AGENT_NAMES:
                mailbox.watch(AGENT_DECIDE.of(agent), partial(self._seen, agent))
        except Exception as error:  # whatever it is
            self._text = f"it could not be opened, and is tried again: {error}"
            if self._opening.failed():
                self._note("agents-bus", f"the agents' bus is closed: {error}")
            if mailbox is not None:
                await mailbox.close()
            return
        self._mailbox, self._text = mailbox, trouble
        beyond = f", also on {open_to.listen}" if open_to is not None else f"; {trouble}" if trouble else ""
        self._note("agents-bus", f"the agents' bus is open{beyond}")

    def watch(self) -> None:
        """Notes agents that have come or gone, and requests that were turned away."""
        if self._agents != self._told_agents and self._of_agents.take(self._clock()):
            for words, names in (
                ("answers questions", self._agents - self._told_agents),
                ("answers no questions any more", self._told_agents - self._agents),
            ):
                for agent in sorted(names):
                    self._note("agent", f"agent {agent} {words}")
            self._told_agents = set(self._agents)
        refused = 0 if self._mailbox is None else self._mailbox.counters.refused
        if refused != self._told_refused and self._of_refused.take(self._clock()):
            told = f"{refused - self._told_refused} requests of agents were turned away"
            self._note("agents-refused", told)
            self._cases.note("turned-away", told, times=refused - self._told_refused)
            self._told_refused = refused

    def status(self) -> BusStatus:
        refused = 0 if self._mailbox is None else self._mailbox.counters.refused
        opened = self._mailbox is not None
        return BusStatus(open=opened, text=self._text, agents=sorted(self._agents), refused=refused)

    async def close(self) -> None:
        if self._mailbox is not None:
            await self._mailbox.close()

    def _seen(self, agent: AgentName, here: bool) -> None:
        if here:
            self._agents.add(agent)
        else:
            self._agents.discard(agent)
            self._cases.note("gone", f"agent {agent} answers no questions any more", agent)
