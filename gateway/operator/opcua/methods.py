"""What people may have done: methods of the line. Each asks who calls, and says it to the gateway in their name.

The gateway holds it against the same table of roles again. What is refused for what it says is an answer (`ok` is
false, and a sentence); who may not call at all gets BadUserAccessDenied.
"""

import re
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from asyncua import ua as asyncua_ua
from asyncua.server.server import Server
from pydantic import ValidationError

from gateway.core.alarms import AcknowledgeAlarm, ShelveAlarm
from gateway.core.decisions import Archive, Confirm, Decide, LineChanged, RollBackNow
from gateway.core.messages import Arm, Hold, Reply, SelectRecipe, SetSpeed, SetTension, Start, Stop
from gateway.core.people import Person, Said, why_may_not
from gateway.operator.line_side import LineSide, NotTold
from gateway.operator.opcua.line_nodes import ROOT
from gateway.operator.opcua.session import CALLER
from gateway.operator.opcua.space import BOOLEAN, DOUBLE, STRING, UINT32, Space

REFUSED_S = 60.0  #: between two refusals of a person's command that the gateway is told of

_WHOLE = re.compile("[0-9a-f]{64}")  #: id of a proposal; else it is the begin of one

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

#: What comes of Variants: the gateway's reply, or asyncua's result of a call that was none.
Asked = Callable[..., Awaitable[Any]]


class NotSent(Exception):
    """Refused here, before anything is sent; the text is for the caller."""


@dataclass(frozen=True)
class Input:
    name: str
    kind: Any  #: of the variant
    tells: str


@dataclass(frozen=True)
class Method:
    name: str
    command: str  #: by which the table of roles knows it
    tells: str
    inputs: tuple[Input, ...]
    make: Callable[..., Awaitable[Said]]  #: of the line's side, then of the arguments. Raises NotSent.


async def _decide(line: LineSide, id: str, hash: str, base_revision: int, approve: bool, comment: str) -> Said:
    """Whether it holds is for the gateway to say, which has on record what it refuses."""
    if not _WHOLE.fullmatch(id):
        try:
            id = (await line.shown(id)).proposal_hash
        except (NotTold, ValidationError) as error:
            raise NotSent(f"the proposal cannot be looked up: {_first(error)}") from error
    return Decide(proposal=id, shown=hash, revision=base_revision, approve=approve, comment=comment)


async def _acknowledge(_line: LineSide, name: str, since: str, comment: str) -> Said:
    try:
        when = datetime.fromisoformat(since)
    except ValueError:
        when = None
    if when is None or when.tzinfo is None:
        raise NotSent(f"since is {since[:40]!r}; allowed: Since of the alarm, as it was shown")
    return AcknowledgeAlarm(alarm=name, since_wall_s=when.timestamp(), comment=comment)


def _plain(make: Callable[..., Said]) -> Callable[..., Awaitable[Said]]:
    async def made(_line: LineSide, *arguments: Any) -> Said:
        return make(*arguments)

    return made


_COMMENT = Input("comment", STRING, "For the audit; may be empty")
_WHY = Input("comment", STRING, "Why, for the audit; not empty")
_ALARM = Input("name", STRING, "Of the alarm")
METHODS = (
    Method("Decide", "decide", "Approve or reject a proposal, as it was shown", (
        Input("id", STRING, "Of the proposal"), Input("hash", STRING, "ShownHash of what was looked at"),
        Input("base_revision", UINT32, "BaseRevision of what was looked at"),
        Input("approve", BOOLEAN, "False: reject"), _COMMENT), _decide),
    Method("Rollback", "roll-back", "Back to the last known good configuration, at once", (_COMMENT,),
           _plain(lambda comment: RollBackNow(comment=comment))),
    Method("Arm", "arm", "Prove limits, PLC and watchdogs; zero torque", (), _plain(Arm)),
    Method("Start", "start", "Tension the web and run; from HOLD: go on", (), _plain(Start)),
    Method("Hold", "hold", "Speed to standstill, tension stays on", (), _plain(Hold)),
    Method("Stop", "stop", "Controlled stop, then torque off", (), _plain(Stop)),
    Method("SetTension", "set", "A tension set-point, ramped", (
        Input("span", UINT32, "Number"), Input("newton", DOUBLE, "N")),
           _plain(lambda span, newton: SetTension(span=span, tension_n=newton))),
    Method("SetSpeed", "speed", "The line's speed set-point, ramped", (Input("speed", DOUBLE, "m/s"),),
           _plain(lambda speed: SetSpeed(speed_m_per_s=speed))),
    Method("SelectRecipe", "recipe", "All set-points of a recipe, ramped", (Input("name", STRING, "As in Recipes"),),
           _plain(lambda name: SelectRecipe(name=name))),
    Method("AcknowledgeAlarm", "acknowledge", "A person has seen it", (
        _ALARM, Input("since", STRING, "Since of what was looked at: it may have come again"), _COMMENT), _acknowledge),
    Method("ShelveAlarm", "shelve", "Out of the way for a while; it comes back by itself", (
        _ALARM, Input("minutes", DOUBLE, "0: back at once"), _WHY),
           _plain(lambda name, minutes, why: ShelveAlarm(alarm=name, for_s=60.0 * minutes, because=why))),
    Method("Archive", "archive", "Keep a stored configuration under a name; puts nothing into service", (
        Input("configuration", STRING, "Its version, its name, or its hash or the beginning of it"),
        Input("name", STRING, "As phi_stable, by which later changes are measured"), _WHY),
           _plain(lambda which, name, why: Archive(configuration=which, name=name, because=why))),
    Method("LineChanged", "line-changed", "Another web, a new part: what was learned counts no more", (_WHY,),
           _plain(lambda why: LineChanged(because=why))),
    Method("Confirm", "confirm", "Answer for a first configuration that has shown a move and a change of speed", (
        Input("configuration", STRING, "The whole hash of what is in service"), _WHY),
           _plain(lambda which, why: Confirm(configuration=which, because=why))),
)  # fmt: skip


class _Refusals:
    """What people may not do is handed on now and then: the audit is not for them to fill."""

    def __init__(self) -> None:
        self._next_s: dict[tuple[str, str], float] = {}  #: by person and command; both are few

    def is_due(self, name: str, command: str) -> bool:
        now_s = time.monotonic()
        if now_s < self._next_s.get((name, command), now_s):
            return False
        self._next_s[name, command] = now_s + REFUSED_S
        return True


async def make_methods(server: Server, space: Space, line: LineSide) -> Mapping[str, Asked]:
    """Returns what each does, by its name."""
    root = server.get_node(space.id(ROOT))
    refusals = _Refusals()
    made: dict[str, Asked] = {}
    answers = [argument("ok", BOOLEAN, "It was done"), argument("sentence", STRING, "What was done, or why not")]
    for method in METHODS:
        inputs = [argument(one.name, one.kind, one.tells) for one in method.inputs]
        name = ua.QualifiedName(method.name, space.namespace)
        node_id = space.id(f"{ROOT}.{method.name}")
        made[method.name] = _asked(method, line, refusals)
        node = await root.add_method(node_id, name, _callback(made[method.name]), inputs, answers)
        described = ua.DataValue(ua.Variant(ua.LocalizedText(method.tells), ua.VariantType.LocalizedText))
        await server.write_attribute_value(node.nodeid, described, ua.AttributeIds.Description)
    return made


def _callback(asked: Asked) -> Callable[..., Awaitable[Any]]:
    async def called(_parent: Any, *arguments: Any) -> Any:
        reply = await asked(*arguments)
        if not isinstance(reply, Reply):
            return reply
        return [ua.Variant(reply.ok, BOOLEAN), ua.Variant(_sentence(reply), STRING)]

    return called


def _asked(method: Method, line: LineSide, refusals: _Refusals) -> Asked:
    async def asked(*arguments: Any) -> Any:
        person = CALLER.get()
        if person is None:
            return _result(ua.StatusCodes.BadUserAccessDenied)
        if why_may_not(person, method.command):
            if not wrong(method.inputs, arguments) and refusals.is_due(person.name, method.command):
                # The gateway refuses it as well, and its audit has to know that it was tried.
                await _said(method, line, person, [_value(one) for one in arguments])
            return _result(ua.StatusCodes.BadUserAccessDenied)
        if result := wrong(method.inputs, arguments):
            return result
        return await _said(method, line, person, [_value(one) for one in arguments])

    return asked


async def _said(method: Method, line: LineSide, person: Person, values: Sequence[Any]) -> Reply:
    try:
        said = await method.make(line, *values)
    except (NotSent, ValidationError) as error:
        return Reply(ok=False, state="", text=_first(error))
    return await line.say(person, said)


def _first(error: Exception) -> str:
    """In a sentence."""
    if not isinstance(error, ValidationError):
        return str(error)
    reasons = (f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()[:3])
    return f"nothing was sent: {'; '.join(reasons)}"


def _sentence(reply: Reply) -> str:
    return "; ".join([reply.text, *(reason for reason in reply.reasons if reason not in reply.text)])


def wrong(inputs: Sequence[Input], arguments: Sequence[Any]) -> Any:
    """The result of a call that cannot be one; None: it can."""
    if len(arguments) < len(inputs):
        return _result(ua.StatusCodes.BadArgumentsMissing)
    if len(arguments) > len(inputs):
        return _result(ua.StatusCodes.BadTooManyArguments)
    codes = [_code(one, argument) for one, argument in zip(inputs, arguments, strict=True)]
    if all(code == ua.StatusCodes.Good for code in codes):
        return None
    result = _result(ua.StatusCodes.BadInvalidArgument)
    result.InputArgumentResults = [ua.StatusCode(code) for code in codes]
    return result


def _code(wanted: Input, argument: Any) -> int:
    no_text = wanted.kind is STRING and argument.Value is None  #: which stands for an empty one
    if argument.VariantType is not wanted.kind or argument.is_array or (argument.Value is None and not no_text):
        return ua.StatusCodes.BadTypeMismatch
    return ua.StatusCodes.Good


def _value(argument: Any) -> Any:
    return "" if argument.Value is None else argument.Value


def _result(code: int) -> Any:
    return ua.CallMethodResult(StatusCode=ua.StatusCode(code))


def argument(name: str, kind: Any, tells: str) -> Any:
    return ua.Argument(
        Name=name, DataType=ua.NodeId(kind.value), ValueRank=-1, ArrayDimensions=[],
        Description=ua.LocalizedText(tells),
    )  # fmt: skip
