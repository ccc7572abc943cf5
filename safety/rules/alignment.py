"""Whether every channel tells its value at the time that it is given: a few milliseconds late, and a loop swings.

A channel that is late by d shows y - d y'. What that does to the innovations w (white, of size 1) is linear, w = d s:
least squares give d = s'w / s's with the variance 1 / s's. y' is taken from what was predicted up to the sample before,
which no innovation has touched yet: of a true model the mean of d is 0. A torque jumps from period to period, and its
slope is another for late and for early: what is told late was already the next one, what is told early still the one
before. Whichever explains more counts.
"""

from dataclasses import replace

import numpy as np

from gateway.control.prediction import Predicted, Stretch, innovations, whitened
from gateway.core.line_model import LineModel, noise_of, theta_of
from gateway.core.signals import FloatArray
from gateway.core.theta import Theta
from gateway.core.verdict import RuleFinding
from safety.case import Case
from safety.findings import at_most, told
from safety.predicting import Foretold, foretold_of, with_swings

RULE = "alignment"
MOST = 1000.0  #: moments of data that are looked at
SURE = 1.96  #: standard deviations
PROBE = 0.1  #: of a period


def check(case: Case) -> list[RuleFinding]:
    """By how much a channel tells late at the least, in seconds, against gate.alignment_max_s."""
    if case.context.model is None:
        return [told(RULE, False, "no model is accepted by which channels could be compared")]
    return of_model(case, case.context.model)


def of_model(case: Case, model: LineModel, name: str = RULE) -> list[RuleFinding]:
    """By any model."""
    noise, most_s = noise_of(model), case.line.gate.alignment_max_s
    if noise is None or not case.excited:
        return [told(name, False, "there are no data by which channels could be compared: see model validity")]
    found = foretold_of(case, model, noise, MOST)
    names = channels(found[0].predicted.stretch)
    late_s, spread_s = lateness(theta_of(model), found)
    if np.isnan([late_s, spread_s]).any():  # a channel that tells nothing is endless, not this
        return [told(name, False, "the model's predictions run away, so that no channel can be compared with them")]
    known = np.flatnonzero(SURE * spread_s <= most_s)
    if not len(known):
        return [told(name, False, "the data do not tell whether channels are aligned: a longer or larger experiment")]
    at_least_s = np.maximum(np.abs(late_s) - SURE * spread_s, 0.0)[known]
    worst = known[int(at_least_s.argmax())]
    text = (
        f"{names[worst]} tells {1e3 * late_s[worst]:+.1f} ms late, within {1e3 * SURE * spread_s[worst]:.1f} ms; "
        f"allowed: gate.alignment_max_s, {1e3 * most_s:g} ms either way, as far as its interval goes; "
        f"{len(known)} of {len(names)} channels tell"
    )
    return [at_most(name, float(at_least_s.max()), most_s, "s", text)]


def channels(stretch: Stretch) -> list[str]:
    """In the order of `lateness`."""
    return [*stretch.names, *(f"torque {i + 1}" for i in range(stretch.n))]


def lateness(theta: Theta, found: list[Foretold]) -> tuple[FloatArray, FloatArray]:
    """Of each channel by itself, the others taken for right: seconds, and their standard deviation (c,)."""
    information = gradient = np.zeros((2, len(channels(found[0].predicted.stretch))))
    for one in found:
        shown, white = sensitivities(theta, one.predicted)
        information = information + np.square(shown).sum(axis=(2, 3))
        gradient = gradient + (shown * white).sum(axis=(2, 3))
    with np.errstate(divide="ignore", invalid="ignore"):
        late, spread = gradient / information, 1.0 / np.sqrt(information)
    late = np.where(information == 0.0, 0.0, late)  # what is no number stays so
    more = (gradient * late).argmax(axis=0)[np.newaxis]
    return np.take_along_axis(late, more, axis=0)[0], np.take_along_axis(spread, more, axis=0)[0]


def sensitivities(theta: Theta, predicted: Predicted) -> tuple[FloatArray, FloatArray]:
    """What a second's lateness of each channel does to the whitened innovations, (2, c, k, m), and these, (k, m).

    First by the slope from the sample before, then, of torques, by that to the next one, where what is measured does
    not act on the torque within a period: else an innovation would be in the slope that it is held against. Rollers out
    of round turn as was learned from the whole stretch, whatever a channel tells.
    """
    stretch, period_s = with_swings(predicted), predicted.stretch.recording.period_s
    before = np.zeros_like(stretch.measured)
    states = predicted.state[:, stretch.outputs]
    before[stretch.first + 2 :] = np.diff(states, axis=0) / period_s
    change = PROBE * period_s * before
    rows = [_whitened(theta, predicted, replace(stretch, measured=_moved(stretch.measured, change, j)))
            for j in range(before.shape[1])]  # fmt: skip
    jumps = np.diff(stretch.torque_nm, axis=0, prepend=stretch.torque_nm[:1], append=stretch.torque_nm[-1:]) / period_s
    turned = [
        [_whitened(theta, predicted, replace(stretch, torque_nm=_moved(stretch.torque_nm, PROBE * period_s * slope, j)))
         for j in range(stretch.n)]
        for slope in (jumps[:-1], jumps[1:] if theta.latency_s >= period_s - 1e-9 else jumps[:-1])
    ]  # fmt: skip
    white = _whitened(theta, predicted, stretch)
    return (np.array([[*rows, *either] for either in turned]) - white) / (PROBE * period_s), white


def _moved(values: FloatArray, change: FloatArray, column: int) -> FloatArray:
    moved = values.copy()
    moved[:, column] -= change[:, column]
    return moved


def _whitened(theta: Theta, predicted: Predicted, stretch: Stretch) -> FloatArray:
    innovation, _ = innovations([theta], stretch, predicted.gains)
    return whitened(innovation, predicted.gains)[0]
