"""The joint posterior in a model file: how the errors of its parameters hang together, which single intervals hide."""

from collections.abc import Iterator
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from gateway.core.line import Strict
from gateway.core.line_model_names import MOST_SPANS, OF_THE_LINE, PARAMETERS, split_name, wrong_name
from gateway.core.signals import FloatArray

MOST_NAMES = len(OF_THE_LINE) + (len(PARAMETERS) - len(OF_THE_LINE)) * MOST_SPANS
MOST_DEVIATION = 3.0  #: of a logarithm, a factor of 20 either way: what is known no better has not been found
ROUNDED = 1e-9  #: relative; by this much a file may be asymmetric, or an eigenvalue below 0


class ModelPosterior(Strict):
    """Normal in the logarithms of the parameters, around those of `ModelParameters`.

    A name without a number, of what rollers or spans have each, is a factor that they have in common.
    """

    names: Annotated[list[str], Field(min_length=1, max_length=MOST_NAMES)]
    covariance: list[Annotated[list[float], Field(max_length=MOST_NAMES)]]  #: (k, k), of the logarithms

    @model_validator(mode="after")
    def _check(self) -> Self:
        if wrong := [*_wrong_covariance(self)]:
            raise ValueError("; ".join(wrong))
        return self


def _wrong_covariance(posterior: ModelPosterior) -> Iterator[str]:
    k, rows = len(posterior.names), posterior.covariance
    lengths = {len(row) for row in rows}
    if len(rows) != k or lengths != {k}:
        yield f"covariance has {len(rows)} rows of {min(lengths, default=0)} to {max(lengths, default=0)} entries; "\
              f"allowed: {k} of {k}, as there are names"  # fmt: skip
        return
    covariance = np.array(rows)
    variances: FloatArray = np.diag(covariance)
    if variances.min() < 0.0 or variances.max() > MOST_DEVIATION**2:
        worst = int(np.argmax(np.where(variances < 0.0, np.inf, variances)))
        yield (
            f"covariance: {posterior.names[worst]} has the variance {variances[worst]:g}; allowed: 0 to "
            f"{MOST_DEVIATION**2:g}, of a logarithm"
        )
        return
    if np.abs(covariance - covariance.T).max() > ROUNDED * max(float(variances.max()), np.finfo(float).tiny):
        i, j = np.unravel_index(int(np.argmax(np.abs(covariance - covariance.T))), covariance.shape)
        yield (
            f"covariance is not symmetric: {covariance[i, j]:g} and {covariance[j, i]:g} between "
            f"{posterior.names[int(i)]} and {posterior.names[int(j)]}"
        )
        return
    least = float(np.linalg.eigvalsh(covariance)[0])
    if least < -ROUNDED * float(variances.max()):
        yield f"covariance is not positive semidefinite: it has the eigenvalue {least:g}"


def wrong_names(posterior: ModelPosterior, n: int, values: dict[str, list[float]]) -> Iterator[str]:
    """Names that a model of n spans does not have, has twice, or of whose value (`values`, by base) there is no
    logarithm."""
    seen: dict[str, set[int | None]] = {}
    for name in posterior.names:
        faults = list(wrong_name(name, n, PARAMETERS))
        yield from (f"posterior.names, {name}: {fault}" for fault in faults)
        if faults:
            continue
        base, number = split_name(name)
        others = seen.setdefault(base, set())
        if number in others or (others and None in (number, *others)):
            yield f"posterior.names, {name}: it is there already; allowed: one for all, or each by its number"
        others.add(number)
        its = values[base] if number is None else values[base][number - 1 : number]
        if min(its) <= 0.0:
            yield f"posterior.names, {name}: its value is {min(its):g}, which has no logarithm; leave it out"
