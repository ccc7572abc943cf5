"""Recordings as CSV, so that data of another logger can be brought, and data taken elsewhere.

    # period_s = 0.01
    time_s,tension_1_n,...,tension_setpoint_1_n,...,speed_1_m_per_s,...,torque_1_nm,...,torque_actual_1_nm,...,
    unwind_speed_m_per_s,controlled

Commas, decimal points, UTF-8, one header line; columns in any order. Spans and rollers count from 1. `time_s`, the
unwinder's speed and the speed and torque of each roller are needed. An empty cell is a value that is not known.
`controlled` is 1 where the loop was in control, 0 elsewhere; without this column all is taken to be so. The line
that begins with # may be left out: the period is then the median interval. Numbers are written so that they are read
as exactly what they were.
"""

import csv
from collections.abc import Iterator
from math import isfinite, isnan, nan
from pathlib import Path
from typing import TextIO

import numpy as np

from gateway.cli.recordings_table import RecordingRefused, columns_of, heads, recording_from, spans_of
from gateway.core.recording import Recording

PERIOD = "# period_s = "
_WORDS = {"true": 1.0, "false": 0.0}


def write_csv(recording: Recording, target: TextIO) -> None:
    columns = columns_of(recording)
    names = heads(recording.n)
    target.write(f"{PERIOD}{recording.period_s!r}\n")
    writer = csv.writer(target, lineterminator="\n")
    writer.writerow(names)
    texts = [[_text(value, name) for value in columns[name].tolist()] for name in names]
    writer.writerows(zip(*texts, strict=True))


def read_csv(path: Path, period_s: float | None = None) -> Recording:
    """Raises RecordingRefused with file, line, column and what is allowed; OSError when it cannot be read."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            return _read(file, path.name, period_s)
    except UnicodeDecodeError as error:
        raise RecordingRefused(f"{path.name}: byte {error.start} is no UTF-8: save it as CSV in UTF-8") from error
    except csv.Error as error:
        raise RecordingRefused(f"{path.name}: no CSV: {error}") from error


def _read(file: TextIO, name: str, period_s: float | None) -> Recording:
    rows = _rows(file)
    number, names = next(rows, (0, []))
    if names and names[0].startswith("#"):
        period_s = _period(",".join(names), f"{name}, line {number}") or period_s
        number, names = next(rows, (0, []))
    if not names:
        raise RecordingRefused(f"{name}: it is empty; the first line should name the columns")
    where = f"{name}, line {number}"
    if len(names) == 1 and any(sign in names[0] for sign in ";\t"):
        raise RecordingRefused(f"{where}: columns should be divided by commas, and decimals by points")
    names = [head.strip() for head in names]
    n = spans_of(names, where)
    table: list[list[float]] = []
    for number, row in rows:
        if len(row) != len(names):
            raise RecordingRefused(f"{name}, line {number}: it has {len(row)} cells, the header {len(names)}")
        table.append([_number(cell, head, f"{name}, line {number}") for cell, head in zip(row, names, strict=True)])
    values = np.array(table, dtype=np.float64).reshape(-1, len(names))
    columns = {head: np.ascontiguousarray(values[:, k]) for k, head in enumerate(names)}
    return recording_from(columns, n, period_s, name)


def _rows(file: TextIO) -> Iterator[tuple[int, list[str]]]:
    """Lines that are not empty, with their numbers."""
    reader = csv.reader(file, strict=True)
    for row in reader:
        if row:
            yield reader.line_num, row


def _period(line: str, where: str) -> float | None:
    if not line.startswith(PERIOD):
        return None
    text = line.removeprefix(PERIOD)
    try:
        value = float(text)
    except ValueError:
        value = nan
    if not isfinite(value) or value <= 0.0:
        raise RecordingRefused(f"{where}: period_s is {text!r}, should be a number above 0")
    return value


def _text(value: float, name: str) -> str:
    if isnan(value):
        return ""
    return str(int(value)) if name == "controlled" else repr(value)


def _number(cell: str, name: str, where: str) -> float:
    text = cell.strip().lower()
    if name == "controlled":
        value = _WORDS.get(text, {"1": 1.0, "0": 0.0}.get(text.removesuffix(".0")))
        if value is None:
            raise RecordingRefused(f"{where}, column {name}: is {cell!r}, should be 0 or 1")
        return value
    if text in ("", "nan"):
        if name == "time_s":
            raise RecordingRefused(f"{where}, column {name}: is empty, should be a number of seconds")
        return nan
    try:
        value = float(text) if "_" not in text else nan
    except ValueError:
        value = nan
    if not isfinite(value):
        raise RecordingRefused(f"{where}, column {name}: is {cell!r}, should be a number, or empty where not known")
    return value
