"""Who is written down for a stop: whom the kernel knows at the loop, and whom the gateway passed it on for."""

import os
from collections.abc import Mapping
from typing import Any, cast

import pytest

from gateway.core.audit_record import Who
from gateway.core.messages import Event
from gateway.supervisor.line_stops import LOOP, NOT_KNOWN, hear_stop
from gateway.supervisor.loop_records import LoopRecords

ANNA = Who(name="anna", uid=1001)
HERE = os.getuid()


class Written(list[tuple[str, Who, Mapping[str, object]]]):
    def write(self, kind: str, who: Who, what: Mapping[str, object]) -> None:
        self.append((kind, who, what))


def who_stopped(stopped: dict[str, Any], asked: Who | None) -> Who:
    written = Written()
    event = Event(time_s=1.0, kind="state", text="RUN to STOP", data={"stopped": {"state": "RUN", **stopped}})
    hear_stop(event, cast("LoopRecords", written), lambda: asked)
    ((kind, who, what),) = written
    assert (kind, what["state"], what["by_person"]) == ("line-stopped", "RUN", stopped["by_person"])
    return who


@pytest.mark.parametrize(
    ("stopped", "asked", "expected"),
    [
        ({"by_person": True, "uid": HERE, "pid": os.getpid()}, ANNA, ANNA),  # the gateway handed it on
        ({"by_person": True, "uid": HERE, "pid": os.getpid()}, None, NOT_KNOWN),
        ({"by_person": True}, ANNA, NOT_KNOWN),  # a loop that cannot tell who was there
        ({"by_person": False}, ANNA, LOOP),
    ],
)
def test_who_is_written_down(stopped: dict[str, Any], asked: Who | None, expected: Who) -> None:
    assert who_stopped(stopped, asked) == expected


def test_who_stopped_at_the_loops_own_socket_is_whom_the_kernel_says() -> None:
    assert who_stopped({"by_person": True, "uid": HERE, "pid": os.getppid()}, ANNA).uid == HERE


def test_other_changes_of_state_are_no_stops() -> None:
    written = Written()
    hear_stop(Event(time_s=1.0, kind="state", text="READY to RUN"), cast("LoopRecords", written), lambda: ANNA)
    assert not written
