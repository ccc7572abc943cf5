"""How well a model predicts the excited parts of recordings, one sample ahead."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from gateway.control.prediction import Predicted, Stretch, predict, stretch_of
from gateway.core.line import Line
from gateway.core.line_model import LineModel, model_hash, theta_of
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise, Theta
from safety.case import Case
from safety.excitation import MOST, Excited, newest, same_speed

KEPT = 12  #: parts of predictions, of a megabyte each


@dataclass(frozen=True)
class Foretold:
    """A part, and a model's predictions of it."""

    part: Excited
    predicted: Predicted


def foretold(theta: Theta, noise: Noise, parts: Sequence[Excited]) -> list[Foretold]:
    """Between samples the unwinder's speed goes straight or stays, whichever says more. Raises Unpredictable."""
    found: list[Foretold] = []
    for part in parts:
        both = [predict(theta, noise, stretch_of(part.recording, way)) for way in ("linear", "held")]
        found.append(Foretold(part, max(both, key=lambda one: float(one.log_likelihood.sum()))))
    return found


def foretold_of(case: Case, model: LineModel, noise: Noise, most: float = MOST) -> list[Foretold]:
    """The newest excited parts of the case by a model with its noise. Raises Unpredictable.

    Several rules ask for it, and one proposal after another about the same model and data: it is kept.
    """
    theta, whose = theta_of(model), model_hash(model)
    parts = newest(case.excited, case.line, most)
    return [_kept(_Asked((whose, part.recording.digest()), noise, theta, part)) for part in parts]


@dataclass(frozen=True)
class _Asked:
    """Equal where model, noise and numbers are."""

    key: tuple[str, str]  #: hash of the model, digest of the numbers
    noise: Noise
    theta: Theta = field(compare=False)
    part: Excited = field(compare=False)


@lru_cache(maxsize=KEPT)
def _kept(asked: _Asked) -> Foretold:
    return foretold(asked.theta, asked.noise, [asked.part])[0]


def with_swings(predicted: Predicted) -> Stretch:
    """Its stretch, with the rollers as far out of round as was learned by its end."""
    swung = predicted.swung
    return predicted.stretch if swung is None else replace(predicted.stretch, swing=swung.before[-1])


def normalised(found: Sequence[Foretold]) -> float:
    """Mean of e' S^-1 e / m over all parts; 1 for a true model. Infinite where the predictions have run away."""
    squares = np.concatenate([np.square(one.predicted.whitened).ravel() for one in found])
    mean = float(np.mean(squares))
    return mean if np.isfinite(mean) else np.inf


def normalised_by_output(found: Sequence[Foretold]) -> tuple[list[str], FloatArray]:
    """Names of the outputs, and the same of each."""
    counts = [one.predicted.stretch.predictions for one in found]
    each = np.average([one.predicted.normalised_squared for one in found], axis=0, weights=counts)
    return found[0].predicted.stretch.names, np.where(np.isfinite(each), each, np.inf)


def by_speed(found: Sequence[Foretold], line: Line) -> list[tuple[float, list[Foretold]]]:
    """By ascending speed, parts at one speed together."""
    groups: list[tuple[float, list[Foretold]]] = []
    for one in sorted(found, key=lambda each: each.part.speed_m_per_s):
        if groups and same_speed(one.part.speed_m_per_s, groups[-1][0], line):
            groups[-1][1].append(one)
        else:
            groups.append((one.part.speed_m_per_s, [one]))
    return groups


def seconds(found: Sequence[Foretold]) -> float:
    """Of data."""
    return sum(one.part.recording.samples * one.part.recording.period_s for one in found)
