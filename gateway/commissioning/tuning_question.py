"""The question of algorithm 1: which values of an architecture's knobs are tried next, with what was tried before."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gateway.commissioning.architectures import Architecture
from gateway.commissioning.ground import Ground
from gateway.commissioning.records import Attempt, Trial
from gateway.commissioning.trial import diagnosis
from gateway.commissioning.tuning import best_of
from gateway.core.questions import Figure, Knob, Option, Question, figure

NEXT, STOP = "search", "stop"  #: options: what the search would try, and the end
LEAST, MOST = 0.25, 4.0  #: times what is offered: a knob
MOST_SHOWN = 12  #: attempts, the newest
MOST_LETTERS = 600


@dataclass(frozen=True)
class Offer:
    """Values that may be tried next; None: the search ends."""

    id: str
    title: str
    values: dict[str, float] | None


def tuning_question(
    site: str, line: str, architecture: Architecture, ground: Ground, history: Sequence[Attempt],
    offers: Sequence[Offer],
) -> Question:  # fmt: skip
    """Which of `offers` is tried, the first of which is what the search would do."""
    best = best_of(history)
    return Question(
        format=1, site=site, line=line, decision="design.tuning",
        task=f"which values of {architecture.name}'s knobs are tried next, so that its cost J falls",
        facts=[one[:MOST_LETTERS] for one in _facts(architecture, ground, history)],
        figures=[] if best is None or best.trial is None else _figures(best.trial),
        options=[_option(architecture, one) for one in offers],
        usual=offers[0].id, why=_why(offers[0]), knobs=_knobs(architecture, offers),
    )  # fmt: skip


def _facts(architecture: Architecture, ground: Ground, history: Sequence[Attempt]) -> list[str]:
    """What is the same for every attempt, then attempts, the newest last, then what holds the best back."""
    limits, best = ground.task.limits, best_of(history)
    ranges = ", ".join(
        f"{knob.name} {knob.least:g} to {knob.most:g} {knob.unit}".strip() for knob in architecture.knobs
    )
    said = [
        f"{architecture.title}; its knobs may go from: {ranges}",
        "J is the integral of squared tension errors, and of squared torques times 1e-5, over "
        f"{' and '.join(one.name for one in ground.scenarios)}, in the mean over {len(ground.models)} lines, of which "
        "the first is the model and the others lie within what is not known of it",
        f"an attempt counts where the loop is stable, stands {1e3 * ground.least_margin_s:g} ms more delay, and keeps "
        f"every tension of every such line within {limits.tension_min_n:g} to {limits.tension_max_n:g} N; torque is "
        f"limited to {limits.torque_nm:g} Nm",
        *(_told(one, ground) for one in history[-MOST_SHOWN:]),
    ]
    if best is not None and best.trial is not None:
        said.append(f"the best is attempt {best.number}; what holds it back: {diagnosis(best.trial, ground)}")
    return said


def _told(one: Attempt, ground: Ground) -> str:
    if one.refused or one.trial is None:
        became = f"refused: {one.refused}"
    else:
        kept = "the best until then" if one.accepted else "no better"
        became = f"J {one.cost_n2s or 0.0:.4g} N2s, {kept}; {diagnosis(one.trial, ground)}"
    return f"attempt {one.number} with {_listed(one.values)}: {became}"


def _listed(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:g}" for name, value in values.items())


def _figures(trial: Trial) -> list[Figure]:
    """Of the best so far."""
    return [
        figure("J of the best", trial.cost_n2s, "N2s"),
        *(figure(f"its RMSE, {name}", value, "N") for name, value in list(trial.rmse_n.items())[:8]),
        figure("its settling time", trial.settling_s, "s"),
        figure("its overshoot", trial.overshoot_pct, "%"),
        figure("its effort", trial.effort_n2m2s, "(Nm)2s"),
        figure("how far any of the lines is from the model's course", trial.robustness_n, "N"),
        figure("lowest tension of any line", trial.tension_min_n, "N"),
        figure("highest tension of any line", trial.tension_max_n, "N"),
        figure("more delay that it stands", 1e3 * trial.delay_margin_s, "ms"),
        figure("change of torque from period to period by noise", trial.chatter_nm, "Nm"),
        figure("what noise leaves of the tension error", trial.noise_floor_n, "N"),
    ]


def _option(architecture: Architecture, offer: Offer) -> Option:
    units = {knob.name: knob.unit for knob in architecture.knobs}
    values = offer.values or {}
    return Option(
        id=offer.id, title=offer.title[:MOST_LETTERS],
        figures=[figure(name, value, units.get(name, "")) for name, value in values.items()],
    )  # fmt: skip


def _why(first: Offer) -> str:
    if first.values is None:
        return "no turn of the best by a tenth or more is left untried"
    return "every knob is turned up and down by a factor; what helps is repeated, else the factor becomes smaller"


def _knobs(architecture: Architecture, offers: Sequence[Offer]) -> list[Knob]:
    of = [one.id for one in offers if one.values is not None]
    of = of if len(of) < len(offers) else []
    if all(one.values is None for one in offers):
        return []
    return [
        Knob(name=knob.name, meaning=f"{knob.more}; less of it: {knob.less}", least=LEAST, most=MOST, of=of)
        for knob in architecture.knobs
    ]
