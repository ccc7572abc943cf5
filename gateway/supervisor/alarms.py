"""The alarms of a line: looked at a few times a second, seen and shelved by people, each of that on record.

Nothing here acts on the line. What was acknowledged or shelved is kept in a file over a restart of the gateway; where
that is lost or damaged, alarms come again, which is the safe side.
"""

import asyncio
import os
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError

from gateway.core.alarms import (
    ALARM_SAID,
    ALARMS,
    BY_NAME,
    STOPPED,
    AcknowledgeAlarm,
    Alarm,
    AlarmName,
    AlarmSaid,
    AlarmStatus,
    ShelveAlarm,
)
from gateway.core.audit_record import Who
from gateway.core.line import Strict
from gateway.core.messages import Reply
from gateway.core.nearest import nearest
from gateway.core.status import GatewayStatus
from gateway.core.topics import GATEWAY_ALARM
from gateway.mailbox.port import PEER, Mailbox
from gateway.supervisor.alarm_conditions import Conditions
from gateway.supervisor.alarm_states import AlarmStates, Kept
from gateway.supervisor.audit import AuditState
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.peers import who_of
from gateway.supervisor.proposal_records import done, iso, refused
from gateway.supervisor.store import boot_id

FILE_NAME = "alarms.json"
MOST_BYTES = 65_536
SAME_S = 0.1  #: between two tellings of one beginning: the wall clock is being disciplined
_URGENCY = {"high": 0, "medium": 1, "low": 2}


class _File(Strict):
    """What was acknowledged or shelved when it was written."""

    format: Annotated[int, Field(ge=1, le=1)]
    acknowledged: dict[AlarmName, str]
    shelved_until_wall_s: dict[AlarmName, float]
    boot: str = ""  #: of the monotonic times; files of earlier versions do not say
    shelved_until_s: dict[AlarmName, float] = {}  #: monotonic


class Alarms:
    """`look` a few times a second, `status` for whoever asks, `say` for people. A handler on a mailbox."""

    def __init__(
        self,
        mailbox: Mailbox,
        folder: Path,
        append: Callable[[str, Who, Mapping[str, Any]], Awaitable[object]],
        note: Callable[[str, str], None],
        clock: Callable[[], float],
        wall_clock: Callable[[], float],
    ) -> None:
        """`append` stores a record of the audit and may raise AuditUnavailable; `note` is for the history."""
        self._path = folder / FILE_NAME
        self._append = append
        self._note = note
        self._clock = clock
        self._wall_clock = wall_clock
        self._boot = boot_id()
        self._conditions = Conditions()
        self._states = AlarmStates(clock(), self._read())
        self._written: _File | None = None
        self._writing = asyncio.Lock()
        mailbox.serve(GATEWAY_ALARM, self._answer)

    def look(self, status: GatewayStatus, audit: AuditState) -> None:
        for kind, text in self._states.look(self._conditions.look(status, audit), self._clock()):
            self._note(kind, text)

    def status(self) -> list[AlarmStatus]:
        """What needs a look first stands first: not shelved, not acknowledged, of high priority, new."""
        found = [self._status(alarm) for alarm in ALARMS if alarm.name in {*self._states.live, *self._states.shelved}]
        return sorted(
            found,
            key=lambda one: (
                one.shelved_until_wall_s is not None, one.acknowledged, _URGENCY[one.priority], -one.since_wall_s,
            ),
        )  # fmt: skip

    async def say(self, said: AlarmSaid, who: Who) -> Reply:
        """A person's word on an alarm."""
        if said.alarm not in BY_NAME:
            like = nearest(said.alarm, BY_NAME)
            hint = f"; did you mean {like}?" if like else ""
            return refused("there is no such alarm", [f"{said.alarm} is none; alarms are: {', '.join(BY_NAME)}{hint}"])
        reply = await (self._acknowledge(said, who) if isinstance(said, AcknowledgeAlarm) else self._shelve(said, who))
        return reply if not reply.ok else reply.model_copy(update={"text": f"{reply.text}{await self._keep()}"})

    async def _answer(self, payload: bytes) -> bytes:
        try:
            said = ALARM_SAID.validate_json(payload)
        except ValidationError as error:
            reasons = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
            return refused("not understood", reasons[:20]).model_dump_json().encode()
        return (await self.say(said, who_of(PEER.get()))).model_dump_json().encode()

    async def _acknowledge(self, said: AcknowledgeAlarm, who: Who) -> Reply:
        """Also where it cannot be recorded: that may be the alarm."""
        if reason := self._why_another(said):
            return refused("nothing is acknowledged", [reason])
        if reason := self._states.acknowledge(said.alarm, who.name):
            return refused("nothing is acknowledged", [reason])
        try:
            await self._append("acknowledged", who, {"alarm": said.alarm, "comment": said.comment})
        except AuditUnavailable as error:
            return done(f"{said.alarm} is acknowledged; it could not be recorded: {error}")
        return done(f"{said.alarm} is acknowledged")

    def _why_another(self, said: AcknowledgeAlarm) -> str:
        """Empty: what was shown is what there is. An alarm that came again nobody has seen yet."""
        live = self._states.live.get(said.alarm)
        if live is None or said.since_wall_s is None:
            return ""
        since_wall_s = live.since_s + self._wall_clock() - self._clock()
        if abs(since_wall_s - said.since_wall_s) <= SAME_S:
            return ""
        return f"{said.alarm} is another than the one that was shown: it came at {iso(since_wall_s)}; look at it again"

    async def _shelve(self, said: ShelveAlarm, who: Who) -> Reply:
        """Only on record: whoever comes next must be able to see why an alarm is silent."""
        if not said.for_s and said.alarm not in self._states.shelved:
            return refused("nothing is taken off the shelf", [f"{said.alarm} is not shelved"])
        what = {"alarm": said.alarm, "for_s": said.for_s, "because": said.because}
        try:
            await self._append("shelved", who, what)
        except AuditUnavailable as error:
            if said.for_s:
                return refused("nothing is shelved", [str(error)])
        self._states.shelve(said.alarm, said.for_s, self._clock())
        return done(f"{said.alarm} is shelved for {said.for_s:g} s" if said.for_s else f"{said.alarm} is back")

    def _status(self, alarm: Alarm) -> AlarmStatus:
        live, shelved = self._states.live.get(alarm.name), self._states.shelved.get(alarm.name)
        ahead_s = self._wall_clock() - self._clock()
        ended_s = None if live is None else live.ended_s
        since_s = live.since_s if live is not None else shelved.since_s if shelved is not None else self._clock()
        return AlarmStatus(
            name=alarm.name, priority=alarm.priority, means=alarm.means, text="" if live is None else live.text,
            findings=self._conditions.stopped_by if alarm.name == STOPPED and live is not None else [],
            cause=alarm.cause, consequence=alarm.consequence, action=alarm.action,
            active=live is not None and ended_s is None,
            acknowledged=live is None or bool(live.acknowledged_by),
            first_out=self._states.first_out(alarm.name),
            since_wall_s=round(since_s + ahead_s, 3),
            ended_wall_s=None if ended_s is None else round(ended_s + ahead_s, 3),
            acknowledged_by="" if live is None else live.acknowledged_by,
            shelved_until_wall_s=None if shelved is None else round(shelved.until_s + ahead_s, 3),
        )  # fmt: skip

    def _read(self) -> Kept:
        """Nothing, where it is not there or not what was written."""
        try:
            with self._path.open("rb") as stream:
                found = _File.model_validate_json(stream.read(MOST_BYTES))
        except (OSError, ValidationError):
            return Kept()
        if found.boot == self._boot:
            now_s, until_s = self._clock(), found.shelved_until_s
        else:  # a wall clock that was set brings alarms back too early, or hides them for no longer than the longest
            now_s, until_s = self._wall_clock(), found.shelved_until_wall_s
        return Kept(dict(found.acknowledged), {name: at_s - now_s for name, at_s in until_s.items()})

    async def keep(self) -> None:
        """Write down what has changed since the last time: a few times a second, and at the end."""
        await self._keep()

    async def _keep(self) -> str:
        """Empty where it is kept; else what that means."""
        async with self._writing:
            now_s, wall_s = self._clock(), self._wall_clock()
            kept = self._states.kept(now_s)
            new = _File(
                format=1, acknowledged=kept.acknowledged, boot=self._boot,
                shelved_until_wall_s={name: round(wall_s + left_s, 0) for name, left_s in kept.shelved_s.items()},
                shelved_until_s={name: round(now_s + left_s, 1) for name, left_s in kept.shelved_s.items()},
            )  # fmt: skip
            if new == self._written:
                return ""
            try:
                await asyncio.to_thread(_write, self._path, new.model_dump_json(indent=2))
            except OSError as error:
                return f"; the next start of the gateway will not know: {error.strerror}"
            self._written = new
            return ""


def _write(path: Path, content: str) -> None:
    part = path.with_suffix(".part")
    with part.open("w", encoding="utf-8") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    part.replace(path)
