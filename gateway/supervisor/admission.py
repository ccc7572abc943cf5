"""Who may propose how much, and as whom: what the connection says of a caller, in the terms of `mailbox.inbox`."""

import pwd
from collections.abc import Collection
from typing import Final

from gateway.core.audit_record import Who
from gateway.core.finding import Finding, finding
from gateway.core.line import Line
from gateway.core.messages import Reply
from gateway.mailbox.inbox import Bounds, Caller
from gateway.wording.catalogue import sentence

OF_AGENT: Final = "agent "  #: the name of a caller on the agents' bus begins so
AGENTS: Final = "agents"
PARTS: Final = ("rules", AGENTS, "engineer")  #: authors that are a part played, not a person's name

#: A process: one proposal a second; all processes of its user together three, so that no flood of processes is more.
OF_PROCESS = (1.0, 1.0, 3.0, 6.0)
#: An agent: one in ten seconds, and in the long run thirty an hour. The list of proposals is a person's, and what the
#: phases know of their past.
OF_AGENTS = (0.1, 1.0, 30.0 / 3600.0, 5.0)


def caller_of(who: Who) -> Caller:
    """As the connection says: user and process, an agent by its key, or this process itself."""
    if who.uid is None:
        return Caller(who.name, "")
    return Caller(f"user {who.uid}", f"process {who.pid}")


def bounds_of(who: Who, line: Line) -> Bounds:
    """Of proposals of this caller."""
    rates = OF_AGENTS if _is_agent(who) else OF_PROCESS
    return Bounds(*rates, bytes=line.gate.proposal_max_bytes)


def why_not_author(author: str, who: Who, people: Collection[str]) -> Finding | None:
    """Why a proposal that says it is of `author` cannot come from this caller; None: it can.

    An agent proposes as "agents". A process of the machine proposes in a part that the line's file allows, or by the
    name of its own user, and never as somebody else: another user of the machine, one of `people` who come in through
    the page or OPC UA, an agent by name. A name in a message proves nobody.
    """
    if _is_agent(who):
        return None if author == AGENTS else _differs(author, who, AGENTS)
    if who.uid is None or author in PARTS or author == who.name:
        return None
    if author in people or author.startswith(OF_AGENT) or _is_other_user(author, who.uid):
        return _differs(author, who, ", ".join((who.name, *PARTS)))
    return None  # the judge holds it against gate.authors


def _differs(author: str, who: Who, allowed: str) -> Finding:
    return finding("inbox-author", author=author, connection=who.name, allowed=allowed)


def _is_other_user(name: str, uid: int) -> bool:
    try:
        return pwd.getpwnam(name).pw_uid != uid
    except KeyError:
        return False


def turned_away(found: Finding) -> Reply:
    """The refusal as an answer."""
    return Reply(ok=False, state="", text="it is not taken", reasons=[sentence(found)], findings=[found])


def _is_agent(who: Who) -> bool:
    return who.uid is None and who.name.startswith(OF_AGENT)
