"""`r2rgate prove` as a person types it, on processes and wires of their own; the recorder at the drives judges."""

import os
import pty
import subprocess
import sys
import time

import numpy as np
import pytest

from gateway.core.messages import Arm, Start, Stop
from gateway.core.wiring_proof import WiringProof, proof_hash
from gateway.loop.wiring import FILE
from gateway.mailbox.paths import GATEWAY_DATA, LOOP_DATA
from gateway.supervisor.audit_file import AuditFile
from sim_plant.recording import Recording
from tests.closed_loop.wire import WireLine, at_rest

pytestmark = pytest.mark.realtime

SPANS = 2


def prove(wire: WireLine, *words: str) -> "subprocess.CompletedProcess[str]":
    """At a terminal, by somebody who has looked where the noise of this machine's run leaves a question."""
    command = [sys.executable, "-m", "gateway.cli", "prove", "--run-dir", str(wire.children.run_folder), *words]
    person, terminal = pty.openpty()
    try:
        os.write(person, b"y\n" * 10)
        return subprocess.run(command, capture_output=True, text=True, check=False, stdin=terminal)
    finally:
        os.close(person)
        os.close(terminal)


def first_torque_s(recording: Recording) -> float:
    return float(recording.time_s[np.flatnonzero(recording.torque_nm.any(axis=1))[0]])


def test_no_start_before_the_proof_and_one_after_it_also_of_a_loop_that_starts_anew(tmp_path):
    with WireLine(tmp_path, spans=SPANS) as wire:
        wire.start_gateway(proved=False)
        wire.start_loop(proved=False)
        wire.wait(lambda status: status.loop.running)
        shown = wire.wait(lambda status: status.wiring is not None).wiring
        assert shown is not None and [each.code for each in shown.unproved] == ["wiring-unproved"]
        armed, started = wire.order(Arm()), wire.order(Start())
        assert armed.ok and "prove" in armed.text
        assert not started.ok and [each.code for each in started.findings] == ["wiring-unproved"]
        assert wire.order(Stop()).ok
        wire.wait(at_rest)
        said = prove(wire)
        assert said.returncode == 0, said
        assert "the wiring is proved" in said.stdout and (tmp_path / "data" / LOOP_DATA / FILE).exists()
        shown = wire.wait(lambda status: status.wiring is not None and not status.wiring.unproved).wiring
        assert shown is not None and shown.proved_wall_s is not None and abs(shown.proved_wall_s - time.time()) < 60.0
        with AuditFile(tmp_path / "data" / GATEWAY_DATA) as audit:
            (proved,) = [record for row in audit.rows() if (record := row.record()).kind == "wiring-proved"]
        assert proved.what["wall_s"] == shown.proved_wall_s and proved.what["proof"] == shown.proof
        assert not wire.wait(lambda status: status.loop.running).unexplained
        wire.children.end("loop")
        wire.wait(lambda status: not status.loop.running)
        wire.start_loop(proved=False)  # what is on the disk counts
        wire.wait(lambda status: status.wiring is not None and status.wiring.not_read)
        wire.arm_and_start()
        assert wire.order(Stop()).ok
        wire.wait(at_rest)
        recording = wire.recording()
        trips = recording.of_kind("watchdog")
        assert {event["roller"] for event in trips} == set(range(1, SPANS + 1))
        assert all(event["time_s"] < first_torque_s(recording) for event in trips)
        assert not recording.of_kind("unsafe")


def test_one_drive_alone_is_proved_anew_and_the_line_starts(tmp_path):
    with WireLine(tmp_path, spans=SPANS) as wire:
        wire.start_gateway()
        wire.start_loop()
        wire.wait(lambda status: status.loop.running)
        said = prove(wire, "--only", "drive-x")
        assert said.returncode == 2 and "drive-" in said.stderr, said
        assert wire.order(Stop()).ok
        wire.wait(at_rest)
        before = WiringProof.model_validate_json((tmp_path / "data" / LOOP_DATA / FILE).read_text())
        said = prove(wire, "--only", before.drives[0].drive)
        assert said.returncode == 0, said
        after = WiringProof.model_validate_json((tmp_path / "data" / LOOP_DATA / FILE).read_text())
        assert after.drives[1:] == before.drives[1:] and after.drives[0].torque_nm > 0.0
        shown = wire.wait(lambda status: status.wiring is not None and status.wiring.proof == proof_hash(after))
        assert not shown.unexplained
        wire.arm_and_start()
        assert wire.order(Stop()).ok
        wire.wait(at_rest)


def test_a_load_cell_that_shows_less_where_the_web_pulls_more_is_named_and_the_line_stays_unproved(tmp_path):
    with WireLine(tmp_path, spans=SPANS) as wire:
        wire.inject("load-cell 2 cell-factor factor=-1")
        wire.start_gateway(proved=False)
        wire.start_loop(proved=False)
        wire.wait(lambda status: status.loop.running)
        said = prove(wire)
        assert said.returncode == 2 and 'set sign = "inverted"' in said.stderr, said
        assert not (tmp_path / "data" / LOOP_DATA / FILE).exists()
        wire.wait(at_rest)
        assert wire.order(Arm()).ok
        assert [each.code for each in wire.order(Start()).findings] == ["wiring-unproved"]
        assert not wire.recording().of_kind("unsafe")
