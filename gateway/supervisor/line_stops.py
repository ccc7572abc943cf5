"""Stops of the line on record: each once, with what led to it and who asked, as far as the loop and the kernel know."""

import os
from collections.abc import Callable, Mapping

from gateway.core.audit_record import Who
from gateway.core.messages import Event
from gateway.mailbox.port import Peer
from gateway.supervisor.loop_records import LoopRecords
from gateway.supervisor.peers import who_at_once

STOPPED = "line-stopped"  #: kind of record
LOOP, NOT_KNOWN = Who(name="loop"), Who(name="not known")
MOST_FINDINGS = 8


def hear_stop(event: Event, records: LoopRecords, asked: Callable[[], Who | None]) -> None:
    """An event of the loop; most are no stop. `asked`: who asked the gateway for the last one."""
    if event.kind != "state" or not isinstance(stopped := event.data.get("stopped"), Mapping):
        return
    by_person, pid, uid = (stopped.get(key) for key in ("by_person", "pid", "uid"))
    who = NOT_KNOWN if by_person else LOOP
    if by_person and pid == os.getpid():
        who = asked() or NOT_KNOWN
    elif by_person and isinstance(uid, int) and isinstance(pid, int):
        who = who_at_once(Peer(uid, pid))
    what: dict[str, object] = {
        "by_person": bool(by_person),
        "state": str(stopped.get("state")),
        "phase": str(stopped.get("phase")),
        "findings": [one.model_dump(mode="json") for one in event.findings[:MOST_FINDINGS]],
        "because": event.text[:400],
        "monotonic_s": event.time_s,
    }
    records.write(STOPPED, who, what)
