"""What is believed, before any data, of what a line's file does not name: Coulomb friction, lag, error of the latency,
and how much rollers and spans of one line differ.

Normal in the logarithm where a standard deviation has no unit.
"""

from collections.abc import Iterable
from math import log, sqrt

from gateway.core.line import Parameter

COULOMB_SHARE, COULOMB_SD = 0.02, 1.0  #: median over the torque limit; standard deviation of the logarithm
LAG_S, LAG_SD = 0.003, 0.7  #: median of the drives' torque lag; standard deviation of the logarithm
LATENCY_SD_S = 0.002  #: the truth against the file's
ROLLERS_DIFFER = 0.1  #: from what all have in common, as a fraction either way; lengths of spans likewise
COULOMB_DIFFERS = 3.0  #: times as much


def deviation(tolerance: float) -> float:
    """Standard deviation of the logarithm of what lies within this fraction either way, anywhere alike."""
    return log(1.0 + tolerance) / sqrt(3.0)


def widest(parameters: Iterable[Parameter]) -> float:
    """The tolerance that all rollers, or all spans, have in common: a fraction either way."""
    return max(parameter.tolerance for parameter in parameters)
