"""The status as it is sent: always within a message, whatever it holds. The oldest events are the first to give way."""

from gateway.core.clean_text import clean
from gateway.core.status import BusStatus, ChangeStatus, GatewayStatus, TaskFaultStatus
from gateway.mailbox.port import MAX_PAYLOAD

MOST_BYTES = MAX_PAYLOAD * 3 // 4
TEXT_SHOWN = 300  #: characters
MOST_AGENTS, MOST_TASKS = 64, 64


def status_payload(status: GatewayStatus, most_bytes: int = MOST_BYTES) -> bytes:
    """`status` as JSON of at most `most_bytes`; what was left out of it is counted in it."""
    status = _with_bounded_texts(status)
    payload = status.model_dump_json().encode()
    while len(payload) > most_bytes:
        shorter = _shorter(status)
        if shorter is None:
            break
        status = shorter
        payload = status.model_dump_json().encode()
    return payload


def _shorter(status: GatewayStatus) -> GatewayStatus | None:
    """The next that gives way: half of the events, the oldest; then what is told of single buses, tasks and alarms."""
    if status.events:
        gone = (len(status.events) + 1) // 2
        events = status.events[gone:]
        return status.model_copy(update={"events": events, "events_left_out": status.events_left_out + gone})
    if any(bus.absent or bus.last_error for bus in status.buses):
        bare = [one.model_copy(update={"absent": one.absent[:1], "last_error": ""}) for one in status.buses]
        if bare == status.buses:
            bare = [one.model_copy(update={"absent": []}) for one in status.buses]
        return status.model_copy(update={"buses": bare})
    if status.task_faults:
        return status.model_copy(update={"task_faults": []})
    if any(one.findings or one.text for one in status.alarms):
        bare_alarms = [one.model_copy(update={"findings": [], "text": ""}) for one in status.alarms]
        return status.model_copy(update={"alarms": bare_alarms})
    return None


def _with_bounded_texts(status: GatewayStatus) -> GatewayStatus:
    """What this process itself says: the texts of exceptions, paths and agents' names."""
    historian = status.historian.model_copy(
        update={
            "text": clean(status.historian.text, TEXT_SHOWN),
            "path": clean(status.historian.path),
            "moved_aside": clean(status.historian.moved_aside),
        }
    )
    return status.model_copy(
        update={
            "change": _change(status.change),
            "agents_bus": _agents(status.agents_bus),
            "historian": historian,
            "alarms": [one.model_copy(update={"text": clean(one.text, TEXT_SHOWN)}) for one in status.alarms],
            "task_faults": [_fault(one) for one in status.task_faults[-MOST_TASKS:]],
        }
    )


def _change(change: ChangeStatus | None) -> ChangeStatus | None:
    return None if change is None else change.model_copy(update={"text": clean(change.text, TEXT_SHOWN)})


def _agents(bus: BusStatus) -> BusStatus:
    agents = [clean(name, TEXT_SHOWN) for name in bus.agents[:MOST_AGENTS]]
    return bus.model_copy(update={"text": clean(bus.text, TEXT_SHOWN), "agents": agents})


def _fault(fault: TaskFaultStatus) -> TaskFaultStatus:
    return fault.model_copy(update={"text": clean(fault.text, TEXT_SHOWN), "error": clean(fault.error, TEXT_SHOWN)})
