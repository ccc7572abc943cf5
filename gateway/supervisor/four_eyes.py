"""Who approved first, where a change takes two: another person than the first. Pure.

People who came in through OPC UA or the page are told apart by name, local users by the number that the kernel tells.
A script is the user that runs it. A person and a local user of the same name are taken to be the same. The user that
the gateway runs as, and root, are no people: whoever may be one of these may be both.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gateway.core.audit_record import Who
from gateway.core.people import SCRIPTS, Role, may

APPROVED_ONCE = "approved-once"  #: the kind of its record
_PERSON = re.compile(r"([a-z][a-z0-9._-]{0,31}) \([a-z]+, [a-z-]+\)")  # as `who_is` writes it


@dataclass(frozen=True)
class FirstApproval:
    name: str
    approver: tuple[str, ...]  #: as `approver_of`
    shown: str  #: what they have seen: another one is not approved by it
    by: str  #: person or script


def approver_of(who: Who) -> tuple[str, ...]:
    """All by which somebody is told apart from others; of whoever came straight from the mailbox, not of a script."""
    if (person := _PERSON.fullmatch(who.name)) is not None:  # user and process are those of the operator's process
        return (person[1],)
    return (who.name.casefold(),) if who.uid is None else (who.name.casefold(), f"uid {who.uid}")


def why_no_person(who: Who, own_uid: int) -> str:
    """Empty: it is somebody in particular. `own_uid`: as which user the gateway runs."""
    if (person := _PERSON.fullmatch(who.name)) is not None:
        nobody = person[1].startswith(SCRIPTS)  # a program, run by nobody knows whom
    else:
        nobody = who.uid in (0, own_uid)
    if not nobody:
        return ""
    return (
        f"{who.name} is no person, and this line takes two: approve it on the page, or through OPC UA, as a user of "
        "`r2rgate users`"
    )


def still_counts(first: FirstApproval, own_uid: int, roles: Mapping[str, Role] | None) -> bool:
    """Whether a first approval that is on record is that of somebody who may approve now.

    `roles`: of the people who may come in; None: not known yet.
    """
    if uids := [one for one in first.approver if one.startswith("uid ")]:
        return not {"uid 0", f"uid {own_uid}"} & set(uids)
    return not any(
        name.startswith(SCRIPTS) or (roles is not None and (name not in roles or not may(roles[name], "decide")))
        for name in first.approver
    )


def first_of(what: Mapping[str, Any]) -> FirstApproval:
    """Out of its record."""
    approver = tuple(map(str, what["approver"]))
    return FirstApproval(str(what["name"]), approver, str(what["shown"]), str(what["by"]))


def why_not_second(first: FirstApproval, approver: tuple[str, ...]) -> str:
    """Empty: it is somebody else."""
    if not set(first.approver) & set(approver):
        return ""
    return f"{first.name} has approved it already: this line takes two different people, and you are the same one"
