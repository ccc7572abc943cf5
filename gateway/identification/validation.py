"""Whether a model holds on data that it was not made from: size and whiteness of innovations, errors in N and m/s."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import pi

import numpy as np
from scipy.stats import chi2

from gateway.control.prediction import Predicted, Stretch, free_run, predict
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise, Theta
from gateway.identification.whiteness import Line as SpectralLine
from gateway.identification.whiteness import portmanteau, portmanteau_of_all, strongest_line

NORMALISED = (0.8, 1.2)  #: of all outputs together: where a valid model is
EACH = (0.6, 1.5)  #: of one output
FREE_RUN_S = 1.0  #: how far ahead the model is left to itself
RISK = 0.01  #: that whiteness is denied of a true model, all outputs together
_TOO_QUIET = 0.2  #: of what was expected: measuring noise that a fit has pushed aside
_TOO_LOUD = 3.0
_INSISTS = 3.0  #: in the log-likelihood


@dataclass(frozen=True)
class Output:
    """Of one load cell or encoder, in its own unit."""

    name: str  #: "tension 1"
    r2: float  #: of predicting one sample ahead
    r2_free: float  #: of the model left to itself for 1 s
    mae: float
    mae_free: float
    normalised: float  #: innovation squared over its variance, in the mean; 1 wanted
    portmanteau: float  #: Ljung-Box statistic over its quantile: white up to 1


@dataclass(frozen=True)
class Validation:
    outputs: list[Output]
    normalised: float  #: of all outputs together
    normalised_per_stretch: list[float]
    portmanteau: float  #: of all outputs and between them, statistic over quantile: white up to 1
    valid: bool
    findings: list[str]  #: what is wrong, in plain words; none for a model that holds
    recommendations: list[str]
    samples: int

    def mean(self, quantity: str, name: str) -> float:
        """Of "tension" or "speed", of a field of `Output`."""
        return float(np.mean([getattr(output, name) for output in self.outputs if output.name.startswith(quantity)]))


def validate(theta: Theta, noise: Noise, stretches: Sequence[Stretch], expected: Noise | None = None) -> Validation:
    """On stretches that the model has not seen, all with the same load cells. Raises Unpredictable.

    `expected`: the noise as the sensors' data sheets have it. A fit can make up for a wrong structure by noise, and
    innovations are then of the size that it says; they are not white, and the noise is not what was expected.
    """
    predicted = [predict(theta, noise, stretch) for stretch in stretches]
    white = [one.whitened for one in predicted]
    outputs = _outputs(theta, predicted)
    together = portmanteau_of_all(white, RISK)
    normalised = float(np.mean(np.concatenate([np.square(part).ravel() for part in white])))
    findings, advice = _judged(outputs, normalised, together)
    if expected is not None:
        _judge_noise(theta, noise, expected, predicted, findings, advice)
    if together > 1.0:
        _name_line(theta, predicted, findings, advice)
    return Validation(
        outputs, normalised, [one.normalised for one in predicted], together, not findings, findings, advice,
        sum(len(part) for part in white),
    )  # fmt: skip


def _outputs(theta: Theta, predicted: list[Predicted]) -> list[Output]:
    stretches = [one.stretch for one in predicted]
    measured = np.vstack([stretch.measured[stretch.first + 1 :] for stretch in stretches])
    errors = np.vstack([one.innovation for one in predicted])
    free, at = _left_alone(theta, predicted)
    counts = np.array([len(one.innovation) for one in predicted])
    squared = np.average([one.normalised_squared for one in predicted], axis=0, weights=counts)
    names, risk = stretches[0].names, RISK / measured.shape[1]
    return [
        Output(
            names[j], _r2(errors[:, j], measured[:, j]), _r2(free[:, j], at[:, j]), float(np.abs(errors[:, j]).mean()),
            float(np.abs(free[:, j]).mean()) if len(free) else float("nan"), float(squared[j]),
            portmanteau([one.whitened[:, j] for one in predicted], risk),
        )
        for j in range(len(names))
    ]  # fmt: skip


def _left_alone(theta: Theta, predicted: list[Predicted]) -> tuple[FloatArray, FloatArray]:
    """Errors of the last sample of every free run, one beginning each quarter of its length, and what was measured."""
    errors: list[FloatArray] = []
    measured: list[FloatArray] = []
    for one in predicted:
        length = max(round(FREE_RUN_S / one.stretch.recording.period_s), 1)
        for begin in range(0, len(one.innovation) - length, max(length // 4, 1)):
            errors.append(free_run(theta, one, begin, length)[-1])
            measured.append(one.stretch.measured[one.stretch.first + 1 + begin + length])
    width = predicted[0].innovation.shape[1]
    return np.array(errors).reshape(-1, width), np.array(measured).reshape(-1, width)


def _r2(errors: FloatArray, measured: FloatArray) -> float:
    if len(measured) < 2 or np.ptp(measured) == 0.0:
        return float("nan")
    return 1.0 - float(np.square(errors).sum() / np.square(measured - measured.mean()).sum())


def _judged(outputs: list[Output], normalised: float, together: float) -> tuple[list[str], list[str]]:
    findings: list[str] = []
    advice: list[str] = []
    low, high = NORMALISED
    if not low <= normalised <= high:
        findings.append(f"normalised innovation squared is {normalised:.2f}, {low} to {high} is valid")
    loud = [output for output in outputs if not output.normalised <= EACH[1]]  # what is no number, too
    quiet = [output for output in outputs if output.normalised < EACH[0]]
    for word, some in (("larger", loud), ("smaller", quiet)):
        if some:
            told = ", ".join(f"{output.name} {output.normalised:.2f}" for output in some)
            findings.append(f"innovations are {word} than the noise explains: {told}; {EACH[0]} to {EACH[1]} is valid")
    if loud:
        advice.append(_where(loud))
    if quiet or normalised < low:
        advice.append("identify the noise anew on these data: the model takes it for greater than it is")
    if together > 1.0:
        worst = max(outputs, key=lambda output: output.portmanteau)
        findings.append(
            f"innovations are not white: portmanteau statistic {together:.2f} of its quantile"
            f" ({1 - RISK:.0%}), most of all {worst.name} ({worst.portmanteau:.2f})"
        )
        advice.append(
            "try a richer structure (Coulomb friction, torque lag, rollers that differ), and check the latency"
        )
    return findings, advice


def _where(loud: list[Output]) -> str:
    tension = [output.name for output in loud if output.name.startswith("tension")]
    if len(tension) == len(loud):
        return f"look at load cells and spans first ({', '.join(tension)}): stiffness, length, a slipping web"
    return f"look at drives and bearings first ({', '.join(o.name for o in loud)}): friction, torque lag, latency"


def _judge_noise(
    theta: Theta, noise: Noise, expected: Noise, predicted: list[Predicted], findings: list[str], advice: list[str]
) -> None:
    """Measuring noise far from what was expected, where the data insist on it."""
    for name, unit in (("tension_n", "N"), ("speed_m_per_s", "m/s")):
        found, wanted = getattr(noise, name), getattr(expected, name)
        if _TOO_QUIET * wanted <= found <= _TOO_LOUD * wanted:
            continue
        as_expected = replace(noise, **{name: wanted})
        gain = sum(
            float((one.log_likelihood - predict(theta, as_expected, one.stretch).log_likelihood).sum())
            for one in predicted
        )
        if not gain <= _INSISTS:
            findings.append(f"noise of {name.split('_')[0]} came out as {found:.2g} {unit}, {wanted:.2g} was expected")
            advice.append(
                "the fit makes up for a wrong structure by noise, or a sensor is not what its data sheet says"
            )


def _name_line(theta: Theta, predicted: list[Predicted], findings: list[str], advice: list[str]) -> None:
    """Whose turn the strongest spectral line at one speed is."""
    found: list[tuple[SpectralLine, FloatArray, str]] = []
    for one in predicted:
        stretch, speed = one.stretch, one.stretch.recording.speed_m_per_s[one.stretch.first + 1 :]
        point = stretch.point[stretch.first + 1 :]
        for at in np.unique(point).tolist():
            line = strongest_line(one.whitened[point == at], stretch.recording.period_s)
            if line is not None:
                found.append((line, speed[point == at].mean(axis=0), stretch.names[line.output]))
    if not found:
        return
    line, speed, name = max(found, key=lambda each: each[0].share)
    turns_hz = speed / (2.0 * pi * theta.web.radius_m)
    near = np.flatnonzero(np.abs(turns_hz - line.frequency_hz) < line.resolution_hz)
    findings.append(f"innovations of {name} have a spectral line at {line.frequency_hz:.2f} Hz")
    if len(near):
        which = f"roller {near[0] + 1}" if len(near) == 1 else "the rollers"
        advice.append(f"that is a turn of {which}: eccentricity beyond what the model has")
    else:
        advice.append("something turns or swings at that frequency: the unwinder, a gear, a dancer")


def normalised_band(samples: int, outputs: int, level: float = 0.95) -> tuple[float, float]:
    """Within which the normalised innovation squared of a true model lies."""
    freedom = samples * outputs
    low, high = (float(chi2.ppf(0.5 + 0.5 * side * level, freedom)) / freedom for side in (-1.0, 1.0))
    return low, high
