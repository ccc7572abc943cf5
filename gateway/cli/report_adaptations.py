"""Every change that was proposed for a line, in the report: diagnosis, change, verdict, decision, what came of it."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

from gateway.cli.adaptation_story import Adaptation, adaptation_story
from gateway.cli.change_result import change_of
from gateway.cli.commission_result import tried_of
from gateway.cli.demo_adaptations import DIAGNOSES, concluded
from gateway.cli.demo_asked_page import verdict_words
from gateway.cli.demo_result import AskedResult, ChangeResult
from gateway.cli.line_records import LineRecords, Recorded
from gateway.cli.report import Section, Story, Table
from gateway.cli.report_courses import Named
from gateway.commissioning.convergence import Convergence
from gateway.commissioning.past import Step, past_of
from gateway.core.audit_record import AuditRecord
from gateway.core.controller import config_hash
from gateway.core.deployment import Region
from gateway.core.line_problem import printable
from gateway.core.proposal import Evidence, GainsChange, Promise
from gateway.supervisor.lifecycle import Stage
from gateway.supervisor.record_words import in_a_sentence

MOST_STORIES = 40
SHORT = 12  #: letters of a hash
KINDS = {"gains": "controller", "experiment": "experiment", "model": "model"}
DECISION = ("approved-once", "approved", "approval-lapsed", "rejected", "expired", "superseded")
ON_THE_LINE = ("deploying", "not-deployed", "put-off", "deployed", "experiment-begins", "model-in-service")
RESULT = ("kept", "rolled-back", "experiment-ends")


def named_of(records: LineRecords, started_with: Named | None) -> list[Named]:
    """The configurations that were kept, in that order, each once, after the one that the line was started with."""
    found: dict[str, Named] = {} if started_with is None else {started_with.hash: started_with}
    adapted = 0
    for one in records.proposals:
        change = one.proposal.change
        if not isinstance(change, GainsChange) or one.shown.stage != Stage.KEPT:
            continue
        hash_, entry = config_hash(change.controller), records.book.entries[one.hash]
        if hash_ in found:
            continue
        first = past_of(one.shown).step is Step.FIRST
        adapted += not first
        found[hash_] = Named("First" if first else f"Adapt{adapted}", hash_, change.controller, entry.region)
    return list(found.values())


def started_with(records: LineRecords) -> Named | None:
    """What controlled the line when the first change was judged."""
    context = next((one.context for one in records.proposals if one.context is not None), None)
    if context is None:
        return None
    return Named("Initial", config_hash(context.in_service), context.in_service, None)


def changes_of(proposals: Sequence[Recorded], measured: Mapping[str, Convergence]) -> list[ChangeResult]:
    """In short; `measured`: by proposal."""
    found: list[ChangeResult] = []
    for one in proposals:
        past, approved = past_of(one.shown), one.step("approved")
        tried = tried_of(past, one.shown, measured.get(one.hash))
        found.append(change_of(tried, one.shown, None if approved is None else approved.who))
    return found


def proposals_section(proposals: Sequence[Recorded], changes: Sequence[ChangeResult]) -> Section:
    """One row each."""
    heads = ("Proposed, UTC", "What", "By", "Verdict", "Decided by", "Came to")
    rows = tuple(
        (
            when(one.steps[0].wall_s), what_of(one), one.proposal.author, verdict_words(change).partition(";")[0],
            _decided_by(one), _came_to(one),
        )
        for one, change in zip(proposals, changes, strict=True)
    )  # fmt: skip
    said = () if rows else ("Nothing has been proposed in this time: how the line is controlled has not changed.",)
    return Section("Changes so far", said, (Table("Every proposal, the oldest first.", heads, rows),) if rows else ())


def adaptations_section(
    proposals: Sequence[Recorded], changes: Sequence[ChangeResult], asked: Sequence[AskedResult],
    named: Sequence[Named], measured: Mapping[str, Convergence],
) -> Section:  # fmt: skip
    """One story each, the newest where there are many."""
    names = {one.hash: one.name for one in named}
    pairs = list(zip(proposals, changes, strict=True))[-MOST_STORIES:]
    stories = tuple(_story(one, change, asked, names, measured.get(one.hash)) for one, change in pairs)
    said = ["Times are UTC. What somebody has written is quoted; everything else is computed by the gateway."]
    if left := len(proposals) - len(pairs):
        said.append(f"The {left} before these stand in the table above; `--since` chooses a time.")
    return Section("Change by change", tuple(said), stories=stories)


def _story(
    one: Recorded, change: ChangeResult, asked: Sequence[AskedResult], names: Mapping[str, str],
    measured: Convergence | None,
) -> Story:  # fmt: skip
    name = names.get(change.configuration, "") if one.shown.stage == Stage.KEPT else ""
    what = f"{what_of(one)}, {one.shown.stage}"
    diagnoses = [each for each in asked if each.proposal == one.hash and each.decision == DIAGNOSES]
    return adaptation_story(
        Adaptation(
            f"{name}: {what}" if name else f"{what[0].upper()}{what[1:]}",
            diagnosis=[*map(concluded, diagnoses), *map(_evidence, _telling(one.proposal.evidence))],
            change=[*one.shown.difference, *map(_promise, one.proposal.predicted)],
            verdict=_verdict(one, change),
            decision=[_decided(each) for each in _steps(one, DECISION)],
            on_the_line=[_told(each) for each in _steps(one, ON_THE_LINE) if each.kind != "deploying"]
            + _region_words(one),
            result=[*_results(one), *([] if measured is None else [f"Measured on the line: {measured.text}"])],
            lead=f"The reason that {one.proposal.author} gave:",
            quote=one.proposal.reason,
            judged=one.shown.verdict,
        )
    )


def what_of(one: Recorded) -> str:
    return f"{KINDS[one.proposal.kind]} {one.hash[:SHORT]}"


def when(wall_s: float) -> str:
    return f"{datetime.fromtimestamp(wall_s, UTC):%Y-%m-%d %H:%M:%S}"


def _steps(one: Recorded, kinds: Sequence[str]) -> list[AuditRecord]:
    return [step for step in one.steps if step.kind in kinds]


def _told(record: AuditRecord) -> str:
    return f"{when(record.wall_s)}: {in_a_sentence(record.kind, record.who.name, record.what)}"


def _decided(record: AuditRecord) -> str:
    """With the certificate behind it, and the hash of what was shown."""
    certificate = "" if record.who.certificate is None else f", certificate {record.who.certificate[:SHORT]}"
    shown = record.what.get("shown")
    over = f", over what was shown as {shown[:SHORT]}" if isinstance(shown, str) else ""
    return f"{_told(record)}{certificate}{over}"


def _decided_by(one: Recorded) -> str:
    decided = next((step for step in reversed(one.steps) if step.kind in ("approved", "rejected")), None)
    if decided is None:
        return "-"
    return "its verdict alone" if decided.what.get("by") == "verdict" else printable(decided.who.name)


def _came_to(one: Recorded) -> str:
    return f"{one.shown.stage}{f': {printable(one.shown.why)}' if one.shown.why else ''}"


def _verdict(one: Recorded, change: ChangeResult) -> list[str]:
    judged = one.step("accepted") or one.step("refused")
    at = "" if judged is None else f"{when(judged.wall_s)}: "
    return [f"{at}{verdict_words(change)}", *change.against]


def _region_words(one: Recorded) -> list[str]:
    deploying = one.step("deploying")
    if deploying is None:
        return []
    region = Region.model_validate(deploying.what.get("region", {}))
    parts = [
        f"{what} up to {most:.3g} {unit}"
        for what, most, unit in (
            ("speed", region.speed_max_m_per_s, "m/s"),
            ("steps of tension", region.tension_step_max_n, "N"),
            ("steps of speed", region.speed_step_max_m_per_s, "m/s"),
        )
        if most is not None
    ]
    return [f"judged for {', '.join(parts)}"] if parts else []


def _results(one: Recorded) -> list[str]:
    """With how long it was on probation."""
    deployed = one.step("deployed")
    told: list[str] = []
    for step in _steps(one, RESULT):
        after = "" if deployed is None else f", after {step.wall_s - deployed.wall_s:.1f} s on probation"
        told.append(f"{_told(step)}{after}")
    return told


def _telling(evidence: Sequence[Evidence]) -> list[Evidence]:
    """Without those by which the commissioning knows its own."""
    return [one for one in evidence if one.value is not None and not one.what.startswith("commissioning: ")]


def _evidence(one: Evidence) -> str:
    return f"Rests on: {printable(one.what)}, {one.value:.4g}{f' {printable(one.unit)}' if one.unit else ''}"


def _promise(one: Promise) -> str:
    figures = (("RMSE", one.rmse_n, "N"), ("overshoot", one.overshoot_pct, "%"), ("settling", one.settling_s, "s"))
    said = ", ".join(f"{name} {value:.3g} {unit}" for name, value, unit in figures if value is not None)
    return f"promised for {one.scenario}: {said or 'nothing'}"
