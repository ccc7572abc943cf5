"""How well a model predicts the excited parts of recordings, one sample ahead."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gateway.control.prediction import Predicted, predict, stretch_of
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise, Theta
from safety.excitation import Excited, same_speed


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


def normalised(found: Sequence[Foretold]) -> float:
    """Mean of e' S^-1 e / m over all parts; 1 for a true model. Infinite where the predictions have run away."""
    squares = np.concatenate([np.square(one.predicted.whitened).ravel() for one in found])
    mean = float(np.mean(squares))
    return mean if np.isfinite(mean) else np.inf


def normalised_by_output(found: Sequence[Foretold]) -> tuple[list[str], FloatArray]:
    """Names of the outputs, and the same of each."""
    counts = [one.predicted.stretch.predictions for one in found]
    each = np.average([one.predicted.normalised_squared for one in found], axis=0, weights=counts)
    return found[0].predicted.stretch.names, np.nan_to_num(each, nan=np.inf)


def by_speed(found: Sequence[Foretold]) -> list[tuple[float, list[Foretold]]]:
    """By ascending speed, parts at one speed together."""
    groups: list[tuple[float, list[Foretold]]] = []
    for one in sorted(found, key=lambda each: each.part.speed_m_per_s):
        if groups and same_speed(one.part.speed_m_per_s, groups[-1][0]):
            groups[-1][1].append(one)
        else:
            groups.append((one.part.speed_m_per_s, [one]))
    return groups


def seconds(found: Sequence[Foretold]) -> float:
    """Of data."""
    return sum(one.part.recording.samples * one.part.recording.period_s for one in found)
