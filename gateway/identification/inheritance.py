"""An earlier model as the prior of the next: widened for drift, and believed only where new data do not contradict it.

Under a prior N(m, P) and data that leave the posterior covariance C, the estimate moves from m by a random x with the
covariance P - C. In the axes in which P is the unit matrix, P - C has the eigenvalues s_j, the share of the prior's
variance that the data take away, and sum_j x_j^2 / s_j is chi-square distributed. The line has left the prior where
this sum, or its greatest term (by Bonferroni), is beyond 95 %: a false alarm costs no more than what the earlier model
would have helped.

What the data tell less of than the earlier model (s_j below a half) they cannot check: there a wrong parent stays
unseen. That is why the line's file, which no estimate has made, is the prior unless somebody asks for another.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from gateway.core.line import Line
from gateway.core.line_model import LineModel, model_hash, theta_of
from gateway.core.posterior import posterior_of
from gateway.core.recording import Recording
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise
from gateway.identification.estimate import Structure
from gateway.identification.identify import Identified, identify
from gateway.identification.parameters import Parameters
from gateway.identification.prediction_error import Fit
from gateway.identification.prior import Prior, prior_after, prior_of

DRIFT = 0.05  #: of each parameter either way since the earlier model: as much as designs and rehearsals leave open
CONFIDENCE = 0.95
TELLS_NOTHING = 0.01  #: of the prior's variance taken away
CHECKED = 0.5  #: the same, from which on the data tell more than the prior did


class NotInherited(ValueError):
    """The model can be no prior; the text says why."""


@dataclass(frozen=True)
class Agreement:
    """Of data with a prior."""

    statistic: float
    degrees: int  #: directions of which the data tell something
    worst: float  #: the greatest term
    unchecked: int  #: directions of which the data tell less than the prior

    @property
    def agrees(self) -> bool:
        if not self.degrees:
            return True
        each = 1.0 - (1.0 - CONFIDENCE) / self.degrees
        return self.statistic <= float(chi2.ppf(CONFIDENCE, self.degrees)) and self.worst <= float(chi2.ppf(each, 1))


@dataclass(frozen=True)
class Inherited:
    """What came of a model that should be the prior."""

    found: Identified
    parent: str | None  #: hash of the model that was the prior; None: the line's file was
    words: list[str]


def identify_after(
    parent: LineModel,
    recordings: Sequence[Recording],
    line: Line,
    noise0: Noise,
    clock: Callable[[], float],
    *,
    measured: Mapping[str, tuple[float, float]] | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> Inherited:
    """`identify` with `parent` as the prior; with the line's file where the data disagree with it.

    Raises NotInherited, and NotIdentified.
    """
    earlier = earlier_of(parent, line)
    name = f"the model {model_hash(parent)[:12]}"
    found = identify(recordings, line, noise0, clock, measured=measured, tell=tell, priors=earlier.prior)
    agreement = agreement_of(found.fitted)
    told = (
        f"chi-square {agreement.statistic:.1f} with {agreement.degrees} degrees of freedom, its greatest term "
        f"{agreement.worst:.1f}"
    )
    if agreement.agrees:
        words = [f"the prior is {name}, widened by {DRIFT:.0%} for drift; the data agree with it ({told})"]
        if agreement.unchecked:
            words.append(
                f"in {agreement.unchecked} of {found.fitted.parameters.size} directions that model tells more than "
                "these data, which cannot check it there: without --prior the line's file speaks in its place"
            )
        return Inherited(found, model_hash(parent), words)
    tell("the data disagree with the earlier model: once more from the line's file")
    found = identify(recordings, line, noise0, clock, measured=measured, tell=tell)
    words = [f"the data disagree with {name}, widened by {DRIFT:.0%} for drift ({told}): the prior is the line's file"]
    return Inherited(found, None, words)


@dataclass(frozen=True)
class Earlier:
    """The posterior of a model, with the parameters that it is of."""

    line: Line
    under: Prior  #: of its structure
    mean: FloatArray  #: (p,)
    covariance: FloatArray  #: (p, p)

    def prior(self, structure: Structure) -> Prior:
        """For another estimate, widened by `DRIFT`."""
        return prior_after(self.under, self.mean, self.covariance, prior_of(self.line, structure), drift=DRIFT)


def earlier_of(model: LineModel, line: Line) -> Earlier:
    """Raises NotInherited."""
    name = f"the model of {model.site}/{model.line} made {model.created}"
    if (model.site, model.line, model.n) != (line.site, line.line, line.n):
        raise NotInherited(f"{name} with {model.n} spans is none of {line.site}/{line.line} with {line.n}")
    posterior = posterior_of(model)
    if posterior is None:
        raise NotInherited(f"{name} has no posterior, which a prior is made from: take the line's file")
    structure = Structure(**model.structure.model_dump())
    parameters = Parameters(structure, theta_of(model), "latency_s" in posterior.names)
    if sorted(parameters.names) != sorted(posterior.names):
        raise NotInherited(
            f"the posterior of {name} has {', '.join(posterior.names)}; its structure {', '.join(parameters.names)}"
        )
    order = [posterior.names.index(one) for one in parameters.names]
    mean, covariance = posterior.mean[order], posterior.covariance[np.ix_(order, order)]
    return Earlier(line, Prior(parameters, mean, covariance), mean, covariance)


def agreement_of(fitted: Fit) -> Agreement:
    """Of the data of a fit with its prior."""
    prior = fitted.prior
    whiten: FloatArray = np.asarray(np.linalg.inv(np.linalg.cholesky(prior.covariance)), dtype=np.float64)
    left = whiten @ fitted.covariance @ whiten.T
    left_shares, axes = np.linalg.eigh(0.5 * (left + left.T))
    shares = 1.0 - left_shares
    along = axes.T @ whiten @ (fitted.logs - prior.mean)
    told = shares > TELLS_NOTHING
    terms: FloatArray = along[told] ** 2 / shares[told]
    return Agreement(float(terms.sum()), int(told.sum()), float(terms.max(initial=0.0)), int((shares < CHECKED).sum()))
