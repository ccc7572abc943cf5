"""What waits for a person as dialogs (OPC 10000-9, DialogConditionType), for clients that have a window for them.

A dialog is of exactly one proposal as it is shown: its NodeId, which clients hand back with `Respond`, names the
proposal, the revision and the shown hash. What is shown anew is another dialog, so that an answer never counts for what
was not looked at. `Respond` is `Decide` of these three, asked and refused in the same way.
"""

import asyncio
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any
from uuid import uuid4

from asyncua import ua as asyncua_ua
from asyncua.common.event_objects import DialogCondition, RefreshEndEvent, RefreshStartEvent
from asyncua.server.event_generator import EventGenerator

from gateway.core.decisions import ProposalShown
from gateway.core.messages import Reply
from gateway.operator.opcua.events import MEDIUM
from gateway.operator.opcua.instances import Declared, declared, make, make_object
from gateway.operator.opcua.line_nodes import ROOT
from gateway.operator.opcua.methods import Asked, Input, argument, wrong
from gateway.operator.opcua.proposal_nodes import FOLDER as PROPOSALS
from gateway.operator.opcua.session import OWNS
from gateway.operator.opcua.space import BOOLEAN, GOOD, STRING, UINT32, Space
from gateway.tasks.cleanup import finish

FOLDER = f"{ROOT}.Dialogs"
APPROVE, REJECT = 0, 1  #: as `Respond` has them
NOTHING = -1  #: no option is chosen by pressing Return, or by closing the window
REFRESH_S = 1.0  #: between two refreshes of a session
QUESTIONS = {
    "gains": "Put this controller into service?",
    "experiment": "Run this experiment?",
    "model": "Judge by this model from now on?",
}  #: by the kind of a proposal

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ


_SELECTED = Input("SelectedResponse", ua.VariantType.Int32, "Of ResponseOptionSet: 0 approves, 1 rejects")
_SUBSCRIPTION = Input("SubscriptionId", UINT32, "")
_ITEM = Input("MonitoredItemId", UINT32, "")


@dataclass(frozen=True)
class _Dialog:
    path: str
    proposal: str
    shown: str
    revision: int
    emits: EventGenerator

    @property
    def event(self) -> Any:
        """Its state, which it keeps between two events."""
        return self.emits.event


class Dialogs:
    def __init__(self, space: Space, decide: Asked, clock: Callable[[], float] = time.monotonic) -> None:
        """`decide`: the line's method of that name."""
        self._space = space
        self._decide = decide
        self._clock = clock
        self._rows: list[Declared] = []
        self._open: dict[str, _Dialog] = {}  #: by path
        self._refreshed_s: dict[Any, float] = {}  #: by session, of the last second

    async def make(self) -> None:
        server = self._space.server
        await self._space.object(FOLDER, ROOT, "What waits for a person, as dialogs; the same as in Proposals")
        self._rows = await declared(server, ua.NodeId(ua.ObjectIds.DialogConditionType), ())
        for number, called in (
            (ua.ObjectIds.DialogConditionType_Respond, self._respond),
            (ua.ObjectIds.ConditionType_ConditionRefresh, self._refresh),
            (ua.ObjectIds.ConditionType_ConditionRefresh2, self._refresh_item),
        ):
            server.iserver.isession.add_method_callback(ua.NodeId(number), called)

    async def show(self, waiting: Sequence[ProposalShown]) -> None:
        """Those that wait, as they are shown now: others end. Others have their turn between two."""
        wanted = {_path(one): one for one in waiting}
        for path in [path for path in self._open if path not in wanted]:
            await self._end(path)
            await asyncio.sleep(0)
        for path in reversed([path for path in wanted if path not in self._open]):
            await self._begin(path, wanted[path])
            await asyncio.sleep(0)
        await self._quality(GOOD)

    async def unsure(self, code: int) -> None:
        """Whether they still wait is not known."""
        await self._quality(code)

    async def _quality(self, code: int) -> None:
        for one in self._open.values():
            if one.event.Quality.value != code:
                _set(one.event, {"Quality": (ua.StatusCode(code), ua.VariantType.StatusCode)}, datetime.now(UTC))
                await self._tell(one, "it waits" if code == GOOD else "not known whether it still waits")

    async def _begin(self, path: str, shown: ProposalShown) -> None:
        now = datetime.now(UTC)
        kind = ua.NodeId(ua.ObjectIds.DialogConditionType)
        name = ua.QualifiedName(f"Proposal {shown.proposal_hash[:12]}", self._space.namespace)
        await make_object(self._space, path, self._space.id(FOLDER), ua.ObjectIds.HasComponent, kind, name)
        try:
            event: Any = DialogCondition(self._space.id(PROPOSALS), severity=MEDIUM)
            event.add_property("NodeId", self._space.id(path), ua.VariantType.NodeId)  # the ConditionId, for Respond
            _set(event, _first_state(shown), now)
            options = ua.Variant(event.ResponseOptionSet, ua.VariantType.LocalizedText)
            await make(self._space, path, self._rows, {"ResponseOptionSet": options})
            await self._space.server.get_node(self._space.id(path)).add_method(
                self._space.id(f"{path}.Respond"), ua.QualifiedName("Respond", 0), self._respond,
                [argument(_SELECTED.name, _SELECTED.kind, _SELECTED.tells)], [],
            )  # fmt: skip
            emits = EventGenerator(self._space.server.iserver.isession)
            await emits.init(event, add_generates_event=False)
            made = _Dialog(path, shown.proposal_hash, shown.shown or "", shown.epoch, emits)
            await self._tell(made, f"a proposal waits for a person: {shown.proposal_hash[:12]}")
        except BaseException:
            await finish(self._space.remove(path))
            raise
        self._open[path] = made

    async def _end(self, path: str) -> None:
        one = self._open.pop(path)
        try:
            _set(one.event, {"Retain": (False, BOOLEAN)} | _dialog_state(active=False), datetime.now(UTC))
            await self._tell(one, f"it waits no more, or is shown anew: {one.proposal[:12]}")
        finally:
            await finish(self._space.remove(path))

    async def _tell(self, one: _Dialog, message: str) -> None:
        """As an event, and as the nodes that have the same."""
        one.event.Message = _text(message)
        await one.emits.trigger()
        for row in self._rows:
            name = row.path.replace(".", "/")
            kind = one.event.data_types.get(name)
            if row.node_class == ua.NodeClass.Variable and kind is not None:
                value = ua.DataValue(ua.Variant(getattr(one.event, name), kind))
                await self._space.server.write_attribute_value(self._space.id(f"{one.path}.{row.path}"), value)

    async def _respond(self, parent: Any, *arguments: Any) -> Any:
        one = self._open.get(parent.Identifier) if parent.NamespaceIndex == self._space.namespace else None
        if one is None:
            return ua.StatusCode(ua.StatusCodes.BadDialogNotActive)
        if result := wrong([_SELECTED], arguments):
            return result
        selected = arguments[0].Value
        if selected not in (APPROVE, REJECT):
            return ua.StatusCode(ua.StatusCodes.BadDialogResponseInvalid)
        reply = await self._decide(
            ua.Variant(one.proposal, STRING), ua.Variant(one.shown, STRING), ua.Variant(one.revision, UINT32),
            ua.Variant(selected == APPROVE, BOOLEAN), ua.Variant("", STRING),
        )  # fmt: skip
        if not isinstance(reply, Reply):
            return reply
        if not reply.known:
            return ua.StatusCode(ua.StatusCodes.BadTimeout)
        if not reply.ok:
            return ua.StatusCode(ua.StatusCodes.BadInvalidState)  # `Respond` has no room for the sentence
        if self._open.get(one.path) is one:
            _set(one.event, {"LastResponse": (selected, ua.VariantType.Int32)}, datetime.now(UTC))
            await self._tell(one, f"answered: {'approve' if selected == APPROVE else 'reject'}")
        return ua.StatusCode()

    async def _refresh(self, _parent: Any, *arguments: Any) -> Any:
        """ConditionRefresh: all that waits once more, for a subscription."""
        return wrong([_SUBSCRIPTION], arguments) or await self._refreshed(arguments[0].Value, None)

    async def _refresh_item(self, _parent: Any, *arguments: Any) -> Any:
        """ConditionRefresh2: for one of its items."""
        result = wrong([_SUBSCRIPTION, _ITEM], arguments)
        return result or await self._refreshed(*(one.Value for one in arguments))

    async def _refreshed(self, number: int, item: int | None) -> Any:
        service: Any = self._space.server.iserver.subscription_service
        held = service.subscriptions.get(number)
        if held is None or not OWNS.get()(number):
            return ua.StatusCode(ua.StatusCodes.BadSubscriptionIdInvalid)
        if item is not None and not held.monitored_item_srv.is_of_events(item):
            return ua.StatusCode(ua.StatusCodes.BadMonitoredItemIdInvalid)
        now_s = self._clock()
        self._refreshed_s = {one: at_s for one, at_s in self._refreshed_s.items() if now_s - at_s < REFRESH_S}
        if held.session_id in self._refreshed_s:
            return ua.StatusCode(ua.StatusCodes.BadRefreshInProgress)
        self._refreshed_s[held.session_id] = now_s
        await held.monitored_item_srv.trigger_event(_end_of_refresh(RefreshStartEvent()), item)
        for one in list(self._open.values()):
            if self._open.get(one.path) is one:
                await held.monitored_item_srv.trigger_event(one.event, item)
            await asyncio.sleep(0)  # the others' turn
        await held.monitored_item_srv.trigger_event(_end_of_refresh(RefreshEndEvent()), item)
        return ua.StatusCode()


def _end_of_refresh(event: Any) -> Any:
    """Its beginning, or its end."""
    event.EventId = uuid4().bytes
    event.SourceNode, event.SourceName = ua.NodeId(ua.ObjectIds.Server), "Server"
    event.Time = event.ReceiveTime = datetime.now(UTC)
    event.Message = _text("what waits, once more")
    return event


def _path(shown: ProposalShown) -> str:
    return f"{FOLDER}.{shown.proposal_hash}-{shown.epoch}-{shown.shown}"


def _first_state(shown: ProposalShown) -> dict[str, tuple[Any, Any]]:
    """Values and types of an event that begins, by the path below its type."""
    boolean, text, node_id = ua.VariantType.Boolean, ua.VariantType.LocalizedText, ua.VariantType.NodeId
    number = ua.VariantType.Int32
    return {
        "SourceName": ("Proposals", STRING), "ConditionName": ("Proposal", STRING), "BranchId": (ua.NodeId(), node_id),
        "ConditionClassId": (ua.NodeId(ua.ObjectIds.BaseConditionClassType), node_id),
        "ConditionClassName": (_text("BaseConditionClass"), text), "Retain": (True, boolean),
        "EnabledState": (_text("Enabled"), text), "EnabledState/Id": (True, boolean),
        "Quality": (ua.StatusCode(GOOD), ua.VariantType.StatusCode), "LastSeverity": (MEDIUM, ua.VariantType.UInt16),
        "Comment": (_text(""), text), "ClientUserId": ("", STRING),
        **_dialog_state(active=True),
        "Prompt": (_text(prompt(shown)), text), "ResponseOptionSet": ([_text("approve"), _text("reject")], text),
        **{f"{name}Response": (NOTHING, number) for name in ("Default", "Ok", "Cancel", "Last")},
    }  # fmt: skip


def _dialog_state(active: bool) -> dict[str, tuple[Any, Any]]:
    said = _text("Active" if active else "Inactive")
    return {"DialogState": (said, ua.VariantType.LocalizedText), "DialogState/Id": (active, BOOLEAN)}


def _set(event: Any, values: dict[str, tuple[Any, Any]], now: datetime) -> None:
    """What has a time of its own gets it."""
    for name, (value, kind) in values.items():
        event.add_property(name, value, kind)
        if name in ("Quality", "LastSeverity", "Comment"):
            event.add_property(f"{name}/SourceTimestamp", now, ua.VariantType.DateTime)


def prompt(shown: ProposalShown) -> str:
    """The question, and what the gateway has computed of the answer; nothing that its author says of itself."""
    findings = [] if shown.verdict is None else shown.verdict.findings
    return "\n".join(
        [
            QUESTIONS[shown.proposal.kind],
            *shown.difference,
            f"{sum(one.passed for one in findings)} of {len(findings)} rules of the gate pass.",
            *([f"It takes {shown.approvals} different people."] if shown.approvals > 1 else []),
            f"It can be decided on until {shown.proposal.expires}.",
            f"All of it: {PROPOSALS}.{shown.proposal_hash}",
        ]
    )


def _text(said: str) -> Any:
    return ua.LocalizedText(said, "en")
