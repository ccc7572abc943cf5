"""The alarms of a line as plain variables: one object for each of the table, whether it is active or not."""

from collections.abc import Iterator
from datetime import UTC, datetime

from gateway.core.alarms import ALARMS, Alarm, AlarmStatus
from gateway.core.status import GatewayStatus
from gateway.operator.opcua.line_nodes import ROOT, Told
from gateway.operator.opcua.space import BOOLEAN, STRING, UINT32, Row, Space, Value

FOLDER = f"{ROOT}.Alarms"

_FIXED = (
    Row("Priority", STRING, "high, medium or low"),
    Row("Means", STRING, "In a few words"),
    Row("Cause", STRING, "What leads to it"),
    Row("Consequence", STRING, "Of doing nothing"),
    Row("Action", STRING, "What to do"),
)
_LIVE = (
    Row("Active", BOOLEAN, "Its condition holds"),
    Row("Acknowledged", BOOLEAN, "A person has seen it, or there is nothing to be seen"),
    Row("AcknowledgedBy", STRING, "Empty: by nobody"),
    Row("Shelved", BOOLEAN, "Out of the way for a while"),
    Row("FirstOut", BOOLEAN, "The first of those that came together"),
    Row("Text", STRING, "With the measured values, as they were when it came"),
    Row("Since", STRING, "RFC 3339, for AcknowledgeAlarm; empty: there is nothing to be seen"),
)
_SUMMARY = (
    Row("Active", UINT32, "How many are, without those that are shelved"),
    Row("Unacknowledged", UINT32, "How many nobody has seen, without those that are shelved"),
    Row("First", STRING, "The name of the one that needs a look first; empty: none"),
)


async def make_alarms(space: Space) -> None:
    summary = await space.type("AlarmsType", "The alarms of a line", _SUMMARY)
    kind = await space.type("AlarmType", "One alarm of the table", (*_FIXED, *_LIVE))
    await space.object(FOLDER, ROOT, "By name; AcknowledgeAlarm takes the name", summary)
    await space.variables(FOLDER, _SUMMARY)
    for alarm in ALARMS:
        path = f"{FOLDER}.{alarm.name}"
        await space.object(path, FOLDER, alarm.means, kind)
        await space.variables(path, (*_FIXED, *_LIVE))
        for name, value in _fixed(alarm).items():
            await space.tell(f"{path}.{name}", value, None)


def alarms_of(status: GatewayStatus) -> Iterator[Told]:
    found = {one.name: one for one in status.alarms}
    open_now = [one for one in status.alarms if one.shelved_until_wall_s is None]
    yield Told(f"{FOLDER}.Active", sum(one.active for one in open_now))
    yield Told(f"{FOLDER}.Unacknowledged", sum(not one.acknowledged for one in open_now))
    yield Told(f"{FOLDER}.First", open_now[0].name if open_now else "")
    for alarm in ALARMS:
        for name, value in _live(found.get(alarm.name)).items():
            yield Told(f"{FOLDER}.{alarm.name}.{name}", value)


def live_alarm_paths() -> list[str]:
    """Of all that says nothing true when the gateway is away."""
    paths = [f"{FOLDER}.{row.name}" for row in _SUMMARY]
    return paths + [f"{FOLDER}.{alarm.name}.{row.name}" for alarm in ALARMS for row in _LIVE]


def _fixed(alarm: Alarm) -> dict[str, Value]:
    return {
        "Priority": alarm.priority, "Means": alarm.means, "Cause": alarm.cause, "Consequence": alarm.consequence,
        "Action": alarm.action,
    }  # fmt: skip


def _live(one: AlarmStatus | None) -> dict[str, Value]:
    if one is None:
        return {
            "Active": False, "Acknowledged": True, "AcknowledgedBy": "", "Shelved": False, "FirstOut": False,
            "Text": "", "Since": "",
        }  # fmt: skip
    since = datetime.fromtimestamp(one.since_wall_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    return {
        "Active": one.active, "Acknowledged": one.acknowledged, "AcknowledgedBy": one.acknowledged_by,
        "Shelved": one.shelved_until_wall_s is not None, "FirstOut": one.first_out, "Text": one.text, "Since": since,
    }  # fmt: skip
