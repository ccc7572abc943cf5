"""Who asks, in the words of the audit.

The name of a user may come from a directory on another machine, which may be away: it is looked up in a thread, once,
and what stops the line does not wait for it.
"""

import asyncio
import os
import pwd
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from gateway.core.audit_record import Who
from gateway.core.people import Person
from gateway.mailbox.port import Peer
from gateway.tasks.threads import Worker

P = ParamSpec("P")
T = TypeVar("T")

GATEWAY = Who(name="gateway")
LOOKED_UP_S = 2.0  #: for a directory of users to answer; then the number stands for the name

_names: dict[int, str] = {}  #: by user, as they were looked up
_directory = Worker("users")


async def in_directory(work: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
    """What asks for users, in the thread for it. Raises TimeoutError where they are not told in time."""
    async with asyncio.timeout(LOOKED_UP_S):
        return await _directory.do(work, *arguments, **named)


async def know_users() -> None:
    """Look up those who may open the gateway's socket, so that their names are at hand when they ask."""
    for uid in {os.geteuid(), 0}:
        await who_of(Peer(uid, 0))


async def who_of(peer: Peer | None) -> Who:
    """As the kernel says; this process, where nobody else can be."""
    if peer is not None and peer.uid not in _names:
        try:
            await in_directory(_look_up, peer.uid)
        except TimeoutError:
            pass
    return who_at_once(peer)


def who_at_once(peer: Peer | None) -> Who:
    """As `who_of`; a name that was not looked up yet is not waited for."""
    if peer is None:
        return GATEWAY
    return Who(name=_names.get(peer.uid, f"user {peer.uid}"), uid=peer.uid, pid=peer.pid)


def who_is(person: Person, peer: Peer | None) -> Who:
    """A person, let in by the process that says so: user and process number are of that one."""
    return Who(
        name=f"{person.name} ({person.role}, {person.through})", uid=None if peer is None else peer.uid,
        pid=None if peer is None else peer.pid, certificate=person.certificate,
    )  # fmt: skip


def _look_up(uid: int) -> None:
    try:
        _names[uid] = pwd.getpwuid(uid).pw_name
    except KeyError:
        pass  # it has no name, or the directory is away: looked up again when it asks again
