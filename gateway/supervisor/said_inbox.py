"""What local processes say to the gateway, but for proposals: how much of it is taken of each, and how it is told.

Commands, decisions and words on alarms have the bounds that proposals have, with rates of their own: of each process,
and of all processes of a user together. What takes the line to the safe side is never held back: whoever hands it on
asks nothing here. A person's hand, and a script of one, stays far below; a flood is refused, and told now and then.
"""

from collections.abc import Callable
from typing import Final

from gateway.core.audit_record import Who
from gateway.core.messages import MAX_COMMAND, MAX_DEPLOYMENT, PACKED, MalformedMessage, Reply, parse_command
from gateway.mailbox.inbox import Bounds, RateLimiter, name_of
from gateway.mailbox.rights import OVERTAKES
from gateway.supervisor.admission import caller_of, turned_away
from gateway.supervisor.bounded import Bounded

COMMAND_EVENT: Final = "command"  #: kinds of events, of what was refused of each
DECISION_EVENT: Final = "decision"
ON_ALARMS_EVENT: Final = "said-of-alarms"
#: Kinds of events that any local process can cause: they have places of their own in the status, so that they put
#: none of the others out of it.
CAUSED_BY_ANYBODY: Final = frozenset(
    (COMMAND_EVENT, DECISION_EVENT, ON_ALARMS_EVENT, "proposal", "refused-at-the-door")
)

OF_COMMANDS = Bounds(20.0, 40.0, 40.0, 120.0, bytes=MAX_DEPLOYMENT)
#: Each may be a record of the audit.
OF_DECISIONS = Bounds(2.0, 20.0, 6.0, 40.0, bytes=MAX_DEPLOYMENT)
#: What the operator's process hands on of all people who come in.
OF_PEOPLE = Bounds(20.0, 100.0, 40.0, 200.0, bytes=MAX_DEPLOYMENT)


class SaidInbox:
    """Of one kind of message."""

    def __init__(self, kind: str, bounds: Bounds, clock: Callable[[], float], note: Callable[..., None]) -> None:
        """`note`: an event of the gateway: kind, text and data."""
        self._kind = kind
        self._bounds = bounds
        self._note = note
        self._rates = RateLimiter(clock)
        self._told = Bounded(clock)

    def refuse(self, who: Who, size: int) -> Reply | None:
        """Why what this caller says, of `size` bytes, is not taken. None: it is, and counted; this process always."""
        if who.uid is None:
            return None
        caller = caller_of(who)
        if (refusal := self._rates.refuse(caller, self._bounds, size)) is None:
            return None
        reply = turned_away(refusal)
        # By group, as of proposals: a flood of processes has no more to say than one of them.
        if (left_out := self._told.left_out(caller.group)) is not None:
            text = f"{name_of(caller)}: {reply.text}: {reply.reasons[0]}"
            self._note(self._kind, text, ok=False, left_out=left_out, findings=[refusal])
        return reply


def is_never_held_back(payload: bytes) -> bool:
    """Whether a command takes the line to the safe side."""
    return _name_of(payload) in OVERTAKES


def is_stop(payload: bytes) -> bool:
    return _name_of(payload) == "stop"


def _name_of(payload: bytes) -> str:
    """Of a short command; of any other nothing."""
    if len(payload) > MAX_COMMAND or payload[:1] == PACKED:  # packed: none of these is
        return ""
    try:
        return parse_command(payload).command
    except MalformedMessage:
        return ""
