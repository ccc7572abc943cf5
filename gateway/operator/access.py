"""What happens at the door, told to the gateway for its audit: who came in, from where others tried, who the users are.

Nothing here lets anybody in or keeps them out. What cannot be told now is told later; of wrong logins the number is.
"""

import asyncio
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from gateway.core.access import MOST_NAMES, MOST_PLACES, CameIn, UsersNow, WrongLogins, WrongPlace
from gateway.core.people import Person, Role
from gateway.operator.line_side import LineSide
from gateway.operator.places import place_of
from gateway.operator.users import Users, UsersFile, UsersRefused
from gateway.tasks.supervisor import Supervisor, TaskFault

LOOK_S = 1.0  #: between two looks at the users' file, and at what there is to tell
REPORT_S = 60.0  #: between two reports of wrong logins, and after which the users are told again
READ_S = 1.0  #: that the users' file may take to be read, before it is told that it does not come
MOST_WAITING = 100  #: who came in while the gateway was away
LONGEST_ADDRESS = 64

Through = Literal["opc-ua", "page"]


@dataclass
class _Wrong:
    count: int = 0
    users: set[str] = field(default_factory=set[str])


class Access:
    """`run` as a task; the others from the same event loop."""

    def __init__(
        self, side: LineSide, users: UsersFile, tell: Callable[[str], None], clock: Callable[[], float]
    ) -> None:
        self._side = side
        self._users = users
        self._tell = tell
        self._supervisor = Supervisor(self._tell_fault)
        self._clock = clock
        self._came: deque[CameIn] = deque(maxlen=MOST_WAITING)
        self._dropped = 0  #: of them, because too many waited
        self._wrong: OrderedDict[tuple[Through, str, str | None], _Wrong] = OrderedDict()
        self._elsewhere = 0
        self._reported_s = clock()
        self._told: UsersNow | None = None
        self._told_s = clock()
        self._trouble = ""  #: of the users' file, as it was told
        self._reading: asyncio.Task[Users] | None = None  #: on its way; a disk may never answer

    def came_in(self, person: Person, address: str) -> None:
        self._dropped += len(self._came) == MOST_WAITING
        self._came.append(CameIn(person=person, address=address[:LONGEST_ADDRESS]))

    def refused(self, through: Through, address: str, certificate: str | None, name: str) -> None:
        """Name and password that let nobody in."""
        key = through, place_of(address)[:LONGEST_ADDRESS], certificate
        if key not in self._wrong and len(self._wrong) >= MOST_PLACES:
            self._elsewhere += 1
            return
        wrong = self._wrong.setdefault(key, _Wrong())
        wrong.count += 1
        # What is no user's name may be a password in the wrong field: it is written nowhere.
        if len(wrong.users) < MOST_NAMES and self._users.role_of(name) is not None:
            wrong.users.add(name)

    async def run(self) -> None:
        """Until it is cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._supervisor.repeat("looking at the users' file", self.renew, LOOK_S))
            group.create_task(
                self._supervisor.repeat("telling who came in", self._tell_all, LOOK_S)
            )  # may wait for the gateway; who may stop the line must not

    def _tell_fault(self, fault: TaskFault, error: BaseException | None) -> None:
        said = "works again" if error is None else f"failed, and goes on: {fault.error}: {fault.text}"
        self._tell(f"{fault.task} {said}")

    async def look(self) -> None:
        """Look at the users' file, and tell what there is to tell."""
        await self.renew()
        await self._tell_all()

    async def _tell_all(self) -> None:
        if not self._trouble:
            await self._tell_users()
        while self._came:
            first, dropped = self._came[0], self._dropped
            if not await self._side.at_the_door(first.model_copy(update={"before": dropped})):
                break
            self._dropped -= dropped
            if self._came and self._came[0] is first:  # so many may have come meanwhile that it is gone
                self._came.popleft()
            elif self._dropped:
                self._dropped -= 1  # it is gone, and was told
        if self._wrong and self._clock() - self._reported_s >= REPORT_S:
            await self._report()

    async def renew(self) -> None:
        """Look at the users' file, in a thread: the event loop is what a stop goes through."""
        try:
            self._users.keep(await self._read())
        except UsersRefused as refused:
            if str(refused) != self._trouble:
                self._trouble = str(refused)
                self._tell(f"nobody can log in: {refused}")
        else:
            self._trouble = ""

    async def _read(self) -> Users:
        """Raises UsersRefused, also where it takes too long; what is on its way then is looked at the next time."""
        if self._reading is None:
            self._reading = asyncio.create_task(asyncio.to_thread(self._users.current))
        done, _ = await asyncio.wait([self._reading], timeout=READ_S)
        if not done:
            raise UsersRefused(f"{self._users.path} does not come: its disk does not answer")
        reading, self._reading = self._reading, None
        return reading.result()

    async def _tell_users(self) -> None:
        known = self._users.known
        roles: dict[str, Role] = {one.name: one.role for one in known.entries()}
        now = UsersNow(roles=roles, file=known.digest)
        if now == self._told and self._clock() - self._told_s < REPORT_S:
            return
        if await self._side.at_the_door(now):
            self._told, self._told_s = now, self._clock()

    async def _report(self) -> None:
        wrong, elsewhere = self._wrong, self._elsewhere
        places = [
            WrongPlace(through=through, address=address, certificate=certificate, count=one.count,
                       users=sorted(one.users))
            for (through, address, certificate), one in wrong.items()
        ]  # fmt: skip
        self._wrong, self._elsewhere, self._reported_s = OrderedDict(), 0, self._clock()
        if not await self._side.at_the_door(WrongLogins(places=places, elsewhere=elsewhere)):
            self._take_back(wrong, elsewhere)

    def _take_back(self, wrong: OrderedDict[tuple[Through, str, str | None], _Wrong], elsewhere: int) -> None:
        """What could not be told stays, with what came meanwhile."""
        for key, one in self._wrong.items():
            if key in wrong or len(wrong) < MOST_PLACES:
                before = wrong.setdefault(key, _Wrong())
                before.count += one.count
                before.users = set(sorted(before.users | one.users)[:MOST_NAMES])
            else:
                elsewhere += one.count
        self._wrong, self._elsewhere = wrong, self._elsewhere + elsewhere
