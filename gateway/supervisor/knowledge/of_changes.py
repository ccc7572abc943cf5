"""What was deployed, refused, or tried as an experiment, each as a document: what, why, by how much, its outcome. Pure.

What people and agents have written stands there as a quotation: it is data, and whoever reads it is told so.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from gateway.core.controller import Controller
from gateway.core.differences import of_controllers, of_experiment
from gateway.core.line_queries import Generated
from gateway.core.proposal import ExperimentChange, GainsChange, Kind, Promise, Proposal
from gateway.core.questions import Decision
from gateway.core.verdict import OF_THE_MOMENT, RuleFinding, ScenarioFigures, Verdict
from gateway.supervisor.baselines import Measurement
from gateway.supervisor.knowledge.of_measurements import in_words
from gateway.supervisor.knowledge.words import listed, moment, number, on, quoted, section, whole
from gateway.supervisor.lifecycle import Entry, Stage

CLOSEST = 8  #: rules whose margins are told
MOST_MEASURED = 5
REFUSED = {
    Stage.REFUSED: "refused by the gate",
    Stage.REJECTED: "rejected by a person",
    Stage.NOT_DEPLOYED: "not taken by the loop",
}
_OVER = (Stage.DONE, Stage.KEPT, Stage.ROLLED_BACK)  #: and it has been on the line
_SERVES: dict[Kind, list[Decision]] = {
    "gains": ["design.architecture", "design.weights", "design.tuning", "design.selection", "adapt.diagnosis",
              "adapt.change", "adapt.convergence", "monitor.diagnosis", "monitor.action"],
    "experiment": ["identify.data", "identify.experiment", "adapt.diagnosis", "adapt.change"],
    "model": ["identify.data", "identify.structure", "identify.method", "identify.fidelity", "adapt.diagnosis"],
}  # fmt: skip
_NAMES: dict[Kind, str] = {"gains": "configuration", "experiment": "experiment", "model": "model"}


@dataclass(frozen=True)
class Change:
    """A proposal, and all that lies beside it."""

    entry: Entry
    proposal: Proposal
    verdict: Verdict | None
    before: Controller | None = None  #: that it would change; None: it is not known any more
    measured: Sequence[Measurement] = ()  #: of the configuration that it brought, the oldest first


def teaches(entry: Entry) -> bool:
    """Whether there is something to know of it: it was on the line, or somebody was against it."""
    return entry.stage in _OVER or entry.stage in REFUSED


def of_change(change: Change) -> Generated | None:
    """None: nothing was against it but the moment, which is over."""
    entry = change.entry
    if entry.stage in REFUSED:
        return None if _of_the_moment(change) else _refusal(change)
    if entry.kind == "gains":
        return _deployment(change)
    return _experiment(change) if entry.kind == "experiment" else None  # a model is a document of its own


def _deployment(change: Change) -> Generated:
    entry, date = change.entry, moment(change.entry.since_s)
    law = change.proposal.change.controller.kind if isinstance(change.proposal.change, GainsChange) else ""
    ended = f"rolled back {on(date)}" if entry.stage is Stage.ROLLED_BACK else f"kept {on(date)}"
    return Generated(
        name=f"deployment-{entry.proposal[:16]}",
        title=f"Deployment {entry.epoch} of this line: a configuration with law {law}, {ended}",
        text=whole([
            f"Configuration {entry.changes[:12]} ({law}) was deployed as epoch {entry.epoch}, proposed by "
            f"{entry.author}. It was {ended}.",
            section("Why it was rolled back", quoted(entry.why)) if entry.stage is Stage.ROLLED_BACK else "",
            section("Why it was proposed", quoted(change.proposal.reason)),
            *_judged(change),
            listed("What the line did with it", map(in_words, change.measured[-MOST_MEASURED:])),
        ]),
        date=date,
        keywords=["deployment", law, "rolled back" if entry.stage is Stage.ROLLED_BACK else "kept", entry.changes[:12]],
        serves=_SERVES["gains"],
    )  # fmt: skip


def _refusal(change: Change) -> Generated:
    entry, date = change.entry, moment(change.entry.since_s)
    against = _against(change.verdict)
    what, how = _NAMES[entry.kind], REFUSED[entry.stage]
    rules = ", ".join(dict.fromkeys(one.rule for one in against))
    return Generated(
        name=f"refusal-{entry.proposal[:16]}",
        title=f"A {what} {how} {on(date)}{f': {rules}' if rules else ''}"[:300],
        text=whole([
            f"A {what} that {entry.author} had proposed was {how} {on(date)}.",
            listed("By which rules, and by how much", map(_margin, against))
            or section("What was said", quoted(entry.why)),
            section("Why it was proposed", quoted(change.proposal.reason)),
            listed("What it would have changed", _differences(change)),
            listed("What was predicted of it", _predicted(change)),
        ]),
        date=date,
        keywords=["refused", "refusal", what, *dict.fromkeys(one.rule for one in against)],
        serves=_SERVES[entry.kind],
    )  # fmt: skip


def _experiment(change: Change) -> Generated:
    entry, date = change.entry, moment(change.entry.since_s)
    asked = change.proposal.change
    described = asked.experiment.description if isinstance(asked, ExperimentChange) else ""
    ended = "ended early" if entry.why else "went to its end"
    return Generated(
        name=f"experiment-{entry.proposal[:16]}",
        title=f"An experiment on this line that {ended}, {on(date)}",
        text=whole([
            f"An experiment that {entry.author} had proposed {ended} {on(date)}.",
            section("Why it ended", quoted(entry.why)) if entry.why else "",
            listed("What was done", _differences(change)),
            section("What it was for", quoted(described or change.proposal.reason)),
            *_judged(change)[1:],
        ]),
        date=date,
        keywords=["experiment", "excitation", "recording", "ended early" if entry.why else "complete"],
        serves=_SERVES["experiment"],
    )  # fmt: skip


def _judged(change: Change) -> list[str]:
    """What it changes, what was predicted, and how near it came to what the rules allow."""
    return [
        listed("What it changed", _differences(change)),
        listed("What was predicted of it", _predicted(change)),
        listed("How close it came to what the gate allows", map(_margin, _closest(change.verdict))),
    ]


def _differences(change: Change) -> list[str]:
    asked = change.proposal.change
    if isinstance(asked, ExperimentChange):
        return of_experiment(asked.experiment)
    if isinstance(asked, GainsChange) and change.before is not None:
        return of_controllers(change.before, asked.controller)
    return []


def _predicted(change: Change) -> list[str]:
    simulated = [] if change.verdict is None else [
        f"simulated on the model, {one.scenario}, {one.configuration}: {_figures(one)}"
        for one in change.verdict.figures
    ]  # fmt: skip
    promised = [f"promised by its author, {one.scenario}: {_figures(one)}" for one in change.proposal.predicted]
    return simulated + promised


def _figures(one: ScenarioFigures | Promise) -> str:
    told = [
        "" if one.rmse_n is None else f"tracking error {number(one.rmse_n, 'N')}",
        "" if one.overshoot_pct is None else f"overshoot {number(one.overshoot_pct, '%')}",
        "" if one.settling_s is None else f"settled in {number(one.settling_s, 's')}",
    ]
    return ", ".join(filter(None, told)) or "no figures"


def _against(verdict: Verdict | None) -> list[RuleFinding]:
    return [] if verdict is None else [one for one in verdict.findings if not one.passed]


def _of_the_moment(change: Change) -> bool:
    against = _against(change.verdict)
    return bool(against) and all(one.rule in OF_THE_MOMENT for one in against)


def _closest(verdict: Verdict | None) -> list[RuleFinding]:
    """Those with a number, the nearest to its limit first, relative to the limit."""
    found = [] if verdict is None else [one for one in verdict.findings if one.margin is not None and one.limit]
    return sorted(found, key=_share)[:CLOSEST]


def _share(one: RuleFinding) -> float:
    return (one.margin or 0.0) / abs(one.limit or 1.0)


def _margin(one: RuleFinding) -> str:
    """The judge's own words, and the number."""
    if one.value is None or one.limit is None or one.margin is None:
        return f"{one.rule}: {one.text}"
    short = "short of its limit by" if one.margin < 0.0 else "clear of its limit by"
    return (
        f"{one.rule}: {number(one.value)} against a limit of {number(one.limit, one.unit)}, {short} "
        f"{number(abs(one.margin), one.unit)}; {one.text}"
    )
