"""What bench-identify runs: a simulated line is recorded, and what is identified is held against its truth."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gateway.control.prediction import predict
from gateway.core.recording import Recording
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise
from gateway.identification.estimate import Structure
from gateway.identification.prediction_error import Fit, fit, stretches_of
from gateway.identification.prior import prior_of
from gateway.identification.structure_choice import choose
from gateway.identification.validation import validate
from sim_plant.plant import Plant, load_plant
from tests.bench.control_plants import MOST_FRICTION_NM, scaled
from tests.closed_loop.recorded import demonstration_line, per_roller, real_plant, recorded
from tests.closed_loop.truths import altered, true_values, with_friction_and_lag

SPEED_M_PER_S, FAST_M_PER_S = 0.05, 0.1
HELD_OUT = 1000  #: added to a seed for data that no fit has seen, once more for each speed
STRONG = ("stiffness_per_length", "radius_per_inertia", "friction_per_inertia")
STRESS_M_PER_S2 = 5e-2 / np.sqrt(1e-3)  #: white noise of intensity 5e-2, held for 1 ms


@dataclass(frozen=True)
class Found:
    """By name: estimate over truth less 1, whether the interval covers the truth, and the interval's half width."""

    error: dict[str, float]
    covered: dict[str, bool]
    half_width: dict[str, float]
    noise: Noise
    converged: bool


def against_truth(fitted: Fit, plant: Plant) -> Found:
    """Of the parameters; amplitudes of rollers out of round may be found where there is none, and have no ratio."""
    estimate = fitted.estimate
    truth = true_values(plant, estimate.structure)
    intervals = {name: interval for name, interval in estimate.intervals.items() if name in truth}
    return Found(
        {name: interval.value / truth[name] - 1.0 for name, interval in intervals.items()},
        {name: interval.covers(truth[name]) for name, interval in intervals.items()},
        {name: 0.5 * float(np.log(interval.high / interval.low)) for name, interval in intervals.items()},
        fitted.noise,
        fitted.converged,
    )


def commissioned(seed: int) -> Found:
    """Five seconds of S_real."""
    plant = real_plant()
    return against_truth(fit([recorded(plant, seed)], prior_of(demonstration_line(), Structure()), Noise()), plant)


def drawn_plant(seed: int) -> Plant:
    """From the prior of the line's file, one factor for all rollers and spans; disturbed as S_real is."""
    prior = prior_of(demonstration_line(), Structure())
    generator = np.random.default_rng(seed)
    base = load_plant("sim_plant/plants/s_sim.toml")
    disturbance = real_plant().rollers.disturbance_m_per_s2
    while True:
        logs = generator.multivariate_normal(prior.mean, prior.covariance)
        factors = dict(zip(prior.parameters.names, np.exp(logs - prior.mean).tolist(), strict=True))
        plant = scaled(base, factors)
        p = plant.parameters()
        if (p.friction_nms_per_rad * SPEED_M_PER_S / p.radius_m <= MOST_FRICTION_NM).all():
            rollers = plant.rollers.model_copy(update={"disturbance_m_per_s2": disturbance})
            return plant.model_copy(update={"name": f"drawn-{seed}", "rollers": rollers})


def covered(seed: int) -> Found | None:
    """A plant drawn from the prior; None where the law of the line's file does not hold it."""
    plant = drawn_plant(seed)
    data = recorded(plant, seed, stops="keep")
    if not data.controlled.all():
        return None
    return against_truth(fit([data], prior_of(demonstration_line(), Structure()), Noise()), plant)


def fit_times(seeds: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Seconds on the wall and of the processor, of fits of 5 s x 6 spans; the first, which compiles, left out."""
    recordings = [recorded(real_plant(), seed) for seed in seeds]
    prior = prior_of(demonstration_line(), Structure())
    wall, processor = [], []
    for data in [recordings[0], *recordings]:
        began, worked = time.perf_counter(), time.process_time()
        fit([data], prior, Noise())
        wall.append(time.perf_counter() - began)
        processor.append(time.process_time() - worked)
    return np.array(wall[1:]), np.array(processor[1:])


@dataclass(frozen=True)
class Chosen:
    """What was chosen on 5 s at each of two speeds, and how it does on as much that it has not seen."""

    structure: str
    normalised: dict[float, float]  #: by speed
    worst_output: float  #: the normalised innovation squared farthest from 1
    portmanteau: float
    r2: dict[str, float]  #: "tension", "tension free", "speed", "speed free"
    valid: bool
    findings: list[str]
    found: Found | None  #: None where the plant's truth is no theta
    values: dict[str, float]  #: estimates by name
    half_width: dict[str, float]
    noise: Noise
    evidence: dict[str, float]
    seconds: float  #: of data, in the fit


def at_two_speeds(plant: Plant, seed: int, *, is_theta: bool = True) -> Chosen:
    """Five seconds at each; and as much that the fit has not seen."""
    speeds = (SPEED_M_PER_S, FAST_M_PER_S)
    data = recorded(plant, seed, speeds_m_per_s=speeds)
    unseen = {
        speed: [recorded(plant, seed + HELD_OUT * (1 + i), speeds_m_per_s=(speed,))] for i, speed in enumerate(speeds)
    }
    return chosen(plant, [data], unseen, is_theta=is_theta)


def chosen(plant: Plant, data: list[Recording], held_out: dict[float, list[Recording]], *, is_theta: bool) -> Chosen:
    """`held_out` by speed."""
    line = demonstration_line()
    unseen = [one for some in held_out.values() for one in some]
    choice = choose(data, line, Noise(), unseen)
    fitted = choice.fitted
    theta = fitted.theta
    normalised = {
        speed: float(np.mean([predict(theta, fitted.noise, part).normalised for part in stretches_of(some, "held")]))
        for speed, some in held_out.items()
    }
    validation = validate(theta, fitted.noise, stretches_of(unseen, "held"), Noise())
    intervals = fitted.estimate.intervals
    return Chosen(
        str(choice.chosen.structure),
        normalised,
        max((output.normalised for output in validation.outputs), key=lambda value: abs(np.log(value))),
        validation.portmanteau,
        {
            "tension": validation.mean("tension", "r2"), "tension free": validation.mean("tension", "r2_free"),
            "speed": validation.mean("speed", "r2"), "speed free": validation.mean("speed", "r2_free"),
        },
        validation.valid,
        validation.findings,
        against_truth(fitted, plant) if is_theta else None,
        {name: interval.value for name, interval in intervals.items()},
        {name: 0.5 * float(np.log(interval.high / interval.low)) for name, interval in intervals.items()},
        fitted.noise,
        {str(candidate.structure): candidate.evidence for candidate in choice.candidates},
        fitted.samples * line.control.period_s,
    )  # fmt: skip


def with_friction(seed: int) -> Chosen:
    return at_two_speeds(with_friction_and_lag(real_plant()), seed)


def spread(seed: int) -> Found:
    """Every parameter of every roller up to 10 % off, each by itself; 5 s."""
    plant = per_roller(real_plant(), 0.1, seed)
    prior = prior_of(demonstration_line(), Structure(per_roller=True))
    return against_truth(fit([recorded(plant, seed)], prior, Noise()), plant)


def stressed(seed: int) -> Chosen:
    plant = altered(real_plant(), {"rollers": {"disturbance_m_per_s2": float(STRESS_M_PER_S2)}})
    data, unseen = (_gathered(plant, begin) for begin in (100 * seed, 100 * seed + 50))
    return chosen(plant, data, {SPEED_M_PER_S: unseen}, is_theta=True)


def _gathered(plant: Plant, first: int, seconds: float = 5.0) -> list[Recording]:
    """Runs until there are so many seconds: the gateway takes the jumps of such a line's encoders for a fault."""
    found: list[Recording] = []
    while sum(float(one.controlled.sum()) * one.period_s for one in found) < seconds:
        one = recorded(plant, first + len(found), stops="keep")
        if one.stretches(round(1.0 / one.period_s)):
            found.append(one)
        else:
            first += 1
    return found


def with_eccentricity(seed: int, share: float = 2e-3) -> Chosen:
    """Coulomb friction, lag, and rollers that run out of true by `share` of their radius."""
    plant = altered(with_friction_and_lag(real_plant()), {"effects": {"eccentricity": {"share": share}}})
    generator = np.random.default_rng(seed)
    phases = generator.uniform(0.0, 2.0 * np.pi, plant.spans).tolist()
    plant = altered(plant, {"effects": {"eccentricity": {"phase_rad": phases}}})
    return at_two_speeds(plant, seed)


def with_much_eccentricity(seed: int) -> Chosen:
    """The same, by the half per cent that the gate's simulations have."""
    return with_eccentricity(seed, 5e-3)


def realistic(seed: int) -> Chosen:
    return at_two_speeds(real_plant("realistic"), seed, is_theta=False)
