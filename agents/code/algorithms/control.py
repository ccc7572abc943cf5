"""Controllers: designed, tuned, simulated, and how far their loops are from trouble."""

from collections.abc import Sequence

import numpy as np

from agents.code.algorithms.figures import figure, of_trial, sentences
from agents.code.calls import CallRefused, Design, Margins, Simulate, Tune
from agents.code.job import Believed, Job, Outcome
from gateway.commissioning.architectures import ARCHITECTURES, Architecture
from gateway.commissioning.ground import Ground, ground_of
from gateway.commissioning.search import PatternSearch
from gateway.commissioning.suite import suite_of
from gateway.commissioning.trial import diagnosis, reasons_against, tried
from gateway.commissioning.tuning import tune
from gateway.control.design import DesignTask, design_lqi, is_stable, margins, task_of, task_on, weak_spots
from gateway.control.design.margins import MOST_DELAY_S, closed_loop
from gateway.control.design.sampling import with_dead_time
from gateway.control.design.task import linear
from gateway.control.linear_form import linear_form, without_constants
from gateway.control.rollout import simulate
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.controller_schedule import ScheduledConfig, law_at
from gateway.core.line import Line
from gateway.core.line_model import noise_of, theta_of
from gateway.core.scenario import Scenario

SEED = 1  #: of noise, and of lines within what a model leaves open: the same for whatever is compared
LEAD_S, WATCHED_S = 0.2, 5.2  #: of each scenario while tuning: before the change, and in all
PLANTS_TUNED_ON = 4  #: beside the one that is believed
MOST_GAIN = 20.0  #: beyond which nobody looks
GAIN_WITHIN = 1e-3  #: relative, to which a gain margin is told


def simulated(call: Simulate, job: Job) -> Outcome:
    believed, controller = job.models[0], job.controllers[0]
    ground = scenario_ground(job.line, call.scenario, believed, call.plants)
    trial = tried(controller.config, ground)
    scenario = ground.scenarios[0]
    against = reasons_against(trial, ground)
    words = [
        f"{controller.name} on {believed.name}",
        f"extremes of tension are of {call.plants} more lines, within what it leaves open, too" if call.plants else "",
        f"{scenario.heading}: {scenario.description} Watched for {trial.watched_s:g} s after the change.",
        f"what holds it back: {diagnosis(trial, ground)}",
        *(f"against it: {reason}" for reason in against),
    ]
    return Outcome(figures=of_trial(trial), words=sentences(words))


def margins_of(call: Margins, job: Job) -> Outcome:
    believed, controller = job.models[0], job.controllers[0]
    task = task_on_model(job.line, believed)
    found = margins(controller.config, task)
    gain = gain_margin(controller.config, task)
    words = [
        f"{controller.name} on {believed.name}, linearised at {task.unwind_speed_m_per_s:g} m/s",
        "the loop is stable" if found.spectral_radius < 1.0 else "the loop is unstable",
        f"delay beyond {1e3 * MOST_DELAY_S:g} ms and gain beyond {MOST_GAIN:g} times are not looked at",
        *weak_spots(controller.config, task),
    ]
    figures = [
        figure("delay margin beyond the latency", 1e3 * found.delay_margin_s, "ms"),
        figure("decay of the slowest mode", found.decay_per_s, "1/s"),
        figure("spectral radius of a period", found.spectral_radius),
        figure("gain margin, all drives together", gain, "times"),
        figure("torque chatter under noise", found.chatter_nm, "Nm"),
        figure("error left by noise", found.noise_floor_n, "N"),
    ]
    return Outcome(figures=figures, words=sentences(words))


def designed(call: Design, job: Job) -> Outcome:
    believed, architecture = job.models[0], ARCHITECTURES[call.architecture]
    task = task_on_model(job.line, believed)
    values = {name: value * call.knobs.get(name, 1.0) for name, value in architecture.first(task).items()}
    _require_within(architecture, values, call.knobs)
    config = architecture.design(task, values)
    found = margins(config, task)
    words = [
        f"{architecture.title}, designed on {believed.name}",
        *(f"{knob.name} is {values[knob.name]:.4g} {knob.unit}" for knob in architecture.knobs),
        *weak_spots(config, task),
    ]
    figures = [
        figure("delay margin beyond the latency", 1e3 * found.delay_margin_s, "ms"),
        figure("decay of the slowest mode", found.decay_per_s, "1/s"),
        figure("torque chatter under noise", found.chatter_nm, "Nm"),
        figure("error left by noise", found.noise_floor_n, "N"),
    ]
    return Outcome(figures=figures, words=sentences(words), controller=config)


def tuned(call: Tune, job: Job) -> Outcome:
    believed, architecture = job.models[0], ARCHITECTURES[call.architecture]
    ground = ground_of(job.line, suite_of(job.line), PLANTS_TUNED_ON, SEED, model=believed.model)
    ground = ground.shortened(1 + PLANTS_TUNED_ON, LEAD_S, WATCHED_S)
    found = tune(architecture, ground, PatternSearch(), call.iterations)
    if (best := found.best) is None or best.trial is None:
        return Outcome(refused=[found.reasons()[:600]])
    words = [
        f"{architecture.title}, tuned on {believed.name} and {PLANTS_TUNED_ON} lines within what it leaves open",
        *(f"{knob.name} is {best.values[knob.name]:.4g} {knob.unit}" for knob in architecture.knobs),
        f"attempt {best.number} of {len(found.history) - 1} is the best; {'nothing' if found.converged else 'more'} is "
        "to be expected of further ones",
        f"what holds it back: {diagnosis(best.trial, ground)}",
    ]
    first = found.history[0].cost_n2s
    figures = [figure("cost J", best.cost_n2s, "N2 s"), figure("cost J at first", first, "N2 s"), *of_trial(best.trial)]
    return Outcome(figures=figures, words=sentences(words), controller=found.config(architecture, ground))


def scenario_ground(line: Line, name: str, believed: Believed, plants: int) -> Ground:
    """One of the line's own scenarios on a model. Raises CallRefused, DesignRefused."""
    return ground_of(line, [_scenario(line, name)], plants, SEED, model=believed.model)


def task_on_model(line: Line, believed: Believed) -> DesignTask:
    model = believed.model
    return task_of(line) if model is None else task_on(line, theta_of(model), noise_of(model))


def gain_margin(config: Controller, task: DesignTask) -> float:
    """By how much all drives may give more torque than is asked for until the loop is unstable; `MOST_GAIN`: and more.

    0: it is unstable as it is. Of a schedule at the task's speed.
    """
    law = law_at(config, task.unwind_speed_m_per_s) if isinstance(config, ScheduledConfig) else config
    form, (A, B) = without_constants(linear_form(law)), linear(task)

    def stable(gain: float) -> bool:
        loop = closed_loop(form, with_dead_time(A, gain * B, task.period_s, task.latency_s))
        return bool(np.abs(np.linalg.eigvals(loop)).max() < 1.0)

    if not is_stable(config, task):
        return 0.0
    low, high = 1.0, MOST_GAIN
    if stable(high):
        return high
    while high - low > GAIN_WITHIN * low:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def warm_up(job: Job) -> None:
    """A controller on the nominal model, for some periods."""
    line = job.line
    period_s = line.control.period_s
    ground = ground_of(line, suite_of(line)[-1:], 0, SEED).shortened(1, 2.0 * period_s, 6.0 * period_s)
    tried(design_lqi(task_of(line)), ground)
    for one in job.controllers:
        if isinstance(one.config, MpcConfig):
            simulate(one.config, ground.plants, ground.courses[0], ground.setup)


def _scenario(line: Line, name: str) -> Scenario:
    suite: Sequence[Scenario] = suite_of(line)
    found = next((one for one in suite if one.name == name), None)
    if found is None:
        raise CallRefused([f"this line has no scenario {name}; allowed: {', '.join(one.name for one in suite)}"])
    return found


def _require_within(architecture: Architecture, values: dict[str, float], factors: dict[str, float]) -> None:
    """Raises CallRefused, in factors."""
    wrong: list[str] = []
    for knob in architecture.knobs:
        if not knob.least <= values[knob.name] <= knob.most:
            factor = factors[knob.name]
            first = values[knob.name] / factor
            wrong.append(
                f"knobs.{knob.name} is {factor:g}; allowed: {knob.least / first:.3g} to {knob.most / first:.3g}, where "
                f"it goes from {knob.least:g} to {knob.most:g} {knob.unit}".rstrip()
            )
    if wrong:
        raise CallRefused(wrong)
