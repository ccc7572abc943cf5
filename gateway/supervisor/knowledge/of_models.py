"""Each model of the line that was accepted, as a document: parameters with intervals, data, what is new in it. Pure."""

from collections.abc import Sequence

import numpy as np

from gateway.core.differences import of_models as differences
from gateway.core.line_model import LineModel, ModelInterval
from gateway.core.line_model_names import OF_THE_LINE, UNITS
from gateway.core.line_model_quantities import interval_at, values_of
from gateway.core.line_queries import Generated
from gateway.core.questions import DECISIONS, Decision
from gateway.supervisor.knowledge.words import moment, number, on, quoted, section, whole
from gateway.supervisor.models import Entry

SERVES: list[Decision] = [one for one in DECISIONS if one.startswith(("identify", "design", "adapt", "monitor"))]
_WORDS = {
    "stiffness_n": "stiffness of the web (EA)",
    "length_m": "length of the spans",
    "radius_m": "radius of the rollers",
    "inertia_kg_m2": "inertia of the rollers",
    "friction_nms_per_rad": "viscous friction of the rollers",
    "coulomb_nm": "dry friction of the rollers (Coulomb)",
    "torque_lag_s": "lag of the torque behind its command",
    "latency_s": "latency from a sample to the torque that it causes",
    "stiffness_per_length": "stiffness of the web over the length of the spans (EA/L)",
    "radius_per_inertia": "radius over inertia of the rollers (R/J)",
    "friction_per_inertia": "friction over inertia of the rollers (f/J)",
    "radius2_per_inertia": "squared radius over inertia of the rollers (R²/J)",
    "eccentricity": "eccentricity of the rollers",
}

_SHORT = ("stiffness_n", "inertia_kg_m2", "friction_nms_per_rad", "coulomb_nm", "torque_lag_s", "latency_s")
_KEYWORDS = ["stiffness of the web", "friction of the rollers", "inertia of the rollers", "identified parameters"]


def of_model(entry: Entry, model: LineModel, before: LineModel | None, in_service: bool) -> Generated:
    """`before`: the model that was accepted before it; None: there was none."""
    accepted = [mark for mark in entry.marks if mark.state == "accepted"]
    date = moment(accepted[-1].time_s) if accepted else model.created
    state = "in service: it is the model by which proposals are judged" if in_service else "no longer in service"
    return Generated(
        name=f"model-{entry.version}",
        title="The model of this line: web stiffness, roller inertia and friction, torque lag"
        if in_service
        else f"An earlier model of this line, version {entry.version}",
        text=whole([
            _in_short(model) if in_service else "",
            f"Model version {entry.version} of this line ({entry.id[:12]}) was accepted {on(date)}. It is {state}.",
            section("What the line is like", *_parameters(model)),
            section(
                "How it was found",
                f"Against the model before: {'; '.join(differences(before, model))}.",
                _made_from(model), _validated(model),
                "Method, in the words of whoever made it:", quoted(model.method),
                "Source of the data, in the same:", quoted(model.data.source), *_late(model),
                *(["It was proposed because:", quoted(accepted[-1].reason)] if accepted else []),
            ),
        ]),
        date=date,
        keywords=_KEYWORDS if in_service else ["model history", "identification"],
        serves=SERVES,
    )  # fmt: skip


def _in_short(model: LineModel) -> str:
    """What is asked for most, in one sentence."""
    told = [f"the {_WORDS[name]} is {_middle(values_of(model)[name].tolist(), UNITS[name])}" for name in _SHORT]
    return f"On this line {', '.join(told)}."


def _middle(values: list[float], unit: str) -> str:
    low, high = min(values), max(values)
    return number(low, unit) if low == high else f"{number(low)} to {number(high, unit)}"


def _parameters(model: LineModel) -> list[str]:
    has = {name: values for name, values in values_of(model).items() if values.any() or name in model.intervals}
    return [_quantity(model, name, values.tolist()) for name, values in has.items()]


def _quantity(model: LineModel, name: str, values: list[float]) -> str:
    unit = UNITS[name]
    intervals = [interval_at(model, name, i) for i in range(len(values))]
    if name in OF_THE_LINE or (np.ptp(values) == 0.0 and len({_ends(one) for one in intervals}) == 1):
        interval = intervals[0]
        value = values[0] if interval is None else interval.value
        told = f"The {_WORDS[name]} is {number(value, unit)}."
        return told if interval is None else f"{told} With 95 % certainty it lies {_ends(interval)} {unit}."
    each = [
        number(value) if interval is None else f"{number(interval.value)} ({_ends(interval)})"
        for value, interval in zip(values, intervals, strict=True)
    ]
    certain = "" if not any(intervals) else ", each with its interval of 95 %"
    return f"The {_WORDS[name]}, from 1 to {len(values)}{certain}: {', '.join(each)} {unit}."


def _ends(interval: ModelInterval | None) -> str:
    return "" if interval is None else f"from {number(interval.low)} to {number(interval.high)}"


def _made_from(model: LineModel) -> str:
    data, region = model.data, model.region
    has = [name.replace("_", " ") for name, there in model.structure.model_dump().items() if there]
    tensions = [one for one in (*region.tension_from_n, *region.tension_to_n) if one is not None]
    return " ".join([
        f"Beside the usual parameters it has: {', '.join(has) or 'nothing'}.",
        f"Data: {data.samples} samples at {number(1e3 * data.period_s, 'ms')} ({data.digest[:12]}).",
        f"The unwinder ran from {number(region.speed_from_m_per_s)} to {number(region.speed_to_m_per_s, 'm/s')} in them"
        + (f", tensions went from {number(min(tensions))} to {number(max(tensions), 'N')}." if tensions else "."),
    ])  # fmt: skip


def _late(model: LineModel) -> list[str]:
    told = "; ".join(f"{one.channel} by {number(1e3 * one.late_s, 'ms')}" for one in model.alignment)
    return ["Channels that tell late:", quoted(told)] if told else []


def _validated(model: LineModel) -> str:
    found = model.validation
    if found is None:
        return "It was not tried on other data."
    r2 = ["not known" if one is None else number(one) for one in (found.r2_tension, found.r2_speed)]
    return (
        f"R² is {r2[0]} of tension and {r2[1]} of speed. The mean absolute error of tension is "
        f"{number(found.mae_tension_n, 'N')}. Normalised innovations squared, where 1 is right: tension "
        f"{_innovations(found.innovation_tension)}; speed {_innovations(found.innovation_speed)}. Innovations are "
        f"{found.whiteness}."
    )


def _innovations(values: Sequence[float | None]) -> str:
    return ", ".join("not known" if one is None else number(one) for one in values)
