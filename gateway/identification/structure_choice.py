"""Which structure the data call for: by evidence, with data that no fit has seen as a witness.

The evidence is the likelihood of the data under a structure with its parameters integrated out (Laplace): a parameter
that explains nothing costs the volume of prior that it excludes. Held-out likelihood needs no prior, and less care.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, isnan, sqrt

import numpy as np

from gateway.control.prediction import Stretch, Unwinder, predict
from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise
from gateway.identification.eccentric_rollers import ENOUGH, eccentric_rollers, with_swings
from gateway.identification.estimate import Structure
from gateway.identification.prediction_error import Fit, fit, fit_stretches, score, stretches_of
from gateway.identification.prior import Prior, prior_of

SHARED = (
    Structure(), Structure(coulomb=True), Structure(torque_lag=True), Structure(coulomb=True, torque_lag=True)
)  # fmt: skip
OPEN = 6.0  #: log evidence that a part of the data leave a structure behind the best, and all of them may turn
SURE = 3.0  #: standard errors by which held-out data must prefer another structure
_LOOKS = 3  #: for eccentric rollers, each with the noise that is left without those found before
ONE_SPEED = 1.3  #: the fastest over the slowest: less is one speed


@dataclass(frozen=True)
class Candidate:
    structure: Structure
    fitted: Fit
    held_out: float | None  #: log-likelihood per sample of data that the fit has not seen
    normalised: float | None  #: and its normalised innovation squared

    @property
    def evidence(self) -> float:
        return self.fitted.evidence


@dataclass(frozen=True)
class Choice:
    candidates: list[Candidate]  #: the most evidence first
    chosen: Candidate
    cautions: list[str]
    turned: tuple[Candidate, float] | None = None  #: what a part chose, and its log evidence less the chosen's from all

    @property
    def fitted(self) -> Fit:
        return self.chosen.fitted


def choose(
    recordings: Sequence[Recording],
    line: Line,
    noise0: Noise,
    held_out: Sequence[Recording] = (),
    *,
    unwinder: Unwinder | None = None,
    measured: dict[str, tuple[float, float]] | None = None,
    priors: Callable[[Structure], Prior] | None = None,
) -> Choice:
    """Fit the structures of the paper, with Coulomb friction and with torque lag, then with rollers that differ.

    Each with the rollers that are eccentric, where the data show any. Where rollers differ is only asked of the
    structure that was best without it, and of what that adds to it: each question is of one term. `measured` as in
    `Prior.measured`; `priors` in place of the line's file. Raises Unpredictable.
    """

    def prior(structure: Structure) -> Prior:
        own = prior_of(line, structure) if priors is None else priors(structure)
        return own.measured(measured or {})

    first = fit(recordings, prior(SHARED[-1]), noise0, unwinder)
    held = stretches_of(held_out, first.stretches[0].unwinder) if held_out else None
    candidates = [_candidate(first, held)]
    if (begin := with_swings(first)) is not None:
        logs, swung = begin
        own = prior(replace(SHARED[-1], eccentric=tuple(range(1, line.n + 1))))
        every = fit_stretches(swung, own, first.noise, start=logs)
        if every.evidence > first.evidence:
            first = every
            candidates.append(_candidate(first, held))
    for _ in range(_LOOKS):
        eccentric = eccentric_rollers(first)
        if eccentric == first.parameters.structure.eccentric:
            break
        own = prior(replace(SHARED[-1], eccentric=eccentric))
        first = fit_stretches(first.stretches, own, first.noise, start=first.logs)
        candidates = [*candidates[:1], _candidate(first, held)]
    eccentric, stretches = first.parameters.structure.eccentric, first.stretches
    for structure in SHARED[:-1]:
        own = prior(replace(structure, eccentric=eccentric))
        # Swings belong to a radius: from the prior's a fit would not come back to them.
        start = own.parameters.logs(first.parameters.theta(first.logs)) if eccentric else None
        candidates.append(_candidate(fit_stretches(stretches, own, first.noise, start=start), held))
    candidates = _one_each(candidates)
    best = _fewest(candidates)
    own = prior(replace(best.structure, per_roller=True))
    start = own.parameters.logs(best.fitted.parameters.theta(best.fitted.logs))
    candidates.append(_candidate(fit_stretches(best.fitted.stretches, own, best.fitted.noise, start=start), held))
    candidates.sort(key=lambda candidate: -_known(candidate.evidence))
    chosen = _fewest(candidates)
    return Choice(candidates, chosen, _cautions(candidates, chosen, stretches, held or []))


def decided(choice: Choice, stretches: list[Stretch], held_out: list[Stretch]) -> tuple[Choice, Fit]:
    """The structure that all data call for, of those that a part of them left open, and its fit to all of them.

    Evidence needs no data held back, and a part of them may be too little: rollers that are each some per cent off
    are taken for alike, whose radius is then wrong by more than they differ. `held_out` is what the part left out.
    """
    best = max(_known(candidate.evidence) for candidate in choice.candidates)
    fits = {
        candidate.structure: fit_stretches(
            stretches, candidate.fitted.prior, candidate.fitted.noise, start=candidate.fitted.logs
        )
        for candidate in choice.candidates
        if candidate is choice.chosen or _known(candidate.evidence) >= best - OPEN
    }
    chosen = _fewest(choice.candidates, {structure: fitted.evidence for structure, fitted in fits.items()})
    fitted = fits[chosen.structure]
    if chosen is choice.chosen:
        return choice, fitted
    turned = choice.chosen, fits[choice.chosen.structure].evidence - fitted.evidence
    return replace(
        choice, chosen=chosen, cautions=_cautions(choice.candidates, chosen, stretches, held_out), turned=turned
    ), fitted


def _one_each(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Of one structure from different beginnings the one with more evidence."""
    return list({one.structure: one for one in sorted(candidates, key=lambda one: _known(one.evidence))}.values())


def _known(evidence: float) -> float:
    """The least where it is no number: neither sorting nor a maximum would say so."""
    return -inf if isnan(evidence) else evidence


def _candidate(fitted: Fit, held: list[Stretch] | None) -> Candidate:
    structure = fitted.parameters.structure
    if held is None:
        return Candidate(structure, fitted, None, None)
    white = np.concatenate([predict(fitted.theta, fitted.noise, stretch).whitened.ravel() for stretch in held])
    return Candidate(structure, fitted, score(fitted, held), float(np.mean(np.square(white))))


def _fewest(candidates: list[Candidate], from_all: Mapping[Structure, float] | None = None) -> Candidate:
    """The one with fewest parameters of those that the best has not 20 to 1 against.

    `from_all`: the evidence of those that it is between, from all data.
    """
    given = {one.structure: one.evidence for one in candidates} if from_all is None else from_all
    evidence = {structure: _known(one) for structure, one in given.items()}
    near = [one for one in candidates if evidence.get(one.structure, -inf) >= max(evidence.values()) - ENOUGH]
    return min(near, key=lambda one: (one.fitted.parameters.size, -evidence[one.structure]))


def _cautions(
    candidates: list[Candidate], chosen: Candidate, stretches: list[Stretch], held: list[Stretch]
) -> list[str]:
    found: list[str] = []
    speeds = np.abs(np.vstack([stretch.points[:, -1:] for stretch in stretches]))
    if speeds.max() < ONE_SPEED * speeds.min():
        told = f"the data have one speed only ({speeds.mean():.3g} m/s)"
        found.append(
            f"{told}: Coulomb friction is told from viscous friction by how fast rollers settle alone; record a second"
            " speed"
        )
    if held:
        own = _log_likelihood(chosen, held)
        for other in candidates:
            gain = _log_likelihood(other, held) - own
            if other is not chosen and gain.mean() * sqrt(len(gain)) > SURE * gain.std():
                found.append(f"held-out data prefer the structure '{other.structure}' to '{chosen.structure}'")
    if not chosen.fitted.converged:
        found.append(f"the fit of the structure '{chosen.structure}' has not converged")
    return found


def _log_likelihood(candidate: Candidate, held: list[Stretch]) -> FloatArray:
    """Of every sample, (k,)."""
    theta = candidate.fitted.theta
    return np.concatenate([predict(theta, candidate.fitted.noise, stretch).log_likelihood for stretch in held])
