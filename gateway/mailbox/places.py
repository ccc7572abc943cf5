"""The places at a door where requests are answered: of each peer and topic some, and stop and hold have their own.

What hangs (a store on a disk that does not answer) fills the places of its own topic alone, and those of a stop, or of
a hold, nothing fills but more of the same. Each place is free again when the time of its topic is over, whatever has
become of who stands there.
"""

import json

from gateway.core.topics import GATEWAY_COMMAND, GATEWAY_FOR_PERSON, LOOP_COMMAND, SAFE_S, Topic
from gateway.mailbox.rights import OVERTAKES

MAX_IN_FLIGHT = 32  #: requests of one peer on one topic that are answered at the same time
MAX_SAFE = 8  #: stops of one peer that are, and holds
MAX_OVERDUE = 256  #: of a topic that acts: past their time and not at their end; then no more of it is taken
LONGEST_SAFE = 1024  #: bytes: a name and a certificate beside the command

_CARRY_COMMANDS = frozenset((LOOP_COMMAND.name, GATEWAY_COMMAND.name, GATEWAY_FOR_PERSON.name))


def safe_command(topic: str, payload: bytes) -> str:
    """The name of the stop or hold that a request is; empty: it is something else.

    Whether it may be said is for the handler; what is none in spite of its name is refused there, at once.
    """
    if topic not in _CARRY_COMMANDS or len(payload) > LONGEST_SAFE or not any(one in payload for one in _NAMES):
        return ""
    try:
        document = json.loads(payload)
    except (ValueError, RecursionError):
        return ""
    said = document.get("said", document) if isinstance(document, dict) else None
    command = said.get("command") if isinstance(said, dict) else None
    return command if isinstance(command, str) and command in OVERTAKES else ""


def most_at_once(safe: str) -> int:
    """Places of one peer, of a topic or of what `safe_command` found."""
    return MAX_SAFE if safe else MAX_IN_FLIGHT


def within_s(topic: Topic, safe: str) -> float:
    """For how long a request may stand at its place."""
    return SAFE_S if safe else topic.within_s


_NAMES = tuple(f'"{name}"'.encode() for name in OVERTAKES)
