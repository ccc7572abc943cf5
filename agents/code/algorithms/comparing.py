"""Controllers in the same scenario with the same noise, and models on the same recording."""

from agents.code.algorithms.control import scenario_ground
from agents.code.algorithms.figures import of_trial, sentences
from agents.code.algorithms.identifying import of_validation
from agents.code.calls import CallRefused, Compare
from agents.code.job import Believed, Job, Outcome
from gateway.commissioning.trial import reasons_against, tried
from gateway.core.line_model import noise_of, theta_of
from gateway.core.questions import Figure
from gateway.core.theta import Noise, Theta, nominal_theta
from gateway.identification.prediction_error import stretches_of
from gateway.identification.validation import Validation, validate


def compared(call: Compare, job: Job) -> Outcome:
    return _models(job) if call.models else _controllers(call, job)


def _controllers(call: Compare, job: Job) -> Outcome:
    believed = job.models[0]
    ground = scenario_ground(job.line, call.scenario, believed, 0)
    figures: list[Figure] = []
    words = [f"on {believed.name}; {ground.scenarios[0].heading}: {ground.scenarios[0].description}"]
    for name, controller in zip(call.controllers, job.controllers, strict=True):
        trial = tried(controller.config, ground)
        figures += of_trial(trial, f"{name}: ")
        words += [controller.name, *(f"against {name}: {reason}" for reason in reasons_against(trial, ground))]
    return Outcome(figures=figures, words=sentences(words))


def _models(job: Job) -> Outcome:
    """Raises CallRefused, Unpredictable."""
    if job.models[0].model == job.models[1].model:
        raise CallRefused([f"both models are {job.models[1].name}; allowed: two that differ"])
    stretches = stretches_of(job.recordings)
    figures: list[Figure] = []
    words = [f"on {job.recordings[0].source}, {sum(one.predictions for one in stretches)} samples"]
    found: list[Validation] = []
    for number, believed in enumerate(job.models, 1):
        found.append(validate(*_theta(job, believed), stretches))
        figures += of_validation(found[-1], f"model {number}: ")
        words += [f"model {number} is {believed.name}", *(f"model {number}: {one}" for one in found[-1].findings)]
    ahead = min((1, 2), key=lambda number: found[number - 1].mean("tension", "mae_free"))
    return Outcome(figures=figures, words=sentences([*words, f"a second ahead model {ahead} has the lesser error"]))


def _theta(job: Job, believed: Believed) -> tuple[Theta, Noise]:
    if believed.model is None:
        return nominal_theta(job.line), Noise()
    return theta_of(believed.model), noise_of(believed.model) or Noise()
