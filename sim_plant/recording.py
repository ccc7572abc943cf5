"""A recording in a folder, made to survive its writer: whatever was handed to the system before a SIGKILL is read.

events.jsonl    one JSON object a line. The first is {"kind": "recording", "format": 1, ...} with the plant's name,
                spans and seed. Every further one has "kind", "time_s" (world time) and "monotonic_s" (CLOCK_MONOTONIC
                of the writer), and what belongs to its kind. Rollers and spans count from 1.
trace.bin       one JSON line {"format": 1, "spans": n, "step_s": 0.001, "columns": [...], "dtype": "<f4"}, then
                blocks: number of the first row's step (u64) and number of rows (u32), little-endian, then the rows.
                The row of step k holds the true state at k ms, and the torques and v0 that acted in the millisecond
                before. A block that was cut off counts as far as its whole rows go.
"""

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sim_plant.physics import STEP_S, FloatArray

FORMAT = 1
EVENTS_FILE = "events.jsonl"
TRACE_FILE = "trace.bin"
_BLOCK = struct.Struct("<QI")
_ROW_TYPE = np.dtype("<f4")

Event = dict[str, Any]


class RecordingUnreadable(Exception):
    """A folder that holds no recording of this format; the text says why."""


@dataclass(frozen=True)
class Recording:
    """Truth over time: time (m,), tensions, speeds and torques (m, n), v0 (m,); and what happened."""

    spans: int
    time_s: FloatArray
    tension_n: FloatArray
    speed_m_per_s: FloatArray
    torque_nm: FloatArray
    unwind_speed_m_per_s: FloatArray
    events: list[Event] = field(default_factory=list[Event])

    def of_kind(self, kind: str) -> list[Event]:
        return [event for event in self.events if event["kind"] == kind]


def recording_of(spans: int, steps: FloatArray, rows: FloatArray, events: list[Event]) -> Recording:
    """A recording from step numbers (m,) and rows (m, 3n+1) as `physics.integrate` fills them."""
    n = spans
    return Recording(n, steps * STEP_S, rows[:, :n], rows[:, n : 2 * n], rows[:, 2 * n : 3 * n], rows[:, 3 * n], events)


class RecordingWriter:
    """Appends to the two files of a new folder. Raises FileExistsError rather than overwrite a recording."""

    def __init__(self, folder: Path, header: Event, spans: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._events = (folder / EVENTS_FILE).open("x", encoding="utf-8")
        self._trace = (folder / TRACE_FILE).open("xb")
        self.event({"kind": "recording", "format": FORMAT, **header})
        names = [f"{name}_{i + 1}" for name in ("tension_n", "speed_m_per_s", "torque_nm") for i in range(spans)]
        columns = [*names, "unwind_speed_m_per_s"]
        description = {"format": FORMAT, "spans": spans, "step_s": STEP_S, "columns": columns, "dtype": _ROW_TYPE.str}
        self._trace.write(json.dumps(description).encode() + b"\n")
        self.flush()

    def event(self, event: Event) -> None:
        self._events.write(json.dumps(event) + "\n")

    def rows(self, first: int, rows: FloatArray) -> None:
        self._trace.write(_BLOCK.pack(first, len(rows)) + rows.astype(_ROW_TYPE).tobytes())

    def flush(self) -> None:
        """Hand everything to the system: from here on it survives this process, though not a power cut."""
        self._events.flush()
        self._trace.flush()

    def close(self) -> None:
        self._events.close()
        self._trace.close()


def read_recording(folder: Path | str, *, events: bool = True) -> Recording:
    """What a folder holds, also while it is being written or after its writer was killed.

    `events`: with those, of which there may be many, or without. Raises RecordingUnreadable for another format, OSError
    when the files are not there.
    """
    folder = Path(folder)
    content = (folder / TRACE_FILE).read_bytes()
    first_line, newline, blocks = content.partition(b"\n")
    try:
        header = json.loads(first_line) if newline else {}
    except ValueError as error:
        raise RecordingUnreadable(f"{folder / TRACE_FILE} does not begin with a JSON line: {error}") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise RecordingUnreadable(f"{folder / TRACE_FILE} is no trace of format {FORMAT}")
    spans = int(header["spans"])
    steps, rows = _read_blocks(blocks, 3 * spans + 1)
    return recording_of(spans, steps, rows, _read_events(folder / EVENTS_FILE) if events else [])


def _read_blocks(content: bytes, width: int) -> tuple[FloatArray, FloatArray]:
    steps, pieces = [np.empty(0)], [np.empty((0, width))]
    position = 0
    while position + _BLOCK.size <= len(content):
        first, count = _BLOCK.unpack_from(content, position)
        position += _BLOCK.size
        there = min(count, (len(content) - position) // (width * _ROW_TYPE.itemsize))
        rows = np.frombuffer(content, _ROW_TYPE, there * width, position).reshape(there, width)
        pieces.append(rows.astype(np.float64))
        steps.append(np.arange(first, first + there, dtype=np.float64))
        position += count * width * _ROW_TYPE.itemsize
    return np.concatenate(steps), np.concatenate(pieces)


def _read_events(path: Path) -> list[Event]:
    """Every whole line; a last one without an end was being written."""
    lines = path.read_bytes().split(b"\n")
    return [json.loads(line) for line in lines[:-1]]
