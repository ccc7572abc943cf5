"""Recordings as MCAP (the container of robotics' logs): JSON messages with a schema, which Foxglove and others open.

One message per sample on /r2rgate/recording, its log time that of the sample; a value that is not known is null. The
metadata record "r2rgate.recording" has the format's number and the period. Numbers come back exactly.
"""

import json
from math import isfinite
from pathlib import Path
from typing import IO, Any

import numpy as np

from gateway.cli.recordings_table import MOST_SPANS, PER_SPAN, RecordingRefused, usual_step_s
from gateway.core.recording import Recording
from gateway.core.signals import FloatArray

TOPIC, SCHEMA_NAME, METADATA, FORMAT = "/r2rgate/recording", "r2rgate.Sample", "r2rgate.recording", "1"
_LATEST_S = 1.8e10  #: of an MCAP log time, which has 64 bits of nanoseconds; the message has the time itself
_SINGLE = ("time_s", "unwind_speed_m_per_s")


def schema(n: int) -> dict[str, Any]:
    """JSON schema of a message of n spans."""
    number = {"type": ["number", "null"]}
    each = {"type": "array", "items": number, "minItems": n, "maxItems": n}
    properties: dict[str, Any] = {"time_s": {"type": "number"}, "unwind_speed_m_per_s": number}
    properties |= dict.fromkeys(PER_SPAN, each) | {"controlled": {"type": "boolean"}}
    return {"type": "object", "title": SCHEMA_NAME, "properties": properties, "required": list(properties)}


def write_mcap(recording: Recording, target: IO[bytes]) -> None:
    from mcap.writer import Writer

    writer = Writer(target)
    writer.start(profile="", library="r2rgate")
    data = json.dumps(schema(recording.n)).encode()
    schema_id = writer.register_schema(name=SCHEMA_NAME, encoding="jsonschema", data=data)
    channel = writer.register_channel(topic=TOPIC, message_encoding="json", schema_id=schema_id)
    writer.add_metadata(METADATA, {"format": FORMAT, "period_s": repr(recording.period_s), "source": recording.source})
    arrays = {name: getattr(recording, name).tolist() for name in (*_SINGLE, *PER_SPAN, "controlled")}
    for k in range(recording.samples):
        message = {name: _known(values[k]) for name, values in arrays.items()}
        at_ns = round(1e9 * min(max(float(recording.time_s[k]), 0.0), _LATEST_S))
        writer.add_message(channel, at_ns, json.dumps(message, allow_nan=False).encode(), at_ns, k & 0xFFFFFFFF)
    writer.finish()


def read_mcap(path: Path, period_s: float | None = None) -> Recording:
    """Raises RecordingRefused; OSError when it cannot be read. The file's own period goes before `period_s`."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    try:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            topics = {c.topic for c in summary.channels.values()} if (summary := reader.get_summary()) else set()
            if TOPIC not in topics:
                listed = ", ".join(sorted(topics)) or "none"
                raise RecordingRefused(f"{path.name}: no topic {TOPIC}; its topics: {listed}")
            said = next((m.metadata for m in reader.iter_metadata() if m.name == METADATA), {})
            found = [m for _, _, m in reader.iter_messages(topics=[TOPIC], log_time_order=False)]
    except RecordingRefused:
        raise
    except (McapError, ValueError, EOFError, KeyError, RuntimeError) as error:
        raise RecordingRefused(
            f"{path.name}: no MCAP file, or a damaged one: {error or type(error).__name__}"
        ) from error
    if said.get("format", FORMAT) != FORMAT:
        raise RecordingRefused(f"{path.name}: format {said['format']!r}, this program reads {FORMAT!r}")
    found.sort(key=lambda m: m.sequence)
    samples = [_sample(m.data, f"{path.name}, message {k}") for k, m in enumerate(found, 1)]
    return _recording(samples, _period(said, path.name) or period_s, path.name)


def _known(value: Any) -> Any:
    if isinstance(value, list):
        return [_known(v) for v in value]
    return value if isinstance(value, bool) or isfinite(value) else None


def _period(said: dict[str, str], name: str) -> float | None:
    if "period_s" not in said:
        return None
    try:
        value = float(said["period_s"])
    except ValueError:
        value = 0.0
    if not isfinite(value) or value <= 0.0:
        raise RecordingRefused(f"{name}: period_s is {said['period_s']!r}, should be a number above 0")
    return value


def _sample(data: bytes, where: str) -> dict[str, Any]:
    try:
        found = json.loads(data)
    except ValueError as error:
        raise RecordingRefused(f"{where}: no JSON: {error}") from error
    if not isinstance(found, dict):
        raise RecordingRefused(f"{where}: should be an object")
    names = {*_SINGLE, *PER_SPAN, "controlled"}
    if set(found) != names:
        missing, odd = ", ".join(sorted(names - set(found))), ", ".join(sorted(set(found) - names))
        raise RecordingRefused(f"{where}: missing: {missing or 'nothing'}; not known here: {odd or 'nothing'}")
    return found


def _recording(samples: list[dict[str, Any]], period_s: float | None, name: str) -> Recording:
    if len(samples) < 2:
        raise RecordingRefused(f"{name}: {len(samples)} samples are no recording")
    first = samples[0]["speed_m_per_s"]
    n = len(first) if isinstance(first, list) else 0
    if not 1 <= n <= MOST_SPANS:
        raise RecordingRefused(f"{name}, message 1, speed_m_per_s: should be a list of 1 to {MOST_SPANS} numbers")
    arrays: dict[str, FloatArray] = {key: _array(samples, key, n, name) for key in PER_SPAN}
    arrays |= {key: _array(samples, key, 0, name)[:, 0] for key in _SINGLE}
    unknown = np.flatnonzero(np.isnan(arrays["time_s"]))
    if len(unknown):
        raise RecordingRefused(f"{name}, message {unknown[0] + 1}, time_s: is null, should be a number of seconds")
    for k, sample in enumerate(samples, 1):
        if not isinstance(sample["controlled"], bool):
            raise RecordingRefused(
                f"{name}, message {k}, controlled: is {sample['controlled']!r}, should be true or false"
            )
    controlled = np.array([sample["controlled"] for sample in samples])
    return Recording(**arrays, controlled=controlled, period_s=period_s or usual_step_s(arrays["time_s"]), source=name)


def _array(samples: list[dict[str, Any]], key: str, n: int, name: str) -> FloatArray:
    """Shape (k, n), or (k, 1) for n = 0, which stands for a single number."""
    rows: list[list[float]] = []
    for k, sample in enumerate(samples, 1):
        values = sample[key] if n else [sample[key]]
        if not isinstance(values, list) or len(values) != max(n, 1) or not all(map(_is_value, values)):
            allowed = f"a list of {n} numbers" if n else "a number"
            raise RecordingRefused(f"{name}, message {k}, {key}: should be {allowed}, null where not known")
        rows.append([np.nan if value is None else float(value) for value in values])
    return np.array(rows, dtype=np.float64)


def _is_value(value: Any) -> bool:
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value))
