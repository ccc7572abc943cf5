"""The alarms of a line: looked at a few times a second, seen and shelved by people, each of that on record.

Nothing here acts on the line. What was acknowledged or shelved is kept in a file over a restart of the gateway; where
that is lost or damaged, alarms come again, which is the safe side. The file alone silences nothing: an alarm stays on
the shelf as far as the audit says that somebody has put it there.
"""

import asyncio
import os
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError

from gateway.core.alarms import (
    ALARM_SAID,
    ALARMS,
    BY_NAME,
    AcknowledgeAlarm,
    Alarm,
    AlarmName,
    AlarmSaid,
    AlarmStatus,
    ShelveAlarm,
)
from gateway.core.audit_record import AuditRecord, Who
from gateway.core.finding import finding
from gateway.core.line import Strict
from gateway.core.messages import Reply
from gateway.core.nearest import nearest
from gateway.core.status import GatewayStatus
from gateway.core.topics import GATEWAY_ALARM
from gateway.files import read_bytes
from gateway.mailbox.port import PEER, Mailbox
from gateway.supervisor.alarm_conditions import Conditions
from gateway.supervisor.alarm_states import AlarmStates, Kept
from gateway.supervisor.audit import AuditState
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.peers import who_of
from gateway.supervisor.proposal_records import done, iso, refused
from gateway.supervisor.said_inbox import OF_DECISIONS, ON_ALARMS_EVENT, SaidInbox
from gateway.supervisor.store import boot_id
from gateway.wording.catalogue import sentence

FILE_NAME = "alarms.json"
MOST_BYTES = 65_536
SHELVED = "shelved"  #: kind of record
ROUNDED_S = 2.0  #: by which the file and a record may differ: one is rounded, the other was stored first
SAME_S = 0.1  #: between two tellings of one beginning: the wall clock is being disciplined
_URGENCY = {"high": 0, "medium": 1, "low": 2}


class _File(Strict):
    """What was acknowledged or shelved when it was written."""

    format: Annotated[int, Field(ge=1, le=1)]
    acknowledged: dict[AlarmName, str]
    shelved_until_wall_s: dict[AlarmName, float]
    boot: str = ""  #: of the monotonic times; files of earlier versions do not say
    shelved_until_s: dict[AlarmName, float] = {}  #: monotonic


async def no_records() -> Sequence[AuditRecord]:
    """Where there is no audit."""
    return ()


class Alarms:
    """`look` a few times a second, `status` for whoever asks, `say` for people. A handler on a mailbox."""

    def __init__(
        self,
        mailbox: Mailbox,
        folder: Path,
        append: Callable[[str, Who, Mapping[str, Any]], Awaitable[object]],
        note: Callable[..., None],
        clock: Callable[[], float],
        wall_clock: Callable[[], float],
        records: Callable[[], Awaitable[Sequence[AuditRecord] | None]] = no_records,
    ) -> None:
        """`append` stores a record of the audit and may raise AuditUnavailable; `note` is for the history.

        `records`: of kind `SHELVED`, in their order; None: they cannot be read yet.
        """
        self._path = folder / FILE_NAME
        self._append = append
        self._note = note
        self._clock = clock
        self._wall_clock = wall_clock
        self._boot = boot_id()
        self._inbox = SaidInbox(ON_ALARMS_EVENT, OF_DECISIONS, clock, note)
        self._conditions = Conditions()
        self._records = records
        kept = self._read()
        self._to_explain = kept.shelved_s  #: on the shelf by the file, and not held against the records yet
        self._begun_s = clock()
        self._states = AlarmStates(clock(), Kept(kept.acknowledged))
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
        who = await who_of(PEER.get())
        return (self._inbox.refuse(who, len(payload)) or await self.say(said, who)).model_dump_json().encode()

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
            await self._append(SHELVED, who, what)
        except AuditUnavailable as error:
            if said.for_s:
                return refused("nothing is shelved", [str(error)])
        self._states.shelve(said.alarm, said.for_s, self._clock())
        self._to_explain.pop(said.alarm, None)  # a person's word goes before what the file says
        return done(f"{said.alarm} is shelved for {said.for_s:g} s" if said.for_s else f"{said.alarm} is back")

    def _status(self, alarm: Alarm) -> AlarmStatus:
        live, shelved = self._states.live.get(alarm.name), self._states.shelved.get(alarm.name)
        ahead_s = self._wall_clock() - self._clock()
        ended_s = None if live is None else live.ended_s
        since_s = live.since_s if live is not None else shelved.since_s if shelved is not None else self._clock()
        return AlarmStatus(
            name=alarm.name, priority=alarm.priority, means=alarm.means, text="" if live is None else live.text,
            findings=[] if live is None else self._conditions.findings_of(alarm.name),
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
            found = _File.model_validate_json(read_bytes(self._path, MOST_BYTES))
        except (OSError, ValidationError):
            return Kept()
        if found.boot == self._boot:
            now_s, until_s = self._clock(), found.shelved_until_s
        else:  # a wall clock that was set brings alarms back too early, or hides them for no longer than the longest
            now_s, until_s = self._wall_clock(), found.shelved_until_wall_s
        return Kept(dict(found.acknowledged), {name: at_s - now_s for name, at_s in until_s.items()})

    async def keep(self) -> None:
        """Write down what has changed since the last time: a few times a second, and at the end."""
        if self._to_explain and (records := await self._records()) is not None:
            self._restore(records)
        await self._keep()

    def _restore(self, records: Sequence[AuditRecord]) -> None:
        """What the file has on the shelf, as far as the audit says it, too. The rest is told, and shows again."""
        now_s = self._clock()
        said = {str(one.what.get("alarm")): one for one in records}  # the last of each
        for name, left_s in self._to_explain.items():
            left_s -= now_s - self._begun_s
            explained_s = 0.0 if (one := said.get(name)) is None else self._left_s(one)
            self._states.restore_shelved(name, min(left_s, explained_s), now_s)
            if left_s > explained_s + ROUNDED_S:
                found = finding("shelving-unexplained", alarm=name)
                self._note("alarm-not-shelved", sentence(found), findings=[found])
        self._to_explain = {}

    def _left_s(self, record: AuditRecord) -> float:
        """For how long it is still on the shelf, by the record of who has put it there. Not positive: it is not."""
        for_s = record.what.get("for_s")
        if not isinstance(for_s, int | float):
            return 0.0
        same_boot = record.boot == self._boot
        now_s, at_s = (self._clock(), record.monotonic_s) if same_boot else (self._wall_clock(), record.wall_s)
        return min(for_s, at_s + for_s - now_s)

    async def _keep(self) -> str:
        """Empty where it is kept; else what that means."""
        async with self._writing:
            now_s, wall_s = self._clock(), self._wall_clock()
            kept = self._states.kept(now_s)
            # What could not be held against the records yet is not forgotten meanwhile.
            waiting = {name: left_s - (now_s - self._begun_s) for name, left_s in self._to_explain.items()}
            kept.shelved_s = {name: left_s for name, left_s in waiting.items() if left_s > 0.0} | kept.shelved_s
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
