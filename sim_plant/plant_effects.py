"""The table [effects] of PLANT.toml: what a real line does beyond the paper's two equations. Off unless it is given.

The equations stand in `effects_model`. Torque lag and step are with [drives], what readings suffer with [sensors].
"""

from math import isfinite, pi
from typing import Annotated, Any

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from sim_plant.plant_fields import NonNegative, NonNegativeEach, NumberEach, Positive, Share, ShareEach, Strict

_SHORTEST_LAG_S = 0.001  #: the integration is stable and right to 1 % from one step on


def _lag(value: float) -> float:
    if 0.0 < value < _SHORTEST_LAG_S:
        raise PydanticCustomError("lag", "should be 0, or at least 0.001 (one step of the physics)")
    return value


Lag = Annotated[NonNegative, AfterValidator(_lag)]


class Friction(Strict):
    """Dry friction of a roller's bearings, at the shaft, beside the viscous friction of [rollers]."""

    coulomb_nm: NonNegativeEach = 0.0
    breakaway_nm: NonNegativeEach = 0.0  #: at standstill; 0: as coulomb_nm
    stribeck_speed_m_per_s: Positive = 0.005  #: surface speed at which 1/e of the difference is left
    rise_per_s: NonNegativeEach = 0.0  #: a bearing that wears: all friction grows by this share of it per second


class Eccentricity(Strict):
    """The radius at which the web runs goes up and down once per turn."""

    share: ShareEach = 0.0  #: amplitude over radius
    phase_rad: NumberEach = 0.0  #: at the start; 0: the radius is largest


class Relaxation(Strict):
    """The web as a standard linear solid: a Maxwell arm beside the spring E A."""

    stiffness_share: NonNegative = 0.0  #: stiffness of the arm over E A
    time_s: Annotated[float, Field(ge=0.01)] = 1.0


class Slip(Strict):
    """The web slides on a roller that cannot hold it. The last roller, a nip or a reel, always holds it."""

    on: bool = False
    friction_coefficient: NonNegativeEach = 0.3  #: between web and roller
    wrap_rad: NonNegativeEach = pi


class Unwinder(Strict):
    """Roller 0. Its shaft is driven so that the web leaves at v0, apart from its eccentricity."""

    radius_m: Positive = 0.2  #: at the start
    core_radius_m: Positive = 0.04  #: it becomes no smaller
    eccentricity: Share = 0.0  #: amplitude over radius
    phase_rad: float = 0.0


class Reels(Strict):
    """Roller 0 is unwound and the last one, whose radius and inertia in [rollers] are those at the start, wound."""

    thickness_m: NonNegative = 0.0  #: of the web
    width_m: Positive = 0.3
    density_kg_per_m3: Positive = 1000.0


class Effects(Strict):
    slack: bool = False  #: the web cannot push
    friction: Friction = Friction()
    eccentricity: Eccentricity = Eccentricity()
    relaxation: Relaxation = Relaxation()
    slip: Slip = Slip()
    unwinder: Unwinder = Unwinder()
    reels: Reels = Reels()

    @property
    def any(self) -> bool:
        """Whether the plain equations do not do."""
        friction = self.friction
        amounts = (friction.coulomb_nm, friction.breakaway_nm, friction.rise_per_s, self.eccentricity.share)
        return (
            self.slack
            or self.slip.on
            or self.relaxation.stiffness_share > 0.0
            or self.unwinder.eccentricity > 0.0
            or self.reels.thickness_m > 0.0
            or any(_given(amount) for amount in amounts)
        )


def _given(amount: float | list[float]) -> bool:
    return any(amount) if isinstance(amount, list) else amount > 0.0


def effects_rules(effects: dict[str, Any], spans: int) -> list[str]:
    """What values of the raw table [effects] break together, one sentence each."""
    friction, unwinder = effects.get("friction", {}), effects.get("unwinder", {})
    reasons: list[str] = []
    if isinstance(friction, dict):
        coulomb = _numbers(friction.get("coulomb_nm", 0.0), spans)
        breakaway = _numbers(friction.get("breakaway_nm", 0.0), spans)
        if any(0.0 < b < c for b, c in zip(breakaway, coulomb, strict=False)):
            reasons.append("effects.friction.breakaway_nm: must not be below coulomb_nm (0 means the same as it)")
    if isinstance(unwinder, dict):
        radius = _numbers(unwinder.get("radius_m", Unwinder().radius_m), 1)
        core = _numbers(unwinder.get("core_radius_m", Unwinder().core_radius_m), 1)
        if radius and core and 0.0 < radius[0] < core[0]:
            reasons.append(f"effects.unwinder.core_radius_m: is {core[0]}, at most radius_m = {radius[0]}")
    return reasons


def _numbers(value: Any, n: int) -> list[float]:
    """The numbers of a raw parameter; none when it is none, which is told elsewhere."""
    values = value if isinstance(value, list) else [value] * n
    is_number = [isinstance(v, int | float) and not isinstance(v, bool) and isfinite(v) for v in values]
    return values if all(is_number) else []
