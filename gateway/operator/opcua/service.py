"""The OPC UA server of a line: the nodes, and the tasks that keep them true."""

import asyncio
from collections.abc import Awaitable, Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path

from gateway.core.decisions import ProposalList, ProposalShown
from gateway.core.line import Line
from gateway.operator.access import Access
from gateway.operator.line_side import LineSide, NotTold
from gateway.operator.opcua.alarm_nodes import alarms_of, live_alarm_paths, make_alarms
from gateway.operator.opcua.companion import make_companion
from gateway.operator.opcua.dialogs import Dialogs
from gateway.operator.opcua.events import Events
from gateway.operator.opcua.history import History
from gateway.operator.opcua.line_nodes import ROOT, Told, list_paths, live_paths, make_line, of_proposals, of_status
from gateway.operator.opcua.login import Check, Logins
from gateway.operator.opcua.methods import make_methods
from gateway.operator.opcua.packml import PackMl
from gateway.operator.opcua.proposal_nodes import MOST_WAITING, ProposalNodes
from gateway.operator.opcua.server import OperatorServer, make_server
from gateway.operator.opcua.space import NAMESPACE, NO_COMMUNICATION, WAITING, Space
from gateway.operator.opcua.trust import TrustList
from gateway.operator.users import RoleOf

STALE_S = 2.0  #: older than this nothing counts as known
LOOK_S = 0.5  #: between two looks at the audit and at the age of what is known
WAITS = "waiting"  #: the stage of a proposal that waits for a person


class OpcUa:
    """`start`, then `run` as a task, then `stop`."""

    def __init__(
        self,
        line: Line,
        side: LineSide,
        pki: Path,
        check: Check,
        role_of: RoleOf,
        tell: Callable[[str], None],
        access: Access | None = None,
    ) -> None:
        anonymous = line.operator.anonymous == "read"
        self.trust = TrustList(pki, tell, lambda: datetime.now(UTC))
        self.server: OperatorServer = make_server(
            line.operator.opc_ua,
            line.operator.sessions_max,
            Logins(check, role_of, anonymous, access),
            anonymous,
            self.trust,
            pki,
        )
        self.page_trouble: Callable[[], str] = str  #: why there is no page; empty: there is one
        self._made = False
        self._line = line
        self._side = side
        self._say = tell
        self._packml: PackMl | None = None
        self._new_status, self._new_proposals, self._new_told = asyncio.Event(), asyncio.Event(), asyncio.Event()
        self._shown: list[ProposalShown] = []  #: those that wait
        self._shown_of: ProposalList | None = None  #: of which list
        self._told: tuple[ProposalShown, ...] | int = WAITING  #: what the nodes show; why nothing is known

    async def start(self) -> None:
        """Raises CannotServe, and may be called again then; `stop` is needed all the same.

        The nodes are made first, and once: to make them takes a second, in which nobody is served.
        """
        if not self._made:
            await self._make()
            self._made = True
        await self._look_at_trust()
        await self.server.start()

    async def _make(self) -> None:
        """All nodes."""
        server = self.server
        await server.init()
        self._space = Space(server, await server.register_namespace(NAMESPACE))
        await make_line(self._space, self._line)
        await make_alarms(self._space)
        self._proposals = ProposalNodes(self._space)
        await self._proposals.make()
        methods = await make_methods(server, self._space, self._side)
        self._dialogs = Dialogs(self._space, methods["Decide"])
        await self._dialogs.make()
        self._events = Events(server, self._space, self._side)
        await self._events.make()
        server.iserver.history_manager = History(self._space, self._line, self._side)  # type: ignore[assignment]
        self._packml = await make_companion(self._space, self._line, self._say)
        self._side.on_status.append(lambda _: self._new_status.set())
        self._side.on_proposals.append(lambda _: self._new_proposals.set())
        self._new_proposals.set()

    async def run(self) -> None:
        """Until it is cancelled."""
        works = (
            (self._show_line, self._new_status), (self._show_proposals, self._new_proposals),
            (self._events.look, asyncio.Event()), (self._end_strangers, asyncio.Event()),
            (self._look_at_trust, asyncio.Event()),
            (self._show_dialogs, self._new_told),
        )  # fmt: skip
        async with asyncio.TaskGroup() as group:
            for do, event in works:
                group.create_task(_again(do, event, self._say))

    async def stop(self) -> None:
        await self.server.stop()

    async def _look_at_trust(self) -> None:
        """In a thread: it may wait for a disk, and nobody shall wait for that."""
        await asyncio.to_thread(self.trust.look)

    async def _end_strangers(self) -> None:
        self.server.end_strangers()

    async def _show_line(self) -> None:
        try:
            await self._show_line_as_it_is()
        except Exception as error:  # what is shown may be old, and must not look new
            trouble = f"the line cannot be shown: {type(error).__name__}: {error}"
            await self._tell((Told(f"{ROOT}.Connection.Fresh", False), Told(f"{ROOT}.Connection.Trouble", trouble)))
            await self._unsure_of_the_line(self._side.age_s)
            raise

    async def _show_line_as_it_is(self) -> None:
        side = self._side
        age_s = side.age_s
        fresh = _is_fresh(age_s)
        connection = {"Fresh": fresh, "Trouble": side.trouble, "PageTrouble": self.page_trouble()}
        await self._tell(Told(f"{ROOT}.Connection.{name}", value) for name, value in connection.items())
        if side.status is not None and fresh:
            await self._tell((*of_status(side.status), *alarms_of(side.status)), side.status.wall_s)
            if self._packml is not None:
                await self._packml.show(side.status)
            if side.proposals is not None and _is_fresh(side.proposals_age_s):
                await self._tell(of_proposals(side.proposals))
            else:
                await self._unsure(list_paths(), side.proposals_age_s)
        else:
            await self._unsure_of_the_line(age_s)

    async def _unsure(self, paths: Iterable[str], age_s: float | None) -> None:
        for path in paths:
            await self._space.tell(path, None, None, _unknown(age_s))

    async def _unsure_of_the_line(self, age_s: float | None) -> None:
        await self._unsure((*live_paths(self._line), *live_alarm_paths()), age_s)
        if self._packml is not None:
            await self._packml.unsure(_unknown(age_s))

    async def _show_proposals(self) -> None:
        try:
            await self._show_those_that_wait()
        except Exception:  # as above; the next look begins anew
            self._shown_of = None
            await self._unsure_of_proposals(NO_COMMUNICATION)
            raise

    async def _show_those_that_wait(self) -> None:
        """What is shown must be of the moment: where the gateway does not tell, nothing is."""
        found = self._side.proposals
        if found is None or not self._list_is_fresh():
            await self._unsure_of_proposals(WAITING if found is None else NO_COMMUNICATION)
            return
        if found is not self._shown_of:
            shown, missed = await self._waiting(found)
            if missed and (not shown or not self._list_is_fresh()):
                await self._unsure_of_proposals(NO_COMMUNICATION)
                return
            self._shown, self._shown_of = shown, None if missed else found
        await self._proposals.show(self._shown)
        await self._events.waiting(self._shown)
        self._told = tuple(self._shown)
        self._new_told.set()

    async def _unsure_of_proposals(self, code: int) -> None:
        self._told = code
        self._new_told.set()
        await self._proposals.unsure(code)

    async def _show_dialogs(self) -> None:
        """As the proposals are shown; what is wrong here leaves those as they are."""
        if isinstance(self._told, int):
            await self._dialogs.unsure(self._told)
        else:
            await self._dialogs.show(self._told)

    def _list_is_fresh(self) -> bool:
        return _is_fresh(self._side.age_s) and _is_fresh(self._side.proposals_age_s)

    async def _waiting(self, found: ProposalList) -> tuple[list[ProposalShown], bool]:
        """Those that can be shown, and whether one cannot. One that is decided in between is left out."""
        shown: list[ProposalShown] = []
        missed = False
        for one in [one.proposal for one in found.proposals if one.stage == WAITS][:MOST_WAITING]:
            try:
                shown.append(await self._side.shown(one))
            except NotTold:
                missed = True
                if not self._list_is_fresh():  # the gateway is away: it does not have to be asked for each
                    break
        return [one for one in shown if one.stage == WAITS and one.shown is not None], missed

    async def _tell(self, values: Iterable[Told], wall_s: float | None = None) -> None:
        for one in values:
            await self._space.tell(one.path, one.value, wall_s, one.code)


def _unknown(age_s: float | None) -> int:
    """Why nothing is known; None: nothing has ever come."""
    return WAITING if age_s is None else NO_COMMUNICATION


def _is_fresh(age_s: float | None) -> bool:
    return age_s is not None and age_s <= STALE_S


async def _again(do: Callable[[], Awaitable[None]], event: asyncio.Event, say: Callable[[str], None]) -> None:
    """Whenever the event comes, and without it every `LOOK_S`. A fault of this program is told, and ends nothing."""
    told = ""
    while True:
        event.clear()
        try:
            await do()
        except Exception as error:
            fault = f"OPC UA does not tell all: {type(error).__name__}: {error}"
            if fault != told:
                told = fault
                say(fault)
        try:
            async with asyncio.timeout(LOOK_S):
                await event.wait()
        except TimeoutError:
            pass
