"""Who may say what to the loop: the one table. What has no row here nobody may say.

A peer is known by what it proves, never by a name that it says: the gateway by the signature of its key
(`gateway.mailbox.seal`), everybody else as a local process of the user who may open the socket, as the kernel tells it.
"""

from enum import StrEnum


class Speaker(StrEnum):
    """Who may say a command, and with what."""

    ANYBODY = "any local process"  #: without proof, also while the gateway is gone
    GATEWAY = "the gateway"  #: signed, of this line and this start of the loop, once


TO_LOOP: dict[str, Speaker] = {
    # What takes the line to the safe side, and what changes nothing.
    "stop": Speaker.ANYBODY,
    "hold": Speaker.ANYBODY,
    "configuration": Speaker.ANYBODY,
    # A person's commands: the gateway notes who gave them.
    "arm": Speaker.GATEWAY,
    "start": Speaker.GATEWAY,
    "prove": Speaker.GATEWAY,
    "drill": Speaker.GATEWAY,
    "keep-proof": Speaker.GATEWAY,
    "set": Speaker.GATEWAY,
    "speed": Speaker.GATEWAY,
    "recipe": Speaker.GATEWAY,
    "experiment-abort": Speaker.GATEWAY,
    # What changes how the line is controlled: judged, approved, on record.
    "experiment": Speaker.GATEWAY,
    "deploy": Speaker.GATEWAY,
    "renew": Speaker.GATEWAY,
    "keep": Speaker.GATEWAY,
    "watch-good": Speaker.GATEWAY,
    "narrow": Speaker.GATEWAY,
    "confirmed": Speaker.GATEWAY,
    # To what is known to be good; a gateway that is gone renews no lease, and the loop goes back by itself.
    "rollback": Speaker.GATEWAY,
}

#: What sets the line in motion, or readies it: signed before a stop or a hold, it counts no more after it; and it is
#: stale soon (`seal.MOTION_STALE_S`).
OVERTAKEN = frozenset(("arm", "start", "prove", "drill", "set", "speed", "recipe", "experiment"))
OVERTAKES = frozenset(("stop", "hold"))


def may_be_said_by_anybody(command: str) -> bool:
    """Whether the loop takes it without a proof."""
    return TO_LOOP.get(command) is Speaker.ANYBODY
