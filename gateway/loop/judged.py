"""What the configuration in service was judged for: an operator's command beyond it is refused."""

from gateway.core.experiment import Experiment
from gateway.core.finding import Finding, finding
from gateway.loop.cycle import Cycle
from gateway.loop.refused import Refused


def least(own: float, judged: float | None) -> float:
    """The line's limit, or what the configuration was judged for, if that is less."""
    return own if judged is None else min(own, judged)


def require_judged(cycle: Cycle, speed_m_per_s: float) -> None:
    running = cycle.configurations.running
    most = running.region.speed_max_m_per_s
    if most is not None and speed_m_per_s > most:
        values = {"speed_m_per_s": speed_m_per_s, "allowed_m_per_s": most}
        raise Refused(finding("speed-unjudged", controller=running.hash[:12], **values))


def unjudged(cycle: Cycle, experiment: Experiment) -> list[Finding]:
    """What of it the configuration in service has not been judged for.

    Asked of an experiment that has no verdict of its own. One that has was simulated at its own speeds and steps with
    the configuration in service: it is how a line comes to data beyond what was judged before.
    """
    region = cycle.configurations.running.region
    reasons: list[Finding] = []
    step_n = experiment.step_max_n if experiment.rate_n_per_s is None else 0.0
    if region.tension_step_max_n is not None and step_n > region.tension_step_max_n * (1.0 + 1e-9):
        reasons.append(finding("step-unjudged", step_n=step_n, allowed_n=region.tension_step_max_n))
    fastest = max((leg.speed_m_per_s or 0.0 for leg in experiment.legs), default=0.0)
    if region.speed_max_m_per_s is not None and fastest > region.speed_max_m_per_s:
        values = {"speed_m_per_s": fastest, "allowed_m_per_s": region.speed_max_m_per_s}
        reasons.append(finding("leg-unjudged", **values))
    return reasons


def on_probation(cycle: Cycle) -> list[Finding]:
    """Why no experiment may move set-points: what controls the line is under watch."""
    probation = cycle.configurations.probation
    if probation is None or not probation.shaped_first:
        return []
    return [finding("on-probation", epoch=cycle.configurations.epoch)]
