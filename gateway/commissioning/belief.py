"""Where the truth of a line may lie: in the tolerances of its file, or in the intervals of an identified model."""

from collections.abc import Callable, Sequence

import numpy as np

from gateway.core.line import Line, Parameter
from gateway.core.line_model import LineModel, theta_of
from gateway.core.line_model_quantities import interval_at
from gateway.core.scenario import Scenario
from gateway.core.signals import FloatArray
from gateway.core.theta import Theta
from gateway.core.web_model import WebModel

#: Intervals cover what the data leave open, not what the model's structure leaves out or what drifts until the next
#: identification. What is drawn is drawn at least so far either way; length, radius and friction follow from two draws,
#: so that they spread by 5 %, as the corners do for which the gate accepts the good designs of an identified plant.
LEAST_SPREAD = 0.025
LEAST_FACTOR = 0.05  #: of a value whose interval reaches 0 or below
OF_A_ROLLER = ("radius_m", "inertia_kg_m2", "friction_nms_per_rad")
SLACK_N, SLACK_M_PER_S = 0.5, 1e-3  #: within which a scenario is no further than the data

Draw = Callable[[np.random.Generator], WebModel]


def within_tolerances(line: Line) -> Draw:
    """Drawn evenly from the tolerances of the line's file, every roller and span by itself."""

    def draw(generator: np.random.Generator) -> WebModel:
        def drawn(*parameters: Parameter) -> FloatArray:
            value, tolerance = np.array([[p.value, p.tolerance] for p in parameters]).T
            return value * (1.0 + tolerance * generator.uniform(-1.0, 1.0, len(value)))

        return WebModel(
            float(drawn(line.web.stiffness_n)[0]),
            drawn(*(span.length_m for span in line.spans)),
            drawn(*(roller.radius_m for roller in line.rollers)),
            drawn(*(roller.inertia_kg_m2 for roller in line.rollers)),
            drawn(*(roller.friction_nms_per_rad for roller in line.rollers)),
            line.web.tension_before_n,
            line.web.tension_after_n,
        )

    return draw


def within_intervals(line: Line, model: LineModel) -> Draw:
    """Drawn evenly from the model's intervals, every roller and span by itself.

    Data tell EA/L, R/J and f/J well, and EA or J alone badly: EA and J are drawn from their own intervals, and L, R and
    f follow with the intervals of the combinations. Where the model has no interval the line's tolerance stands in.
    """
    web = theta_of(model).web
    stiffness = _ends(model, "stiffness_n", [line.web.stiffness_n])
    inertia = _ends(model, "inertia_kg_m2", [roller.inertia_kg_m2 for roller in line.rollers])
    per_length = _ends(model, "stiffness_per_length", [span.length_m for span in line.spans])
    radius = _ends(model, "radius_per_inertia", [roller.radius_m for roller in line.rollers])
    friction = _ends(model, "friction_per_inertia", [roller.friction_nms_per_rad for roller in line.rollers])

    def draw(generator: np.random.Generator) -> WebModel:
        of_stiffness = float(generator.uniform(*stiffness)[0])
        of_inertia = generator.uniform(*inertia)
        return WebModel(
            web.stiffness_n * of_stiffness,
            web.length_m * of_stiffness / generator.uniform(*per_length),
            web.radius_m * of_inertia * generator.uniform(*radius),
            web.inertia_kg_m2 * of_inertia,
            web.friction_nms_per_rad * of_inertia * generator.uniform(*friction),
            web.tension_before_n,
            web.tension_after_n,
        )

    return draw


def _ends(model: LineModel, name: str, otherwise: Sequence[Parameter]) -> tuple[FloatArray, FloatArray]:
    """Least and greatest factor (n,) on what the model says of each."""
    ends: list[tuple[float, float]] = []
    for i, parameter in enumerate(otherwise):
        interval = interval_at(model, name, i)
        if interval is None or interval.value <= 0.0:
            low, high = 1.0 - parameter.tolerance, 1.0 + parameter.tolerance
        else:
            low, high = interval.low / interval.value, interval.high / interval.value
        ends.append((max(LEAST_FACTOR, min(low, 1.0 - LEAST_SPREAD)), max(high, 1.0 + LEAST_SPREAD)))
    lows, highs = np.array(ends).T
    return lows, highs


def believing(line: Line, theta: Theta, left_open: float) -> Line:
    """The line with what was found in place of its file's values, and `left_open` in place of every tolerance."""
    web = theta.web

    def known(value: float) -> Parameter:
        return Parameter(value=value, tolerance=left_open)

    each = {name: [known(value) for value in getattr(web, name).tolist()] for name in (*OF_A_ROLLER, "length_m")}
    rollers = [
        roller.model_copy(update={name: each[name][i] for name in OF_A_ROLLER}) for i, roller in enumerate(line.rollers)
    ]
    spans = [span.model_copy(update={"length_m": each["length_m"][i]}) for i, span in enumerate(line.spans)]
    material = line.web.model_copy(update={"stiffness_n": known(web.stiffness_n)})
    return line.model_copy(update={"web": material, "rollers": rollers, "spans": spans})


def words_on(model: LineModel, name: str, scenarios: Sequence[Scenario]) -> list[str]:
    """What a reader must know of the model that a design stands on, and where scenarios go beyond its data."""
    region = model.region
    said = [
        f"Designed on {name}: identified by {model.method} from {model.data.samples} samples, at "
        f"{region.speed_from_m_per_s:.3g} to {region.speed_to_m_per_s:.3g} m/s; validated on held-out data: "
        f"{'no' if model.validation is None else 'yes'}."
    ]
    beyond: list[str] = []
    for scenario in scenarios:
        speeds = (scenario.speed_m_per_s, scenario.speed_end_m_per_s)
        if min(speeds) < region.speed_from_m_per_s - SLACK_M_PER_S:
            beyond.append(f"{scenario.name} runs at {min(speeds):g} m/s")
        if max(speeds) > region.speed_to_m_per_s + SLACK_M_PER_S:
            beyond.append(f"{scenario.name} runs at {max(speeds):g} m/s")
        ends = zip(scenario.tension_n, scenario.tension_end_n, strict=True)
        seen = zip(region.tension_from_n, region.tension_to_n, strict=True)
        for i, (tensions, (low, high)) in enumerate(zip(ends, seen, strict=True), 1):
            if low is None or high is None:
                continue
            far = [one for one in tensions if not low - SLACK_N <= one <= high + SLACK_N]
            if far:
                beyond.append(f"{scenario.name} has span {i} at {far[-1]:g} N, its data {low:.3g} to {high:.3g} N")
    if beyond:
        said.append(f"Beyond its data: {'; '.join(dict.fromkeys(beyond))}.")
    return said
