"""Whether every torque at the drives was that of a configuration which the audit knows: the recorder against both."""

import math
from bisect import bisect_right

import numpy as np

from gateway.supervisor.audit_file import AuditFile
from gateway.supervisor.gate import CONFIGURATION_CHANGES
from gateway.supervisor.historian import FILE_NAME
from gateway.supervisor.history import History
from sim_plant.recorder import read_recording
from tests.closed_loop.gate_line import GateLine

SHORT = 12  #: letters of a hash, as a loop's start tells it


def unexplained_torques(line: GateLine, since_s: float) -> tuple[int, float]:
    """Milliseconds of torque since then (world) under what no record allows or explains; and until when was looked."""
    recording = read_recording(line.folder / "recording", events=False)
    with History(line.gateway_data / FILE_NAME) as history:
        found = history.events(0.0, math.inf, CONFIGURATION_CHANGES)
    changes = sorted((one.time_s - line.world_start_s, _hash(one.kind, one.text, one.data)) for one in found)
    times, known = [time_s for time_s, _ in changes], allowed(line)
    acts = recording.torque_nm.any(axis=1) & (recording.time_s > since_s)
    odd = 0
    for time_s in recording.time_s[acts].tolist():
        k = bisect_right(times, time_s) - 1
        odd += k < 0 or changes[k][1] not in known
    return odd, float(np.max(recording.time_s, initial=since_s))


def allowed(line: GateLine) -> set[str]:
    """What was approved, what a person has confirmed, and what was found in service as the records have it."""
    changes, known = dict[str, str](), set[str]()
    with AuditFile(line.gateway_data) as file:
        for record in (row.record() for row in file.rows()):
            what = record.what
            if record.kind == "proposed":
                changes[str(what["proposal"])] = str(what["changes"])
            elif record.kind == "approved":
                known.add(changes[str(what["proposal"])][:SHORT])
            elif record.kind == "confirmed" or (record.kind == "found-in-service" and what.get("explained", True)):
                known.add(str(what["configuration"])[:SHORT])
    return known


def _hash(kind: str, text: str, data: dict[str, object]) -> str:
    return text.split()[-1] if kind == "start" else str(data.get("hash", ""))[:SHORT]
