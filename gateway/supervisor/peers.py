"""Who asks, in the words of the audit."""

import pwd

from gateway.core.audit_record import Who
from gateway.core.people import Person
from gateway.mailbox.port import Peer

GATEWAY = Who(name="gateway")


def who_of(peer: Peer | None) -> Who:
    """As the kernel says; this process, where nobody else can be."""
    if peer is None:
        return GATEWAY
    try:
        name = pwd.getpwuid(peer.uid).pw_name
    except KeyError:
        name = f"user {peer.uid}"
    return Who(name=name, uid=peer.uid, pid=peer.pid)


def who_is(person: Person, peer: Peer | None) -> Who:
    """A person, let in by the process that says so: user and process number are of that one."""
    return Who(
        name=f"{person.name} ({person.role}, {person.through})", uid=None if peer is None else peer.uid,
        pid=None if peer is None else peer.pid, certificate=person.certificate,
    )  # fmt: skip
