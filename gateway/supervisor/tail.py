"""The tail of a history: what came in the last seconds, in a file beside it, until it is packed into the database.

A frame must be in the kernel's hands within a second, so that a SIGKILL loses no more; in a database that writes pages
of 4 kB, twice, for some hundred bytes of every column. Here it is appended once, and as the file is unlinked before
the kernel gets round to writing it to the disk (30 s), most of it is never written there at all. A power cut takes it
along, as it took the last half minute of a write-ahead log that nobody had synchronised.

The first record says whose it is, the others follow, numbered through the life of the run, each with its checksum: one
that was cut short, and what comes after it, counts as not there.
"""

import json
import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gateway.core.messages import Event
from gateway.core.telemetry import frame_dtype
from gateway.files import NO_FILE, read_bytes
from gateway.supervisor.store import Run

_MOST_HEAD = 1000  #: bytes
MOST_BYTES = 256 * 2**20  #: of a tail; it is packed long before
ENDING = "-tail"  #: of its name, after that of the history
_MAGIC = b"R2RTAIL1"
_FRAME = struct.Struct("<II")  # length and CRC-32 of what follows
LEVEL = 1  # deflate


class DamagedTail(Exception):
    """It is not read; the text says why."""


@dataclass(frozen=True)
class TailRecord:
    """What was stored at one time. `frames`: as of `telemetry.frame_dtype`, may be none."""

    number: int
    wall_ahead_s: float
    frames: NDArray[np.void]
    events: list[Event]


@dataclass(frozen=True)
class TailRead:
    run_id: int  #: in the database beside it
    run: Run
    records: list[TailRecord]


def tail_path(path: Path) -> Path:
    """Of the history at `path`."""
    return path.with_name(path.name + ENDING)


class Tail:
    """The writer's side. Methods raise OSError; what was being appended is then not there."""

    def __init__(self, path: Path, run_id: int, run: Run) -> None:
        """An empty one, in place of what was there."""
        self._path = path
        path.unlink(missing_ok=True)
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC, 0o600)
        self._length = 0
        head = {"run": run_id, "frame_bytes": frame_dtype(run.spans).itemsize, **asdict(run)}
        self._write(_MAGIC + _framed(json.dumps(head).encode()))

    def append(self, record: TailRecord) -> int:
        """Returns how many bytes there are of it in memory, about."""
        head = {
            "number": record.number,
            "wall_ahead_s": record.wall_ahead_s,
            "frames": len(record.frames),
            "events": [one.model_dump() for one in record.events],
        }
        told = json.dumps(head).encode()
        self._write(_framed(told + b"\n" + _packed(record.frames)))
        return len(told) + record.frames.nbytes

    def close(self) -> None:
        """It stays where it is."""
        os.close(self._file)

    def remove(self) -> None:
        """All of it lies in the database."""
        self._path.unlink(missing_ok=True)
        self.close()

    def _write(self, content: bytes) -> None:
        done = 0
        try:
            while done < len(content):
                done += os.write(self._file, content[done:])
        except OSError:
            os.ftruncate(self._file, self._length)
            raise
        self._length += done


def read_tail(path: Path) -> TailRead | None:
    """What lies in the tail; None: nothing, as where it is about to be begun. Raises DamagedTail and OSError."""
    try:
        content = read_bytes(path, MOST_BYTES)
    except FileNotFoundError:
        return None
    except OSError as error:
        if error.errno in NO_FILE:
            raise DamagedTail(f"{path} is no tail of a history: {error.strerror}") from error
        raise
    if not content.startswith(_MAGIC[: len(content)]):
        raise DamagedTail(f"{path} is no tail of a history")
    payloads = _payloads(content[len(_MAGIC) :])
    try:
        head: dict[str, Any] = json.loads(next(payloads))
        run_id, frame_bytes = int(head.pop("run")), int(head.pop("frame_bytes"))
        run = Run(**head)
        if frame_bytes != frame_dtype(run.spans).itemsize:
            raise DamagedTail(f"{path} is of another version of this program")
        return TailRead(run_id, run, [_record(payload, run.spans) for payload in payloads])
    except StopIteration:
        if len(content) < len(_MAGIC) + _FRAME.size + _MOST_HEAD:
            return None  # its beginning was cut short, before anything was in it
        raise DamagedTail(f"the beginning of {path} is damaged") from None
    except (ValueError, TypeError, KeyError, zlib.error) as error:
        raise DamagedTail(f"{path} is damaged: {error}") from error


def _framed(payload: bytes) -> bytes:
    return _FRAME.pack(len(payload), zlib.crc32(payload)) + payload


def _payloads(content: bytes) -> Iterator[bytes]:
    """Those that are whole, up to the first that is not."""
    start = 0
    while start + _FRAME.size <= len(content):
        length, checksum = _FRAME.unpack_from(content, start)
        payload = content[start + _FRAME.size : start + _FRAME.size + length]
        if len(payload) != length or zlib.crc32(payload) != checksum:
            return
        yield payload
        start += _FRAME.size + length


def _record(payload: bytes, spans: int) -> TailRecord:
    head, _, packed = payload.partition(b"\n")
    found = json.loads(head)
    events = [Event.model_construct(**one) for one in found["events"]]  # they were checked when they came
    return TailRecord(found["number"], found["wall_ahead_s"], _unpacked(packed, spans, found["frames"]), events)


def _packed(frames: NDArray[np.void]) -> bytes:
    """All first bytes of all frames, then all second bytes, ...: they repeat; see blobs.py."""
    octets = np.ascontiguousarray(frames).view(np.uint8).reshape(len(frames), frames.dtype.itemsize)
    return zlib.compress(octets.T.tobytes(), LEVEL)


def _unpacked(packed: bytes, spans: int, count: int) -> NDArray[np.void]:
    dtype = frame_dtype(spans)
    octets = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(dtype.itemsize, count)
    return np.ascontiguousarray(octets.T).reshape(-1).view(dtype)


def table_of(payloads: Sequence[bytes], spans: int) -> NDArray[np.void]:
    """Frames as they came over the wire, as a table."""
    return np.frombuffer(b"".join(payloads), frame_dtype(spans))
