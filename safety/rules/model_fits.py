"""The model is one of this line, as its file bounds it."""

from collections.abc import Iterator, Sequence

from gateway.core.line import Parameter
from gateway.core.line_model import LineModel
from gateway.core.verdict import RuleFinding
from safety.case import Case
from safety.findings import told

RULE = "model: bounds"
COULOMB_SHARE = 0.25  #: of the torque limit: a bearing with more dry friction is stuck
LONGEST_LAG_S = 0.05
PERIODS_LATE = 1.0  #: by which the latency may differ from what is known of it
ROUNDED = 1e-6


def check(case: Case) -> list[RuleFinding]:
    """Names, size and period; every parameter within the tolerance of the line's file."""
    wrong = [*_wrong_names(case, case.model), *_out_of_tolerance(case, case.model), *_wrong_rest(case, case.model)]
    if not wrong:
        return [told(RULE, True, "every parameter is within the tolerance of the line's file")]
    return [told(RULE, False, text) for text in wrong]


def _wrong_names(case: Case, model: LineModel) -> Iterator[str]:
    line = case.line
    if (model.site, model.line) != (line.site, line.line):
        yield f"the model is of {model.site}/{model.line}; allowed: this line, {line.site}/{line.line}"
    if model.n != line.n:
        yield f"the model has {model.n} spans; allowed: {line.n}, as the line"
    if not abs(model.data.period_s - line.control.period_s) <= 1e-9:
        yield f"the model's data have a period of {model.data.period_s:g} s; allowed: {line.control.period_s:g} s"


def _out_of_tolerance(case: Case, model: LineModel) -> Iterator[str]:
    line, given = case.line, model.parameters
    if model.n != line.n:
        return
    families: dict[str, tuple[Sequence[float], list[Parameter]]] = {
        "stiffness_n": ([given.stiffness_n], [line.web.stiffness_n]),
        "length_m": (given.length_m, [span.length_m for span in line.spans]),
        "radius_m": (given.radius_m, [roller.radius_m for roller in line.rollers]),
        "inertia_kg_m2": (given.inertia_kg_m2, [roller.inertia_kg_m2 for roller in line.rollers]),
        "friction_nms_per_rad": (given.friction_nms_per_rad, [r.friction_nms_per_rad for r in line.rollers]),
    }
    for name, (values, nominal) in families.items():
        for i, (value, parameter) in enumerate(zip(values, nominal, strict=True), 1):
            low, high = parameter.value * (1.0 - parameter.tolerance), parameter.value * (1.0 + parameter.tolerance)
            if not low * (1.0 - ROUNDED) <= value <= high * (1.0 + ROUNDED):
                which = name if len(values) == 1 else f"{name}[{i}]"
                yield f"{which} is {value:.4g}; allowed by the line's file: {low:.4g} to {high:.4g}"


def _wrong_rest(case: Case, model: LineModel) -> Iterator[str]:
    line, given = case.line, model.parameters
    most_nm = COULOMB_SHARE * line.limits.torque_nm
    if not all(one <= most_nm for one in given.coulomb_nm):
        yield f"Coulomb friction is {max(given.coulomb_nm):.3g} Nm; allowed: up to {most_nm:g} Nm"
    if not given.torque_lag_s <= LONGEST_LAG_S:
        yield f"the torque's lag is {given.torque_lag_s:g} s; allowed: up to {LONGEST_LAG_S:g} s"
    known_s = line.control.latency_s if case.context.latency_s is None else case.context.latency_s
    near_s = PERIODS_LATE * line.control.period_s
    if not abs(given.latency_s - known_s) <= near_s + 1e-9:
        yield f"the latency is {given.latency_s:g} s; allowed: within {near_s:g} s of {known_s:g} s"
    if (given.tension_before_n, given.tension_after_n) != (line.web.tension_before_n, line.web.tension_after_n):
        yield (
            f"tension_before_n and tension_after_n are {given.tension_before_n:g} and {given.tension_after_n:g}; "
            f"allowed: {line.web.tension_before_n:g} and {line.web.tension_after_n:g}, which no data tell"
        )
