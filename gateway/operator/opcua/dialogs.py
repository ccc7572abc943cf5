"""What waits for a person as dialogs (OPC 10000-9, DialogConditionType), for clients that have a window for them.

A dialog is of exactly one proposal as it is shown: its NodeId, which clients hand back with `Respond`, names the
proposal, the revision and the shown hash. What is shown anew is another dialog, so that an answer never counts for what
was not looked at. `Respond` is `Decide` of these three, asked and refused in the same way.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from asyncua import ua as asyncua_ua
from asyncua.common.event_objects import DialogCondition
from asyncua.server.event_generator import EventGenerator

from gateway.core.decisions import ProposalShown
from gateway.operator.opcua.events import MEDIUM
from gateway.operator.opcua.instances import Declared, declared, make, make_object
from gateway.operator.opcua.line_nodes import ROOT
from gateway.operator.opcua.methods import Called
from gateway.operator.opcua.proposal_nodes import FOLDER as PROPOSALS
from gateway.operator.opcua.session import OWNS
from gateway.operator.opcua.space import BOOLEAN, GOOD, STRING, UINT32, Space

FOLDER = f"{ROOT}.Dialogs"
APPROVE, REJECT = 0, 1  #: as `Respond` has them
NOTHING = -1  #: no option is chosen by pressing Return, or by closing the window
MOST_LINES = 12  #: of what would change, in a prompt
QUESTIONS = {
    "gains": "Put this controller into service?",
    "experiment": "Run this experiment?",
    "model": "Judge by this model from now on?",
}  #: by the kind of a proposal

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ


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
    def __init__(self, space: Space, decide: Called) -> None:
        """`decide`: the line's method of that name."""
        self._space = space
        self._decide = decide
        self._rows: list[Declared] = []
        self._open: dict[str, _Dialog] = {}  #: by path

    async def make(self) -> None:
        server = self._space.server
        await self._space.object(FOLDER, ROOT, "What waits for a person, as dialogs; the same as in Proposals")
        self._rows = await declared(server, ua.NodeId(ua.ObjectIds.DialogConditionType), ())
        session = server.iserver.isession
        self._ends = [EventGenerator(session), EventGenerator(session)]
        for emits, kind in zip(self._ends, ("RefreshStartEventType", "RefreshEndEventType"), strict=True):
            await emits.init(getattr(ua.ObjectIds, kind), add_generates_event=False)
        for number, called in (
            (ua.ObjectIds.DialogConditionType_Respond, self._respond),
            (ua.ObjectIds.ConditionType_ConditionRefresh, self._refresh),
            (ua.ObjectIds.ConditionType_ConditionRefresh2, self._refresh),
        ):
            session.add_method_callback(ua.NodeId(number), called)

    async def show(self, waiting: Sequence[ProposalShown]) -> None:
        """Those that wait, as they are shown now: others end."""
        wanted = {_path(one): one for one in waiting}
        for path in [path for path in self._open if path not in wanted]:
            await self._end(path)
        for path in reversed([path for path in wanted if path not in self._open]):
            await self._begin(path, wanted[path])
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
        await make(self._space, path, self._rows, {})
        await self._space.server.get_node(self._space.id(path)).add_method(
            self._space.id(f"{path}.Respond"), ua.QualifiedName("Respond", 0), self._respond, [_selected()], []
        )
        event: Any = DialogCondition(self._space.id(PROPOSALS), severity=MEDIUM)
        event.add_property("NodeId", self._space.id(path), ua.VariantType.NodeId)  # the ConditionId, for Respond
        _set(event, _first_state(shown), now)
        emits = EventGenerator(self._space.server.iserver.isession)
        await emits.init(event, add_generates_event=False)
        self._open[path] = _Dialog(path, shown.proposal_hash, shown.shown or "", shown.epoch, emits)
        await self._tell(self._open[path], f"a proposal waits for a person: {shown.proposal_hash[:12]}")

    async def _end(self, path: str) -> None:
        one = self._open.pop(path)
        _set(one.event, {"Retain": (False, BOOLEAN)} | _dialog_state(active=False), datetime.now(UTC))
        await self._tell(one, f"it waits no more, or is shown anew: {one.proposal[:12]}")
        await self._space.remove(path)

    async def _tell(self, one: _Dialog, message: str) -> None:
        """Its nodes first: who hears of it may look at them at once."""
        one.event.Message = ua.LocalizedText(message, "en")
        for row in self._rows:
            name = row.path.replace(".", "/")
            kind = one.event.data_types.get(name)
            if row.node_class == ua.NodeClass.Variable and kind is not None:
                value = ua.DataValue(ua.Variant(getattr(one.event, name), kind))
                await self._space.server.write_attribute_value(self._space.id(f"{one.path}.{row.path}"), value)
        await one.emits.trigger(message=message)

    async def _respond(self, parent: Any, *arguments: Any) -> Any:
        one = self._open.get(parent.Identifier) if parent.NamespaceIndex == self._space.namespace else None
        if one is None:
            return ua.StatusCode(ua.StatusCodes.BadDialogNotActive)
        if len(arguments) != 1 or arguments[0].VariantType is not ua.VariantType.Int32 or arguments[0].is_array:
            return ua.StatusCode(ua.StatusCodes.BadInvalidArgument)
        if arguments[0].Value not in (APPROVE, REJECT):
            return ua.StatusCode(ua.StatusCodes.BadDialogResponseInvalid)
        answer = await self._decide(
            parent, ua.Variant(one.proposal, STRING), ua.Variant(one.shown, STRING), ua.Variant(one.revision, UINT32),
            ua.Variant(arguments[0].Value == APPROVE, BOOLEAN), ua.Variant("", STRING),
        )  # fmt: skip
        if isinstance(answer, ua.CallMethodResult):
            return answer.StatusCode
        if not answer[0].Value:
            return ua.StatusCode(ua.StatusCodes.BadInvalidState)  # `Respond` has no room for the sentence
        if one.path in self._open:
            _set(one.event, {"LastResponse": (arguments[0].Value, ua.VariantType.Int32)}, datetime.now(UTC))
            await self._tell(one, f"answered: {'approve' if arguments[0].Value == APPROVE else 'reject'}")
        return ua.StatusCode()

    async def _refresh(self, _parent: Any, *arguments: Any) -> Any:
        """ConditionRefresh of a subscription, ConditionRefresh2 of one of its items: all that waits, once more."""
        numbers = [one.Value for one in arguments]
        if not 1 <= len(numbers) <= 2 or not all(one.VariantType is UINT32 and not one.is_array for one in arguments):
            return ua.StatusCode(ua.StatusCodes.BadInvalidArgument)
        service = self._space.server.iserver.subscription_service
        held = service.subscriptions.get(numbers[0])
        if held is None or not OWNS.get()(numbers[0]):
            return ua.StatusCode(ua.StatusCodes.BadSubscriptionIdInvalid)
        item = numbers[1] if len(numbers) == 2 else None
        if item is not None and item not in held.monitored_item_srv._monitored_items:  # noqa: SLF001 (no other way)
            return ua.StatusCode(ua.StatusCodes.BadMonitoredItemIdInvalid)
        begins, ends = self._ends
        await begins.trigger(message="what waits, once more", subscription_id=numbers[0])
        for one in list(self._open.values()):
            await held.monitored_item_srv.trigger_event(one.event, item)
        await ends.trigger(message="that is all", subscription_id=numbers[0])
        return ua.StatusCode()


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
    lines = shown.difference[:MOST_LINES]
    more = len(shown.difference) - len(lines)
    findings = [] if shown.verdict is None else shown.verdict.findings
    return "\n".join(
        [
            QUESTIONS[shown.proposal.kind],
            *lines,
            *([f"and {more} more"] if more else []),
            f"{sum(one.passed for one in findings)} of {len(findings)} rules of the gate pass.",
            f"It can be decided on until {shown.proposal.expires}.",
            f"All of it: {PROPOSALS}.{shown.proposal_hash}",
        ]
    )


def _selected() -> Any:
    said = _text("Of ResponseOptionSet: 0 approves, 1 rejects")
    kind = ua.NodeId(ua.ObjectIds.Int32)
    return ua.Argument(Name="SelectedResponse", DataType=kind, ValueRank=-1, ArrayDimensions=[], Description=said)


def _text(said: str) -> Any:
    return ua.LocalizedText(said, "en")
