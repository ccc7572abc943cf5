"""What was measured of a configuration, what it is put down to, and what has proven itself, as documents. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, cast

from gateway.core.controller import Controller
from gateway.core.line_queries import Generated
from gateway.core.questions import Decision
from gateway.supervisor.baselines import Measurement
from gateway.supervisor.configurations import Archived
from gateway.supervisor.knowledge.words import listed, moment, number, on, quoted, section, whole

_SERVES: list[Decision] = [
    "adapt.diagnosis", "adapt.change", "adapt.convergence", "monitor.detect", "monitor.diagnosis", "monitor.action",
    "design.weights", "design.selection",
]  # fmt: skip
MOST_RECENT = 12
_FOLLOWS = {
    "newer-model": "the line does otherwise than the model foresees: a newer model is wanted",
    "all-data": "the line does as the model foresees, which is of one experiment: a model of all data is wanted",
    "calmer": "the model has foreseen it: a calmer configuration on the same model is wanted",
    "leave": "nothing significant is left to gain",
}


@dataclass(frozen=True)
class ControlNow:
    """By what a line is controlled and judged. None: nobody knows yet."""

    configuration: str | None  #: hash
    last_known_good: str | None
    epoch: int
    model: str | None  #: hash
    model_version: int | None = None
    since_s: float | None = None  #: Unix time of the last change
    controller: Controller | None = None


def in_words(one: Measurement) -> str:
    """A sentence."""
    found = one.run.measured
    settled = f"settled in {number(found.settling_s, 's')}" if isfinite(found.settling_s) else "never settled"
    gap = _gap(one)
    beside = "" if gap is None else f", the error {gap:+.0%} beside what the model had predicted"
    return (
        f"Measured {on(moment(one.run.measured_s))}, {one.run.scenario}: tracking error {number(found.rmse_n, 'N')}, "
        f"overshoot {number(found.overshoot_pct, '%')}, {settled}{beside}."
    )


def of_measurement(one: Measurement) -> Generated:
    run, found = one.run, _found(one)
    date = moment(run.measured_s)
    diagnosis = found.get("diagnosis")
    return Generated(
        name=f"measurement-{one.number}",
        title=f"A measurement on this line, {on(date)}: tracking error and prediction",
        text=whole([
            in_words(one),
            f"Configuration {run.configuration[:12]} controlled the line"
            + (f", judged by model {run.model[:12]}." if run.model else ", before any model was accepted."),
            listed("Spans", _spans(found)),
            section("What it was put down to", *_diagnosis(diagnosis)) if isinstance(diagnosis, dict) else "",
            listed("Baseline", (f"It was made the baseline {on(moment(each.time_s))} by {each.who}: {quoted(each.why)}"
                                for each in one.baseline)),
        ]),
        date=date,
        keywords=["measurement", "performance", "tracking error", "mismatch", "diagnosis", "convergence", "baseline"],
        serves=_SERVES,
    )  # fmt: skip


def of_archive(id_: str, archived: Archived) -> Generated:
    date = moment(archived.time_s)
    return Generated(
        name=f"archived-{archived.name}",
        title=f"The configuration of this line that is archived as {archived.name}",
        text=whole([
            f"Configuration {id_[:12]} has been archived as {archived.name} {on(date)}, by {archived.who}: it has "
            "proven itself.",
            section("Why", quoted(archived.why)),
        ]),
        date=date,
        keywords=["archived", "stable", "proven", archived.name],
        serves=_SERVES,
    )  # fmt: skip


def of_control(now: ControlNow) -> Generated:
    """What is in service."""
    law = "" if now.controller is None else f" ({now.controller.kind})"
    configuration = (
        f"Configuration {now.configuration[:12]}{law} controls the line, as epoch {now.epoch} of its deployments."
        if now.configuration
        else "No configuration is known to control the line: the loop has not run since records began."
    )
    good = f"The last known good one is {now.last_known_good[:12]}." if now.last_known_good else ""
    version = "" if now.model_version is None else f"version {now.model_version}, "
    model = (
        f"Proposals are judged by the accepted model {version}{now.model[:12]}."
        if now.model
        else "No model has been accepted yet: what is known of the line is what its file believes."
    )
    return Generated(
        name="in-service",
        title="What is in service on this line now: configuration, epoch, model",
        text=" ".join(filter(None, (configuration, good, model))),
        date=moment(now.since_s),
        keywords=["in service", "controller", "control law", "configuration now", "which model"],
    )  # fmt: skip


def of_recent(documents: Sequence[Generated]) -> Generated:
    """What happened last, of documents of what happened."""
    newest = sorted(documents, key=lambda one: one.date, reverse=True)[:MOST_RECENT]
    return Generated(
        name="recent",
        title="What happened last on this line",
        text=listed("The newest first", (f"{on(one.date).removeprefix('on ')}: {one.title}." for one in newest))
        or "Nothing is on record yet.",
        date=newest[0].date if newest else "",
        keywords=["last deployment", "last measurement", "last experiment", "last refusal", "history"],
    )


def _found(one: Measurement) -> dict[str, Any]:
    """What the phases have kept of it; nothing where somebody else has measured."""
    found = one.run.conditions.get("found")
    return cast("dict[str, Any]", found) if isinstance(found, dict) else {}


def _gap(one: Measurement) -> float | None:
    gap = _found(one).get("gap")
    return float(gap) if isinstance(gap, int | float) else None


def _spans(found: dict[str, Any]) -> list[str]:
    spans, predicted = found.get("spans"), found.get("predicted")
    if not isinstance(spans, dict):
        return []
    told: list[str] = []
    for name, one in cast("dict[str, Any]", spans).items():
        foreseen = cast("dict[str, Any]", predicted).get(name) if isinstance(predicted, dict) else None
        told.append(f"Span {name}: {_figures(one)}; predicted: {_figures(foreseen)}.")
    return told


def _figures(one: Any) -> str:
    """Of a span, as the phases write it (`gateway.commissioning.convergence.SpanFigures`)."""
    if not isinstance(one, dict):
        return "not known"
    figures = cast("dict[str, Any]", one)
    units = (("error", "rmse_n", "N"), ("overshoot", "overshoot_pct", "%"), ("settled in", "settling_s", "s"))
    told = [
        f"{word} {number(figures[key], unit)}" if isinstance(figures.get(key), int | float) else f"{word}: never"
        for word, key, unit in units
    ]
    return ", ".join(told)


def _diagnosis(said: dict[str, Any]) -> Sequence[str]:
    follows, by = str(said.get("follows", "")), str(said.get("by", "nobody"))
    return f"Decided by {by}: {_FOLLOWS.get(follows, follows)}.", quoted(str(said.get("because", "")))
