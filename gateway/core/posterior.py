"""The joint posterior of a line's parameters, as numbers."""

from dataclasses import dataclass

import numpy as np

from gateway.core.line_model import LineModel
from gateway.core.line_model_names import split_name
from gateway.core.line_model_quantities import values_of
from gateway.core.signals import FloatArray


@dataclass(frozen=True)
class Posterior:
    """Normal in the logarithms of the parameters.

    A name without a number, of what rollers or spans have each, is a factor that they have in common, and its logarithm
    that of their geometric mean.
    """

    names: tuple[str, ...]
    mean: FloatArray  #: (k,)
    covariance: FloatArray  #: (k, k)

    @property
    def deviations(self) -> FloatArray:
        """(k,), standard deviations."""
        return np.sqrt(np.diag(self.covariance))


def posterior_of(model: LineModel) -> Posterior | None:
    """Around the model's parameters; None where its file has none."""
    if model.posterior is None:
        return None
    names, values = model.posterior.names, values_of(model)
    mean: list[float] = []
    for name in names:
        base, number = split_name(name)
        its = values[base] if number is None else values[base][number - 1 : number]
        mean.append(float(np.mean(np.log(its))))
    return Posterior(tuple(names), np.array(mean), np.array(model.posterior.covariance))
