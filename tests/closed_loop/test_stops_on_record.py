"""Each stop of a line in its processes is one record: who asked for it, or what was found. What a local process says is
one, too; the audit stays sound.
"""

import os
from typing import Any

import pytest

from gateway.supervisor.audit_file import AuditFile
from gateway.supervisor.line_stops import STOPPED
from gateway.supervisor.record_words import in_a_sentence
from tests.closed_loop.gate_line import GateLine
from tests.closed_loop.wire import at_rest

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(180)]


def of_kind(line: GateLine, kind: str) -> list[Any]:
    with AuditFile(line.gateway_data) as file:
        return [record for row in file.rows() if (record := row.record()).kind == kind]


def stops(line: GateLine) -> list[Any]:
    return of_kind(line, STOPPED)


def test_a_persons_stop_and_a_web_break_are_one_record_each(tmp_path) -> None:
    with GateLine(tmp_path) as line:
        line.run()
        line.command("stop")
        (asked,) = line.look_on(lambda: stops(line), bool)
        assert asked.who.uid == os.getuid()
        assert (asked.what["by_person"], asked.what["state"], asked.what["findings"]) == (True, "RUN", [])
        line.wait(at_rest)
        line.arm_and_start()
        line.inject("web 2 web-break")
        line.wait(at_rest)
        _, broke = line.look_on(lambda: stops(line), lambda found: len(found) > 1)
        assert (broke.who.name, broke.what["by_person"], broke.what["state"]) == ("loop", False, "RUN")
        assert {one["code"] for one in broke.what["findings"]} & {"web-break", "slack"}, broke.what
        assert "von selbst" in in_a_sentence(broke.kind, broke.who.name, broke.what, language="de")
        shown = line.audit("show", "--kind", STOPPED)
        assert "the line has stopped by itself, from RUNNING: " in shown
        operated = of_kind(line, "operated")
        assert {one.what["command"] for one in operated} >= {"arm", "start"}
        assert {(one.who.uid, one.what["command"] == "stop") for one in operated} == {(os.getuid(), False)}
        line.children.end("gateway")
        assert len(stops(line)) == 2  # on its way to torque off it has told more
        assert "sound" in line.audit("verify")
