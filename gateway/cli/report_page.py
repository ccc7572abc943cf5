"""A line's report as a page: what became of how it is controlled, on which evidence, and whether the records hold."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from gateway.cli.asked_result import asked_result, interactions_in
from gateway.cli.demo_asked_page import asked_section
from gateway.cli.line_records import LineRecords, Recorded, unconfirmed_in
from gateway.cli.origin import command_line, machine, now_iso, versions_of
from gateway.cli.report import Page, Section, Table
from gateway.cli.report_adaptations import (
    adaptations_section,
    changes_of,
    named_of,
    proposals_section,
    started_with,
    when,
)
from gateway.cli.report_courses import Conditions, Named, Simulated, cases_of, simulated
from gateway.cli.report_measured import ALARM_RECORDS, Measured, alarms_section, measured_section, read_measured
from gateway.cli.report_simulated import case_section, chosen_of, summary_section
from gateway.core.audit_record import AuditRecord
from gateway.core.interactions import Interaction
from gateway.core.line import Line
from gateway.core.line_model import LineModel, model_hash
from gateway.core.proposal import ModelChange
from gateway.core.scenario import Scenario
from gateway.supervisor.configurations import FILE_NAME as CONFIGURATIONS
from gateway.supervisor.configurations import ConfigurationsError, open_configurations
from gateway.supervisor.interactions import InteractionsError
from gateway.supervisor.lifecycle import Stage
from gateway.supervisor.model_store import ModelsError
from gateway.supervisor.models import FILE_NAME as MODELS
from gateway.supervisor.models import open_repository

LIBRARIES = ("r2rgate", "numpy")
SHORT = 12
PROBLEMS_FIRST = 3  #: that are told in the first sentences


@dataclass(frozen=True)
class Told:
    """Everything that the page tells of."""

    line: Line
    folder: Path
    since_s: float  #: Unix time; 0: from the beginning
    records: LineRecords
    proposals: list[Recorded]  #: of the time
    named: list[Named]  #: all configurations that were kept
    measured: Measured
    interactions: list[Interaction]
    model: LineModel | None
    problems: list[str]


def page_of(line: Line, folder: Path, since_s: float, records: LineRecords, tell: Callable[[str], None]) -> Page:
    """`render_page` makes the page of it."""
    told = _told(line, folder, since_s, records)
    conditions, cases = Conditions(line, told.model), cases_of(line)
    shown = [_changes(told, one) for one in told.proposals if one.shown.stage == Stage.KEPT]
    chosen = chosen_of(told.named, shown)
    reference = conditions.reference if chosen else None
    beside = chosen if reference is None else [*chosen, reference]
    found = simulated(conditions, beside, cases, tell)
    changes = changes_of(told.proposals, told.measured.of_proposals)
    asked = asked_result(told.interactions, [one.shown for one in records.proposals])
    names = {one.hash: one.name for one in told.named}
    spans = [span.name for span in line.spans]
    sections = [_line_section(told), proposals_section(told.proposals, changes)]
    if told.proposals:
        sections.append(adaptations_section(told.proposals, changes, asked, told.named, told.measured.of_proposals))
    if chosen:
        sections.append(summary_section(conditions, beside, cases, found))
        sections += [case_section(case, beside, found[case.name], line.control.period_s, spans) for case in cases]
    sections += [
        measured_section(told.measured, names),
        asked_section(asked, changes, told.interactions, folder),
        alarms_section(told.measured, _seen(told)),
        _audit_section(told),
    ]
    return Page(
        title="How the line came to be controlled as it is",
        origin=f"Line {line.site}/{line.line}",
        when=now_iso(),
        command=command_line(),
        versions=versions_of(LIBRARIES),
        machine=machine(),
        audit_head=f"{records.found.records}:{records.found.head}" if records.found.records else "",
        answer=tuple(_answer(told, chosen, cases, found)),
        sections=tuple(sections),
        notes=(
            "Simulated and measured figures stand apart, and are marked: a simulation shows configurations under "
            "identical conditions, which a line in production never gives.",
            f"Everything was read from {folder}; nothing there was changed.",
        ),
    )


def _told(line: Line, folder: Path, since_s: float, records: LineRecords) -> Told:
    problems = list(records.problems)
    first = started_with(records)
    if first is None:
        first = _in_service(line, folder, records, problems)
    named = named_of(records, first)
    measured = read_measured(folder, line, records, since_s, {one.hash: one.name for one in named})
    try:
        interactions = [one for one in interactions_in(folder) if datetime.fromisoformat(one.at).timestamp() >= since_s]
    except InteractionsError as error:
        interactions = list[Interaction]()
        problems.append(str(error))
    model = _model(line, folder, records, problems)
    proposals = [one for one in records.proposals if one.steps[-1].wall_s >= since_s]
    return Told(
        line, folder, since_s, records, proposals, named, measured, interactions, model, problems + measured.problems
    )


def _in_service(line: Line, folder: Path, records: LineRecords, problems: list[str]) -> Named | None:
    """Where nothing was ever judged, what controls the line."""
    hash_ = records.book.in_service
    if hash_ is None:
        return None
    try:
        with open_configurations(folder / CONFIGURATIONS) as storage:
            one = storage.get(line.site, line.line, hash_)
    except ConfigurationsError as error:
        problems.append(str(error))
        return None
    return None if one is None or one.controller is None else Named("Initial", hash_, one.controller, None)


def _model(line: Line, folder: Path, records: LineRecords, problems: list[str]) -> LineModel | None:
    """The accepted one, as the audit has it, else the repository."""
    wanted = records.book.model
    if wanted is None:
        return None
    for one in reversed(records.proposals):
        change = one.proposal.change
        if isinstance(change, ModelChange) and model_hash(change.model) == wanted:
            return change.model
    try:
        with open_repository(folder / MODELS) as models:
            entry = models.get(wanted)
    except ModelsError as error:
        problems.append(str(error))
        return None
    if entry is None or entry.model is None:
        problems.append(f"the accepted model, {wanted[:SHORT]}, is not to be had: the line's file stands in its place")
        return None
    return entry.model


def _seen(told: Told) -> list[AuditRecord]:
    """What people have said of alarms."""
    return [one for one in told.records.others if one.kind in ALARM_RECORDS and one.wall_s >= told.since_s]


def _changes(told: Told, one: Recorded) -> str:
    """Hash of the configuration that a kept proposal brought."""
    return told.records.book.entries[one.hash].changes


def _answer(
    told: Told, chosen: list[Named], cases: tuple[Scenario, ...], found: dict[str, list[Simulated | str]]
) -> list[str]:
    said: list[str] = []
    problems = told.records.found.problems
    if problems:
        more = f" And {len(problems) - PROBLEMS_FIRST} more." if len(problems) > PROBLEMS_FIRST else ""
        first = " ".join(f"{one[0].upper()}{one[1:]}." for one in problems[:PROBLEMS_FIRST])
        said.append(f"▲ The audit is NOT SOUND: what follows is what can still be read. {first}{more}")
    said += unconfirmed_in(told.records.book)
    said.append(_in_numbers(told))
    said += _came(chosen, cases, found)
    if not problems:
        said.append(f"The audit is sound: {told.records.found.records} records.")
    return said


def _in_numbers(told: Told) -> str:
    if not told.proposals:
        since = f" since {when(told.since_s)} UTC" if told.since_s else ""
        return f"Nothing has been proposed on this line{since}: how it is controlled has not changed."
    stages = [one.shown.stage for one in told.proposals]
    counts = ", ".join(f"{stages.count(stage)} {stage}" for stage in (*Stage, "unknown") if stage in stages)
    since = f" from {when(told.since_s)} UTC on" if told.since_s else ""
    amount = f"{len(stages)} change{'' if len(stages) == 1 else 's'}"
    return f"{amount} of how the line is controlled {'was' if len(stages) == 1 else 'were'} proposed{since}: {counts}."


def _came(chosen: list[Named], cases: tuple[Scenario, ...], found: dict[str, list[Simulated | str]]) -> list[str]:
    """From the first to the last that is shown, case by case."""
    if len(chosen) < 2:
        return []
    parts: list[str] = []
    for case in cases:
        first, last = found[case.name][0], found[case.name][len(chosen) - 1]
        if isinstance(first, Simulated) and isinstance(last, Simulated):
            parts.append(f"{case.heading.lower()} from {first.rmse_n:.3g} to {last.rmse_n:.3g} N")
    if not parts:
        return []
    return [f"Simulated under identical conditions, from {chosen[0].name} to {chosen[-1].name}: {', '.join(parts)}."]


def _line_section(told: Told) -> Section:
    line, book = told.line, told.records.book
    limits = line.limits
    names = {one.hash: one.name for one in told.named}
    hash_ = book.in_service
    in_service = "not known" if hash_ is None else f"{names.get(hash_, 'configuration')} {hash_[:SHORT]}"
    rows = (
        ("Spans, and rollers at their ends", ", ".join(span.name for span in line.spans)),
        ("Period and latency", f"{1e3 * line.control.period_s:g} and {1e3 * line.control.latency_s:g} ms"),
        ("Tension", f"{limits.tension_min_n:g} to {limits.tension_max_n:g} N"),
        ("Torque per drive", f"up to {limits.torque_nm:g} Nm, {limits.torque_rate_nm_per_s:g} Nm/s"),
        ("Speed", f"up to {limits.speed_max_m_per_s:g} m/s"),
        ("Steps at once", f"{limits.tension_step_max_n:g} N, {limits.speed_step_max_m_per_s:g} m/s"),
        ("In service", f"{in_service}, epoch {book.epoch}{', unconfirmed' if book.is_unconfirmed else ''}"),
        ("Model that judges", "none yet: the line's file" if book.model is None else book.model[:SHORT]),
    )
    problems = tuple(f"Caution: {text}." for text in told.problems)
    return Section("The line", problems, (Table("As its file and the records have it now.", ("", ""), rows),))


def _audit_section(told: Told) -> Section:
    found = told.records.found
    rows = [("Records", str(found.records)), ("Head of the last", found.head)]
    rows += [("Verified", "sound")] if found.sound else [("NOT SOUND", text) for text in found.problems]
    table = Table("The audit, verified when this was made (r2rgate audit verify).", ("", ""), tuple(rows))
    return Section("Is it on record", tables=(table,))
