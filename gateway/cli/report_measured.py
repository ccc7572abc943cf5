"""What the line itself has shown, in the report: kept measurements, tensions around each deployment, alarms."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from operator import itemgetter
from pathlib import Path

import numpy as np

from gateway.cli.commission_measurements import kept as kept_measurements
from gateway.cli.line_records import FAR_S, LineRecords, Recorded
from gateway.cli.report import Chart, Section, Series, Table
from gateway.cli.report_adaptations import SHORT, what_of, when
from gateway.commissioning.convergence import Convergence
from gateway.core.audit_record import AuditRecord
from gateway.core.line import Line
from gateway.core.line_past import TensionsBetween
from gateway.core.line_problem import printable
from gateway.core.signals import FloatArray
from gateway.supervisor.baselines import FILE_NAME as BASELINES
from gateway.supervisor.baselines import BaselinesError, Measurement, in_force, open_baselines
from gateway.supervisor.historian import FILE_NAME as HISTORY
from gateway.supervisor.history import History, HistoryError, StoredEvent
from gateway.supervisor.past_tensions import NotTold, thinned
from gateway.supervisor.record_words import in_a_sentence

BEFORE_S, AFTER_S = 5.0, 20.0  #: of a deployment, that are drawn
POINTS = 600
MOST_CHARTS, MOST_ALARMS = 12, 200
ALARM_EVENTS = ("alarm", "alarm-ended")
ALARM_RECORDS = ("acknowledged", "shelved", "line-stopped")


@dataclass
class Measured:
    measurements: list[Measurement] = field(default_factory=list[Measurement])
    baselines: set[int] = field(default_factory=set[int])  #: numbers of measurements that are in force
    of_proposals: dict[str, Convergence] = field(default_factory=dict[str, Convergence])
    deployments: int = 0  #: around the newest of which there are charts
    around: list[Chart] = field(default_factory=list[Chart])
    alarms: list[StoredEvent] = field(default_factory=list[StoredEvent])
    problems: list[str] = field(default_factory=list[str])


def read_measured(folder: Path, line: Line, records: LineRecords, since_s: float, names: Mapping[str, str]) -> Measured:
    """`names`: of configurations, by hash. Never raises for what is damaged or not there: it tells."""
    found = Measured()
    try:
        if (folder / BASELINES).exists():
            with open_baselines(folder / BASELINES) as database:
                every = database.measurements(line.site, line.line)
            found.measurements = [one for one in every if one.run.measured_s >= since_s]
            found.baselines = {one.number for one in in_force(every).values()}
            found.of_proposals = kept_measurements(folder, line)
    except BaselinesError as error:
        found.problems.append(str(error))
    try:
        with History(folder / HISTORY) as history:
            found.alarms = [one for one in history.events(since_s, FAR_S) if one.kind in ALARM_EVENTS]
            deployed = _deployed(records, since_s)
            found.deployments = len(deployed)
            try:
                found.around.extend(_around(history, line, records, deployed[-MOST_CHARTS:], names))
            except (HistoryError, NotTold) as error:
                found.problems.append(f"of tensions around deployments not all is told: {error}")
            found.problems += [f"of the history is damaged: {one}" for one in history.damaged]
    except HistoryError as error:
        found.problems.append(f"of alarms, and of tensions around deployments, nothing is told: {error}")
    return found


def measured_section(found: Measured, names: Mapping[str, str]) -> Section:
    """Measured, not simulated."""
    heads = ("Measured, UTC", "Configuration", "What", "RMSE, N", "Overshoot, %", "Settling, s", "Effort, N²m²s", "")
    rows = tuple(_row(one, found, names) for one in found.measurements)
    table = Table(
        "Measured on the line; figures of the worst span.", heads, rows, frozenset({3, 4, 5, 6}),
        note="A baseline is what the line is held against from then on.",
    )  # fmt: skip
    said = () if rows else ("No measurement was kept in this time.",)
    if found.around:
        cut = found.deployments > MOST_CHARTS
        which = f"the newest {MOST_CHARTS} of {found.deployments} deployments" if cut else "each deployment"
        said += (f"Below: tensions from {BEFORE_S:g} s before to {AFTER_S:g} s after {which}, as measured.",)
    return Section("Measured on the line", said, (table,) if rows else (), tuple(found.around))


def alarms_section(found: Measured, records: Sequence[AuditRecord]) -> Section:
    """`records`: of people who have seen or shelved one."""
    told = [(one.wall_s, one.text) for one in found.alarms]
    told += [(one.wall_s, in_a_sentence(one.kind, one.who.name, one.what)) for one in records]
    rows = tuple((when(wall_s), printable(text)) for wall_s, text in sorted(told)[-MOST_ALARMS:])
    if not rows:
        return Section("Alarms", ("There were none in this time, as far as the history goes.",))
    note = f"The newest {MOST_ALARMS} of {len(told)}." if len(told) > MOST_ALARMS else ""
    return Section("Alarms", tables=(Table("In the order in which they came.", ("UTC", "What"), rows, note=note),))


def _row(one: Measurement, found: Measured, names: Mapping[str, str]) -> tuple[str, ...]:
    run = one.run
    figures = (f"{value:.4g}" if isfinite(value) else "never" for value in run.measured)
    mark = "the baseline" if one.number in found.baselines else "a baseline once" if one.baseline else ""
    name = names.get(run.configuration, run.configuration[:SHORT])
    return (when(run.measured_s), name, printable(run.scenario), *figures, mark)


def _deployed(records: LineRecords, since_s: float) -> list[tuple[Recorded, float]]:
    """What was deployed since, with when (Unix time), the oldest first."""
    steps = [(one, step) for one in records.proposals if (step := one.step("deployed")) is not None]
    return sorted(((one, step.wall_s) for one, step in steps if step.wall_s >= since_s), key=itemgetter(1))


def _around(
    history: History,
    line: Line,
    records: LineRecords,
    deployed: Sequence[tuple[Recorded, float]],
    names: Mapping[str, str],
) -> Iterator[Chart]:
    """Of those of which the history has something. Raises HistoryError, NotTold."""
    for one, wall_s in deployed:
        asked = TensionsBetween(from_wall_s=wall_s - BEFORE_S, to_wall_s=wall_s + AFTER_S, points=POINTS)
        told = thinned(history, asked, line.control.period_s)
        time_s: FloatArray = np.array(told.wall_s) - wall_s
        rows = np.array(told.tension_n, dtype=np.float64)  # None becomes NaN
        forward = np.flatnonzero(np.diff(time_s, prepend=-np.inf) > 0.0)
        if len(forward) < 2:
            continue
        entry = records.book.entries.get(one.hash)
        name = what_of(one) if entry is None else names.get(entry.changes, what_of(one))
        series = tuple(Series(f"span {k + 1}", row[forward]) for k, row in enumerate(rows))
        title = f"Measured: {name} takes over at 0 s, {when(wall_s)} UTC; tension"
        yield Chart(title, "N", time_s[forward], series)
