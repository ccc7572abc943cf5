"""The accepted model holds: its predictions are off by what the noise explains, on recent data in which tensions move.

The predictor has no disturbance states: with them quiet data pass everything.
"""

from gateway.core.line_model import LineModel, noise_of
from gateway.core.verdict import RuleFinding
from safety.case import Case
from safety.excitation import MOVING, least_seconds, near_m_per_s
from safety.findings import at_least, at_most, told
from safety.predicting import Foretold, by_speed, foretold_of, normalised, normalised_by_output, seconds

RULE = "model validity"
EACH_BEYOND = 0.3  #: by which one load cell or encoder may lie outside the band of all together


def check(case: Case) -> list[RuleFinding]:
    """Normalised innovation squared within [gate.innovation_low, innovation_high] at each speed of the data."""
    if case.context.model is None:
        return [told(RULE, False, "no model is accepted, and none is needed for a first configuration")]
    found = of_model(case, case.context.model)
    return [*found, _fast_enough(case)] if case.excited else found


def of_model(case: Case, model: LineModel, name: str = RULE) -> list[RuleFinding]:
    """Of any model, on the recent and excited data of the case."""
    noise = noise_of(model)
    if noise is None:
        return [told(name, False, "the model says nothing of the noise, so nobody can tell what it explains")]
    if not case.excited:
        return [told(name, False, _asks_for_data(case))]
    found = foretold_of(case, model, noise)
    return [_at_speed(case, speed, of, name) for speed, of in by_speed(found, case.line)] or [
        told(name, False, "no data were seen")
    ]


def _at_speed(case: Case, speed: float, found: list[Foretold], name: str) -> RuleFinding:
    gate = case.line.gate
    low, high = gate.innovation_low, gate.innovation_high
    value = normalised(found)
    outputs, each = normalised_by_output(found)
    loud, quiet = int(each.argmax()), int(each.argmin())
    said = f"normalised innovation squared at {speed:.3g} m/s over {seconds(found):.1f} s"
    if each[loud] > high + EACH_BEYOND:
        text = f"{said} is {each[loud]:.2f} of {outputs[loud]}; allowed: up to {high + EACH_BEYOND:g}: identify again"
        return at_most(name, float(each[loud]), high + EACH_BEYOND, "", text)
    if each[quiet] < low - EACH_BEYOND:
        text = f"{said} is {each[quiet]:.2f} of {outputs[quiet]}; allowed: {low - EACH_BEYOND:g} and more: the model "
        text += "takes the noise for greater than it is"
        return at_least(name, float(each[quiet]), low - EACH_BEYOND, "", text)
    text = f"{said} is {value:.3f}; allowed: {low:g} to {high:g}"
    if value - low < high - value:
        return at_least(name, value, low, "", text)
    return at_most(name, value, high, "", text)


def _fast_enough(case: Case) -> RuleFinding:
    """The line does not run faster than where the model has been seen to hold."""
    speed, fastest = case.context.state.speed_m_per_s, case.validated_m_per_s
    near = fastest + near_m_per_s(fastest, case.line)
    text = f"data have shown the model up to {fastest:.3g} m/s; the line runs at {speed:g} m/s"
    if speed > near:
        text += f": {_experiment(speed)}"
    return at_most(RULE, speed, near, "m/s", text)


def _asks_for_data(case: Case) -> str:
    gate, state = case.line.gate, case.context.state
    old = len(case.recordings) - len(case.data)
    had = f"{len(case.recordings)} recordings, {old} of them older than {gate.data_max_age_s:g} s" if old else (
        f"{len(case.recordings)} recordings"
    )  # fmt: skip
    return (
        f"no recent data show the model: of {had}, none has {least_seconds(case.line):g} s at one speed in which every "
        f"tension moves by {MOVING:g} times its noise; {_experiment(state.speed_m_per_s)}"
    )


def _experiment(speed: float) -> str:
    return f"run an experiment at {speed:g} m/s or more (r2rgate experiment), then propose again"
