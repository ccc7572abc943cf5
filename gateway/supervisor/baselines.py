"""The Performance Baseline Database: how well a configuration did, when, on which model and in which scenario.

Measurements are added, never changed or deleted. One of them is the baseline of its line and scenario: what the line
is held against from then on, set at the end of phase 2 and anew by a decision; the last one set counts, all are kept.
Any number of processes may read and add at the same time. The caller gives the time.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import apsw

from gateway.core.audit_record import NotRecordable, canonical_json
from gateway.storage.sqlite_file import FileKind, begin, open_there, rows_of, snapshot, told, transaction

FILE_NAME = "baselines.sqlite"
APPLICATION_ID = 0x5232424C  # "R2BL"

_SCHEMA_1 = f"""
CREATE TABLE measurement (
    number INTEGER PRIMARY KEY,
    site TEXT NOT NULL,
    line TEXT NOT NULL,
    configuration TEXT NOT NULL,    -- id, as in the Controller Configuration Storage
    model TEXT,                     -- id of the model that the configuration was judged on
    scenario TEXT NOT NULL,
    measured_s REAL NOT NULL,       -- Unix time, end of the measurement
    rmse_n REAL NOT NULL,
    overshoot_pct REAL NOT NULL,
    settling_s REAL NOT NULL,       -- infinite: it never settled
    effort_n2m2s REAL NOT NULL,
    conditions TEXT NOT NULL        -- JSON
);
CREATE INDEX measurement_by_configuration ON measurement (configuration);
CREATE TABLE baseline (
    number INTEGER PRIMARY KEY,
    measurement INTEGER NOT NULL REFERENCES measurement,
    time_s REAL NOT NULL,           -- Unix time
    who TEXT NOT NULL,
    why TEXT NOT NULL
);
{
    "".join(
        f"CREATE TRIGGER {table}_stays BEFORE UPDATE ON {table} BEGIN SELECT RAISE(ABORT, 'it never changes'); END;"
        f"CREATE TRIGGER {table}_is_kept BEFORE DELETE ON {table} BEGIN SELECT RAISE(ABORT, 'it is kept'); END;"
        for table in ("measurement", "baseline")
    )
}
PRAGMA application_id = {APPLICATION_ID};
"""

#: From version k (the key) to version k + 1. Every version that was ever released stays here.
MIGRATIONS: dict[int, str] = {0: _SCHEMA_1}


class BaselinesError(Exception):
    """The database cannot do what was asked; the text says why and what to do."""


KIND = FileKind(
    "performance baseline database",
    APPLICATION_ID,
    MIGRATIONS,
    BaselinesError,
    absent="there are no baselines at {path}: the gateway stores what a configuration does on the line",
    damaged="It was left as it is; restore it from a copy, or move it away",
)


class Measured(NamedTuple):
    """Metrics of a run, the corrected ones of `gateway.core.metrics`, of the worst span."""

    rmse_n: float
    overshoot_pct: float
    settling_s: float  #: inf: never
    effort_n2m2s: float


class BaselineSet(NamedTuple):
    """That a measurement was made the baseline."""

    number: int  #: of this database, in the order in which it was done
    time_s: float  #: Unix time
    who: str
    why: str


@dataclass(frozen=True)
class MeasuredRun:
    """What was measured: which configuration, on which line, how, and when."""

    site: str
    line: str
    configuration: str  #: id
    model: str | None  #: id of the model that it was judged on
    scenario: str
    measured_s: float  #: Unix time, end of the measurement
    measured: Measured
    conditions: dict[str, Any]  #: JSON: what else it depends on (period, speed, web, duration)


@dataclass(frozen=True)
class Measurement:
    """A stored one."""

    number: int
    run: MeasuredRun
    baseline: tuple[BaselineSet, ...] = ()  #: when it was made the baseline; the newest last


class Baselines:
    """`close` it, or use it as a context manager. Every method raises BaselinesError."""

    def __init__(self, path: Path, connection: apsw.Connection) -> None:
        self.path = path
        self._connection = connection

    def __enter__(self) -> "Baselines":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._connection.close()

    def add(self, run: MeasuredRun) -> Measurement:
        """Store a measurement."""
        _require_numbers(run.measured)
        try:
            conditions = canonical_json(run.conditions).decode()
        except NotRecordable as error:
            raise BaselinesError(f"conditions: {error}: nothing was stored") from error
        key = (run.site, run.line, run.configuration, run.model, run.scenario, run.measured_s)
        with told(self.path, KIND), transaction(self._connection):
            self._connection.execute(
                "INSERT INTO measurement (site, line, configuration, model, scenario, measured_s, rmse_n,"
                " overshoot_pct, settling_s, effort_n2m2s, conditions) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (*key, *run.measured, conditions),
            )
            number = self._connection.last_insert_rowid()
        return self._read("number = ?", number)[0]

    def set_baseline(self, number: int, time_s: float, who: str, why: str) -> Measurement:
        """Make a stored measurement the baseline of its line and scenario. Earlier ones stay in the history."""
        with told(self.path, KIND), transaction(self._connection):
            if not self._connection.execute("SELECT 1 FROM measurement WHERE number = ?", (number,)).get:
                raise BaselinesError(f"{self.path} has no measurement {number}: no baseline was set")
            self._connection.execute(
                "INSERT INTO baseline (measurement, time_s, who, why) VALUES (?, ?, ?, ?)", (number, time_s, who, why)
            )
        return self._read("number = ?", number)[0]

    def measurements(
        self, site: str | None = None, line: str | None = None, configuration: str | None = None,
        scenario: str | None = None,
    ) -> list[Measurement]:  # fmt: skip
        """Those of a line, a configuration (id) and a scenario, or of all; the oldest first."""
        return self._read(
            "site = coalesce(?, site) AND line = coalesce(?, line) AND configuration = coalesce(?, configuration)"
            " AND scenario = coalesce(?, scenario)",
            site,
            line,
            configuration,
            scenario,
        )

    def baseline(self, site: str, line: str, scenario: str) -> Measurement | None:
        """What the line is held against in a scenario; None: none was set yet."""
        return in_force(self.measurements(site, line, scenario=scenario)).get((site, line, scenario))

    def _read(self, where: str, *values: str | int | None) -> list[Measurement]:
        sets: dict[int, list[BaselineSet]] = {}
        with told(self.path, KIND), snapshot(self._connection):
            rows = rows_of(
                self._connection,
                "SELECT number, site, line, configuration, model, scenario, measured_s, conditions, rmse_n,"
                f" overshoot_pct, settling_s, effort_n2m2s FROM measurement WHERE {where} ORDER BY number",
                values,
            )
            of_sets = rows_of(
                self._connection, "SELECT measurement, number, time_s, who, why FROM baseline ORDER BY number"
            )
        for measurement, *given in of_sets:
            sets.setdefault(measurement, []).append(BaselineSet(*given))
        return [_measurement(row, tuple(sets.get(row[0], ())), self.path) for row in rows]


def open_baselines(path: Path) -> Baselines:
    """The database that is there. Raises BaselinesError."""
    return Baselines(path, open_there(path, KIND))


def begin_baselines(path: Path) -> Baselines:
    """The database that is there, or a new one. Raises BaselinesError."""
    return Baselines(path, begin(path, KIND))


def in_force(found: Iterable[Measurement]) -> dict[tuple[str, str, str], Measurement]:
    """By (site, line, scenario) the baseline: the one that was set last."""
    given = [(each.number, one) for one in found for each in one.baseline]
    ordered = sorted(given, key=lambda pair: pair[0])
    return {(one.run.site, one.run.line, one.run.scenario): one for _, one in ordered}


def _require_numbers(measured: Measured) -> None:
    for name, value in measured._asdict().items():
        if not (isfinite(value) or (name == "settling_s" and value == float("inf"))) or value < 0.0:
            raise BaselinesError(f"{name} = {value}: allowed is a finite number from 0 up: nothing was stored")


def _measurement(row: tuple[Any, ...], sets: tuple[BaselineSet, ...], path: Path) -> Measurement:
    number, site, line, configuration, model, scenario, measured_s, conditions, *metrics = row
    try:
        known = json.loads(conditions)
    except (ValueError, TypeError) as error:
        raise BaselinesError(f"{path}: the conditions of measurement {number} are damaged. {KIND.damaged}") from error
    run = MeasuredRun(site, line, configuration, model, scenario, measured_s, Measured(*metrics), known)
    return Measurement(number, run, sets)
