"""A controller's way onto a running line: what is deployed, for what it was judged, and what is in service.

The gateway deploys, the loop decides: it takes a deployment only as the successor of the last one, keeps it on
probation for as long as the lease is renewed, and goes back to the last known good by itself.
"""

from itertools import pairwise
from typing import Annotated, Self

from pydantic import Field, model_validator

from gateway.core.controller import ControllerConfig
from gateway.core.controller_laws import Feedforward, Matrix
from gateway.core.finding import Finding
from gateway.core.line import Line, NonNegative, Positive, Strict
from gateway.core.line_scales import line_scales

Hash = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]  #: `controller.config_hash`
Epoch = Annotated[int, Field(ge=1, le=2**53)]  #: of deployments, one after the other, also over restarts
LONGEST_LEASE_S = 60.0


class Region(Strict):
    """What a configuration has been judged for. None: as far as the line's own limits."""

    speed_max_m_per_s: Positive | None = None
    tension_step_max_n: NonNegative | None = None
    speed_step_max_m_per_s: NonNegative | None = None

    def and_also(self, other: "Region") -> "Region":
        """As far as either goes."""
        both = ((name, value, getattr(other, name)) for name, value in self.model_dump().items())
        return Region(**{name: None if None in (a, b) else max(a, b) for name, a, b in both})

    def no_further(self, other: "Region") -> "Region":
        """Only as far as both go."""
        both = ((name, value, getattr(other, name)) for name, value in self.model_dump().items())
        return Region(**{name: min((one for one in (a, b) if one is not None), default=None) for name, a, b in both})

    def within(self, other: "Region") -> bool:
        """Whether it goes nowhere beyond `other`."""
        mine, its = self.model_dump(), other.model_dump()
        return all(its[name] is None or (mine[name] is not None and mine[name] <= its[name]) for name in its)


def first_region(line: Line) -> Region:
    """Of a first configuration, and of whatever runs once nothing is known of the line any more."""
    limits, gate = line.limits, line.gate
    fastest = min(gate.first_speed_max_m_per_s, limits.speed_max_m_per_s)
    return Region(
        speed_max_m_per_s=fastest,
        tension_step_max_n=min(limits.tension_step_max_n, gate.first_step_max_n),
        speed_step_max_m_per_s=min(limits.speed_step_max_m_per_s, fastest),
    )


SHARE_SHOWN = 0.1  #: of the first region's greatest speed, that a change of speed must have to show anything


def least_shown(line: Line) -> tuple[float, float]:
    """The smallest move (N) and the smallest change of speed (m/s) by which a first configuration shows that it holds.

    At most what is small on the line; what is smaller still, noise would hide.
    """
    scales, most = line_scales(line), first_region(line).speed_max_m_per_s
    least_m_per_s = scales.speed_m_per_s if most is None else min(scales.speed_m_per_s, SHARE_SHOWN * most)
    return scales.tension_n, least_m_per_s


class RecoveryNode(Strict):
    """The accepted model, sampled and linear, near one speed of the unwinder.

    With x~ = [T - T_eq; v - v_eq] in N and m/s and u~ = u - u_eq in Nm, away from the model's equilibrium at the
    set-points and the unwinder's speed of the moment:

        x~_{k+1} = transition x~_k + sum_j inputs[j] u~_{k-j},  u_{k-j} the torque computed j periods ago
    """

    speed_m_per_s: NonNegative
    transition: Matrix  #: (2n, 2n)
    inputs: Annotated[list[Matrix], Field(min_length=1)]  #: (2n, n) each


class RecoveryPrediction(Strict):
    """Whether a fallback configuration would still recover the line, from any state: what the loop computes it from."""

    fallback: Hash  #: the configuration that is switched to; where that is the one that runs, the line stops
    period_s: Positive
    horizon_s: Positive  #: that is looked ahead
    margin_n: (
        NonNegative  #: that tensions must keep from their limits; half of what the set-point keeps, if that is less
    )
    model: Feedforward  #: the accepted model, whose equilibria are meant
    coulomb_nm: list[NonNegative]  #: (n,), its dry friction
    nodes: Annotated[list[RecoveryNode], Field(min_length=1)]  #: by ascending speed; the nearest one is used

    @property
    def n(self) -> int:
        return len(self.model.radius_m)

    @model_validator(mode="after")
    def _check(self) -> Self:
        speeds = [node.speed_m_per_s for node in self.nodes]
        if any(low >= high for low, high in pairwise(speeds)):
            raise ValueError(f"speeds of the nodes are {speeds}; allowed: ascending")
        if len({len(node.inputs) for node in self.nodes}) > 1:
            raise ValueError("nodes with different dead times: all have as many inputs")
        if len(self.coulomb_nm) != self.n:
            raise ValueError(f"{len(self.coulomb_nm)} values of coulomb_nm for {self.n} rollers")
        if self.horizon_s < self.period_s:
            raise ValueError(f"horizon_s {self.horizon_s:g} is shorter than a period of {self.period_s:g} s")
        for at, node in enumerate(self.nodes):
            _require(f"nodes[{at}].transition", node.transition, (2 * self.n, 2 * self.n))
            for age, matrix in enumerate(node.inputs):
                _require(f"nodes[{at}].inputs[{age}]", matrix, (2 * self.n, self.n))
        return self


def _require(name: str, matrix: Matrix, shape: tuple[int, int]) -> None:
    if len(matrix) != shape[0] or {len(row) for row in matrix} != {shape[1]}:
        raise ValueError(f"{name} must be {shape}")


class Deployment(Strict):
    """A configuration for the line that runs, on probation until it is kept."""

    controller: ControllerConfig
    hash: Hash  #: of the controller's canonical bytes
    epoch: Epoch  #: the last one of the loop and one
    lease_s: Annotated[float, Field(gt=0.0, le=LONGEST_LEASE_S)]  #: not renewed within it: back to the last known good
    shaped_first: bool = True  #: on probation, set-points move shaped only, never at once
    region: Region = Region()
    watch: RecoveryPrediction | None = None  #: None: no model has been accepted, and nothing is predicted


class WiringStatus(Strict):
    """Whether a line is wired as it was proved to be."""

    unproved: list[Finding] = []  #: why it counts as not proved, and is not started; empty: nothing speaks against it
    #: Nothing does, but the devices have not been read since the loop began: an arming tells whether it was they.
    not_read: bool = False
    proved_wall_s: float | None = None  #: Unix time of the proof that holds
    proof: Hash | None = None  #: of the proof against which nothing speaks, whole: the audit has one of each


class InService(Strict):
    """What controls the line, and how it came to."""

    hash: Hash
    kind: str  #: of the controller
    epoch: Annotated[int, Field(ge=0)]  #: the last that was taken, whatever became of it; 0: none yet
    on_probation: bool
    lease_left_s: float | None = None  #: None: not on probation
    last_known_good: Hash
    good_if_kept: Hash  #: what would be that if the one that runs were kept: under a predictive one, a linear one
    region: Region
    watched: bool  #: a recovery prediction looks after it
    why: str  #: "start", "deployed", "kept", or "rolled back: .."
    confirmed: bool = True  #: a verdict has let it through, or a person has confirmed it; else it is guarded as a first
    #: Since it controls the line, in RUN and without a stop in between, as far as this loop has seen (`least_shown`):
    tension_moved: bool = False  #: a tension was moved to another set-point, and has followed
    speed_changed: bool = False  #: the speed was changed from one at which the web moves to another, and has come there
    wiring: WiringStatus | None = None  #: of the line it controls; None: nobody has looked
