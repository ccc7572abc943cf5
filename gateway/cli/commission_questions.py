"""The questions that the commissioning chain leaves to judgement, each with what is known and what is offered.

What the rules would choose is always the first option. What is shown of it is what the rules go by.
"""

from collections.abc import Callable, Iterable, Sequence

from gateway.cli.commission_changes import LineNow, Offer
from gateway.commissioning.architectures import ARCHITECTURES
from gateway.commissioning.convergence import Convergence, SpanFigures
from gateway.commissioning.ladder import BY_RULES, OWN, Next
from gateway.commissioning.past import Follows, Outcome, Past, Step
from gateway.commissioning.redesign import Figures
from gateway.core.controller import config_hash
from gateway.core.line import Line
from gateway.core.questions import Decision, Figure, Knob, Option, Question, figure
from gateway.identification.identify import Identified

LEAST, MOST = 0.25, 4.0  #: times what is offered: a knob
LEAST_SIZE, MOST_SIZE = 0.5, 1.5  #: the same of an experiment's moves
SIZE = "larger moves tell more, and take tensions further from their set-points"
MOST_FACTS = 24
MOST_LETTERS = 600
PROPOSE, MORE_DATA = "propose", "more-data"
IN_ANY_CASE = "another adaptation is asked for: a newer model and a redesign follow in any case"

#: A measurement leaves nothing to choose.
_ASKED: dict[Step, tuple[Decision, str, str]] = {
    Step.FIRST: (
        "design.architecture",
        "which configuration, designed on the line's file, is proposed to begin with",
        "of those that are offered it is the quickest; what comes later stands more that is not as the file says",
    ),
    Step.EXPERIMENT: (
        "identify.experiment",
        "with which experiment the line is to be identified",
        "of those that are offered it is the fastest and largest, which tells most; a smaller or slower one "
        "follows where it is refused",
    ),
    Step.MODEL: (
        "identify.data",
        "from which recordings a model is made",
        "before a measurement the newest, which goes the fastest, and more data, which take longer, where it gives no "
        "model; then all, and the newest where the line has become another one",
    ),
    Step.REDESIGN: (
        "adapt.change",
        "which configuration is proposed on the accepted model",
        "of those that have not failed it has the least tracking error on the model; all do no worse than what is in "
        "service",
    ),
}


def step_question(line: Line, step: Next, offers: Sequence[Offer], now: LineNow, past: Sequence[Past]) -> Question:
    """Which of `offers` is proposed."""
    decision, task, why = _ASKED[step.step]
    names = {one.rung: option_id(one.rung) for one in offers}
    return Question(
        format=1, site=line.site, line=line.line, decision=decision, task=task, facts=_facts(line, step, now, past),
        options=[Option(id=names[one.rung], title=one.title, figures=_figures(one)) for one in offers],
        usual=names[step.rung], why=why, knobs=_knobs(step, offers),
    )  # fmt: skip


def fidelity_question(line: Line, found: Identified, now: LineNow, past: Sequence[Past]) -> Question:
    """Whether a model that was identified is proposed; the gate judges it by its data all the same."""
    said = found.validation
    figures = [figure("normalised innovation squared", said.normalised, "")]
    for output in said.outputs:
        figures += [
            figure(f"R2 of {output.name}", output.r2), figure(f"mean absolute error of {output.name}", output.mae),
        ]  # fmt: skip
    facts = [
        f"the structure is {found.estimate.structure}",
        f"on data that it has not seen it is {'valid' if said.valid else 'not valid'}",
        *said.findings,
        *(f"recommended: {one}" for one in said.recommendations),
        *(str(one) for one in found.warnings),
    ]
    return Question(
        format=1, site=line.site, line=line.line, decision="identify.fidelity",
        task="whether this model is proposed, or another experiment is made first",
        facts=_brief([*_state(line, now), *facts, *_tried(past)]), figures=figures[:64],
        options=[
            Option(id=PROPOSE, title="propose the model: the gate judges it by its data"),
            Option(id=MORE_DATA, title="make another experiment: these data are not enough"),
        ],
        usual=PROPOSE, why="the gate judges a model by its data; what it refuses is followed by another experiment",
    )  # fmt: skip


def diagnosis_question(
    line: Line, found: Convergence, now: LineNow, past: Sequence[Past], due: bool = False, few: bool = False
) -> Question:
    """Why the line does not do what it should, and so what follows.

    `due`: another adaptation does in any case. `few`: the model is of one experiment, and more has been recorded.
    """
    in_any_case = [IN_ANY_CASE] if due else []
    of_all = [Option(id=Follows.ALL_DATA, title="the model foresees it, from one experiment: a model of all data")]
    figures = [figure("measured tracking error over the predicted one, less 1", found.gap, "")]
    worst_first = sorted(found.spans.items(), key=lambda each: -each[1].rmse_n)  # those of many spans are too many
    for name, one in worst_first:
        figures += _span_figures(f"span {name}, measured", one)
        figures += _span_figures(f"span {name}, predicted", found.predicted[name])
    return Question(
        format=1, site=line.site, line=line.line, decision="adapt.diagnosis",
        task="why the line does what was measured, and what follows from it",
        facts=_brief([f"measured: {found.text}", *in_any_case, *_state(line, now), *_tried(past)]),
        figures=figures[:64],
        options=[
            Option(id=Follows.NEWER_MODEL, title="the model does not foresee it: another experiment and a newer model"),
            *(of_all if few else []),
            Option(id=Follows.CALMER, title="the model foresees it: a calmer configuration on the same model"),
            Option(id=Follows.LEAVE, title="nothing that could be gained is significant: it stays as it is"),
        ],
        usual=Follows.ALL_DATA if few and found.follows is Follows.LEAVE else found.follows,
        why="a gap of a tenth, either way, between measured and predicted error is the model's; without one a calmer "
        "design follows where the criteria are not met, and where they are a model of all data, once",
    )  # fmt: skip


def option_id(rung: int) -> str:
    return f"candidate-{rung + 1}"


def _facts(line: Line, step: Next, now: LineNow, past: Sequence[Past]) -> list[str]:
    measured = [one for one in past if one.step is Step.MEASUREMENT and one.follows is not None]
    shown = [f"measured last: {one.why}; concluded from it: {one.follows}" for one in measured[-1:]]
    return _brief([*shown, *_state(line, now), *_tried([one for one in past if one.step is step.step])])


def _state(line: Line, now: LineNow) -> list[str]:
    model = "the line's file, no model is accepted yet"
    if now.model is not None:
        model = f"an accepted model, whose data go up to {now.model.region.speed_to_m_per_s:.3g} m/s"
    limits = line.limits
    return [
        f"the line has {line.n} spans and runs at {now.speed_m_per_s:.3g} m/s",
        f"set-points are {', '.join(f'{tension:.4g}' for tension in now.tension_n)} N, allowed "
        f"{limits.tension_min_n:g} to {limits.tension_max_n:g} N",
        f"torques are limited to {limits.torque_nm:g} Nm and {limits.torque_rate_nm_per_s:g} Nm/s, the speed to "
        f"{limits.speed_max_m_per_s:g} m/s",
        f"in service is {now.in_service.kind} {config_hash(now.in_service)[:12]}",
        f"what is known of the line: {model}",
    ]


def _tried(past: Sequence[Past]) -> list[str]:
    """The newest last."""
    words = {Outcome.DONE: "done", Outcome.FAILED: "failed", Outcome.AGAIN: "came at a wrong moment"}
    return [
        f"tried: {one.step}, {_candidate(one.rung)}: {words[one.outcome]}{f': {one.why}' if one.why else ''}"
        for one in past
        if one.step is not None and one.outcome in words
    ]


def _candidate(rung: int) -> str:
    return option_id(rung) if rung < OWN else "own numbers" if rung < BY_RULES else "that of the rules"


def _brief(facts: Sequence[str]) -> list[str]:
    """The first few, which say how things stand, and the newest of the others."""
    kept = list(facts[:MOST_FACTS]) if len(facts) <= MOST_FACTS else [*facts[:6], *facts[6 - MOST_FACTS :]]
    return [one[:MOST_LETTERS] for one in kept if one]


def _figures(offer: Offer) -> list[Figure]:
    if offer.redesign is None:
        return []
    figures, before = offer.redesign.figures, offer.redesign.before
    return [
        figure("tracking error over that in service, mean of the courses", offer.redesign.share, ""),
        _worst("tracking error on the model", "N", figures.values(), lambda one: one.rmse_n),
        _worst("the same in service", "N", before.values(), lambda one: one.rmse_n),
        _worst("overshoot", "%", figures.values(), lambda one: one.overshoot_pct),
        _worst("overshoot in service", "%", before.values(), lambda one: one.overshoot_pct),
        _worst("settling time", "s", figures.values(), lambda one: one.settling_s),
        _worst("settling time in service", "s", before.values(), lambda one: one.settling_s),
    ]


def _worst(name: str, unit: str, figures: Iterable[Figures], of: Callable[[Figures], float]) -> Figure:
    return figure(f"{name}, worst course", max(map(of, figures)), unit)


def _span_figures(name: str, one: SpanFigures) -> list[Figure]:
    return [
        figure(f"{name} tracking error", one.rmse_n, "N"),
        figure(f"{name} overshoot", one.overshoot_pct, "%"),
        figure(f"{name} settling time", one.settling_s, "s"),
    ]


def _knobs(step: Next, offers: Sequence[Offer]) -> list[Knob]:
    """Those of all offers; none where nobody's own numbers are taken any more."""
    if step.own <= 0:
        return []
    of: dict[str, list[str]] = {}
    for one in offers:
        for name in one.knobs:
            of.setdefault(name, []).append(option_id(one.rung))
    every = {option_id(one.rung) for one in offers}
    return [_knob(name, [] if set(names) == every else names) for name, names in of.items()]


def _knob(name: str, of: list[str]) -> Knob:
    if name == "size":
        return Knob(name=name, meaning=SIZE, least=LEAST_SIZE, most=MOST_SIZE, of=of)
    knob = next(knob for one in ARCHITECTURES.values() for knob in one.knobs if knob.name == name)
    return Knob(name=name, meaning=f"more of it: {knob.more}; less: {knob.less}", least=LEAST, most=MOST, of=of)
