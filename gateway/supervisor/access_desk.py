"""Who came in, who did not, and who may: what the operator's process tells of its door, as records of the audit."""

from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from pydantic import ValidationError

from gateway.core.access import AT_THE_DOOR, CameIn, UsersNow, WrongLogins
from gateway.core.audit_record import Who
from gateway.core.messages import Reply
from gateway.core.people import Role
from gateway.core.topics import GATEWAY_ACCESS
from gateway.mailbox.port import PEER, Mailbox
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.bounded import Bounded, with_left_out
from gateway.supervisor.peers import who_is, who_of
from gateway.supervisor.proposal_records import done, refused

WRONG = "wrong logins"  #: by which all reports of them count together
CHANGED = "users"  #: and all changes of users
COUNTED = "counted"  #: what is answered where the number alone will be on record


class AccessDesk:
    """A handler on a mailbox. What it was told it says again where it could not be recorded."""

    def __init__(
        self,
        mailbox: Mailbox,
        note: Callable[[str, Who, Mapping[str, Any]], Awaitable[object]],
        clock: Callable[[], float],
    ) -> None:
        """`note` appends a record to the audit; raises AuditUnavailable."""
        self._note = note
        self._bounded = Bounded(clock)
        self._users: UsersNow | None = None  #: as they are on record since this process began
        self._newest: UsersNow | None = None  #: as they are, on record or not
        self._untold = 0  #: who came in and was never told of, until a record says how many
        mailbox.serve(GATEWAY_ACCESS, self._answer)

    def roles(self) -> Mapping[str, Role] | None:
        """Of the people who may come in, as they were told last; None: not yet."""
        return None if self._newest is None else self._newest.roles

    async def _answer(self, payload: bytes) -> bytes:
        try:
            happened = AT_THE_DOOR.validate_json(payload)
        except ValidationError as error:
            reasons = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
            return refused("not understood", reasons[:20]).model_dump_json().encode()
        return (await self._record(happened)).model_dump_json().encode()

    async def _record(self, happened: CameIn | WrongLogins | UsersNow) -> Reply:
        peer = await who_of(PEER.get())
        if isinstance(happened, CameIn):
            who = who_is(happened.person, PEER.get())
            return await self._came_in(happened, who)
        if isinstance(happened, WrongLogins):
            return await self._kept("wrong-logins", peer, happened.model_dump(exclude={"happened"}), WRONG)
        self._newest = happened
        if happened == self._users:
            return done("known")
        before = None if self._users is None else self._users.roles
        what = {**happened.model_dump(exclude={"happened"}), "changes": _changes(before, happened.roles)}
        reply = await self._kept("users", peer, what, CHANGED)
        if reply.ok:
            self._users = happened
        return reply

    async def _came_in(self, happened: CameIn, who: Who) -> Reply:
        untold = self._untold + happened.before
        what: dict[str, object] = {"address": happened.address} | ({"untold": untold} if untold else {})
        reply = await self._kept("logged-in", who, what, who.name)
        if reply.ok:
            self._untold = untold if reply.text == COUNTED else 0
        return reply

    async def _kept(self, kind: str, who: Who, what: dict[str, object], name: str) -> Reply:
        if (left_out := self._bounded.left_out(name)) is None:
            # Users are told again until they are on record; of what else comes too often the number is.
            return refused("later", []) if name == CHANGED else done(COUNTED)
        try:
            await self._note(kind, who, what if name == CHANGED else with_left_out(what, left_out))
        except AuditUnavailable as error:
            self._bounded.undo(name, left_out)  # it is told again
            return refused("not recorded", [str(error)])
        return done("recorded")


def _changes(before: Mapping[str, Role] | None, now: Mapping[str, Role]) -> list[str]:
    """In words; empty: what was before is not known."""
    if before is None:
        return []
    new = [f"{name} is new as {role}" for name, role in now.items() if name not in before]
    gone = [f"{name} is gone" for name in before if name not in now]
    other = [
        f"{name} is {role} instead of {before[name]}"
        for name, role in now.items() if before.get(name, role) != role
    ]  # fmt: skip
    return sorted([*new, *gone, *other]) or ["the file is another, with the same names and roles"]
