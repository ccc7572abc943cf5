"""What an estimator says: theta, how sure it is of it, and what it has seen."""

from dataclasses import dataclass

from gateway.core.posterior import Posterior
from gateway.core.theta import Noise, Theta


@dataclass(frozen=True)
class Interval:
    """Of 95 %."""

    value: float
    low: float
    high: float

    def covers(self, truth: float) -> bool:
        return self.low <= truth <= self.high


@dataclass(frozen=True)
class Structure:
    """Which parameters a model has beside those of the paper, and whether rollers and spans differ."""

    per_roller: bool = False  #: radius, inertia, friction and length each by itself; else one factor for all
    coulomb: bool = False
    torque_lag: bool = False

    def __str__(self) -> str:
        named = {"per roller": self.per_roller, "Coulomb friction": self.coulomb, "torque lag": self.torque_lag}
        return ", ".join(name for name, there in named.items() if there) or "as in the paper"


@dataclass(frozen=True)
class Estimate:
    """Of one method, from one set of data."""

    method: str
    structure: Structure
    theta: Theta
    noise: Noise | None  #: None: the method says nothing of it
    #: By name: stiffness_n, length_m, radius_m, inertia_kg_m2, friction_nms_per_rad, coulomb_nm, torque_lag_s,
    #: latency_s, and the combinations stiffness_per_length (EA/L, N/m), radius_per_inertia (R/J), friction_per_inertia
    #: (f/J) and radius2_per_inertia (R^2/J); "inertia_kg_m2[3]" (from 1) where rollers differ. Of what the data do not
    #: tell, as wide as the prior.
    intervals: dict[str, Interval]
    samples: int
    posterior: Posterior | None = None  #: of all parameters together; None: the method does not say
