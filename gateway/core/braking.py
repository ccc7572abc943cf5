"""What the drives of a line can brake after a web break, and how long its rollers take to rest. Pure.

A roller of inertia J, radius R and viscous friction f that its drive brakes with torque B slows down, by
eq. roller_velocity_dynamics without web, at

    a(v) = (R B(v) + f v) / J,    B(v) = min(braking_torque_nm, torque limit of the roller, P R / v)

P is the power that the drive's DC link takes. Axes of one device have one DC link and one brake resistor: what is given
for them is the device's, and each has the share of it that its roller has of the energy, J/R^2. Without a brake B is
zero, and the roller coasts.
"""

from dataclasses import dataclass

import numpy as np

from gateway.core.line import BRAKING_MOST_S, Drive, Line
from gateway.core.line_limits import torque_limits_nm
from gateway.core.signals import BoolArray, FloatArray

REST = 0.02  #: of the greatest speed: what a roller coasts to; below it dry friction does the rest
CAPABLE = 0.85  #: of what a brake can do at the worst of the tolerances that is planned with; the rest is for control
CARRIED = 0.1  #: of tension_max_n: with so much the web may slow down the rollers that nothing brakes, together
STEPS = 200  #: from the greatest speed to rest, in what is computed ahead


@dataclass(frozen=True)
class Brakes:
    """The rollers' brakes. Arrays (n,); `_least` and `_most` are ends of the tolerances."""

    braked: BoolArray  #: its drive may brake
    torque_nm: FloatArray  #: 0 where it may not
    power_w: FloatArray
    energy_j: FloatArray  #: that the DC link takes in one stop; inf: no limit
    radius_m: FloatArray
    inertia_kg_m2: FloatArray
    friction_nms_per_rad: FloatArray
    radius_least_m: FloatArray
    radius_most_m: FloatArray
    inertia_most_kg_m2: FloatArray
    inertia_least_kg_m2: FloatArray
    friction_least_nms_per_rad: FloatArray
    carried_n: float  #: force of the web on each roller that nothing brakes
    speed_max_m_per_s: float
    stop_rate_m_per_s2: float  #: that the unwinder is known to follow
    wanted_m_per_s2: float  #: no roller is slowed down faster


def brakes_of(line: Line) -> Brakes:
    """The brakes of `line`; every roller must have its drive."""
    n, limits = len(line.rollers), line.limits
    torque, power, energy = np.zeros(n), np.zeros(n), np.full(n, np.inf)
    most_nm = torque_limits_nm(line)
    for drives in braking_devices(line):
        device_w, device_j = device_power_w(drives), device_energy_j(drives)
        for drive, share in zip(drives, _energy_shares(line, drives), strict=True):
            i = drive.roller - 1
            torque[i] = min(drive.braking_torque_nm or 0.0, most_nm[i])
            power[i], energy[i] = share * device_w, share * device_j
    rollers = line.rollers
    radius = np.array([r.radius_m.value for r in rollers])
    inertia = np.array([r.inertia_kg_m2.value for r in rollers])
    friction = np.array([r.friction_nms_per_rad.value for r in rollers])
    braked: BoolArray = torque > 0.0
    return Brakes(
        braked=braked,
        torque_nm=torque,
        power_w=power,
        energy_j=energy,
        radius_m=radius,
        inertia_kg_m2=inertia,
        friction_nms_per_rad=friction,
        radius_least_m=radius * (1.0 - np.array([r.radius_m.tolerance for r in rollers])),
        radius_most_m=radius * (1.0 + np.array([r.radius_m.tolerance for r in rollers])),
        inertia_most_kg_m2=inertia * (1.0 + np.array([r.inertia_kg_m2.tolerance for r in rollers])),
        inertia_least_kg_m2=inertia * (1.0 - np.array([r.inertia_kg_m2.tolerance for r in rollers])),
        friction_least_nms_per_rad=friction * (1.0 - np.array([r.friction_nms_per_rad.tolerance for r in rollers])),
        carried_n=CARRIED * limits.tension_max_n / max(1, int(np.count_nonzero(~braked))),
        speed_max_m_per_s=limits.speed_max_m_per_s,
        stop_rate_m_per_s2=line.moves.stop_rate_m_per_s2,
        wanted_m_per_s2=max(limits.speed_max_m_per_s / line.moves.brake_time_s, line.moves.stop_rate_m_per_s2),
    )


def braking_devices(line: Line) -> list[list[Drive]]:
    """The drives that may brake, those of one device together: they have one DC link."""
    devices: dict[tuple[str, int], list[Drive]] = {}
    for drive in line.drives:
        if drive.braking_torque_nm is not None and drive.braking_power_w is not None:
            devices.setdefault((drive.bus, drive.address), []).append(drive)
    return list(devices.values())


def device_power_w(drives: list[Drive]) -> float:
    """What the DC link of a device takes, whose axes `drives` are: the least that is given for one of them."""
    return min(drive.braking_power_w for drive in drives if drive.braking_power_w is not None)


def device_energy_j(drives: list[Drive]) -> float:
    """What its brake resistor takes in one stop, likewise; inf where nothing is given."""
    return min((drive.braking_energy_j for drive in drives if drive.braking_energy_j is not None), default=np.inf)


def _energy_shares(line: Line, drives: list[Drive]) -> list[float]:
    """The part of each of `drives` in what all their rollers have of energy at one web speed."""
    rollers = [line.rollers[drive.roller - 1] for drive in drives]
    masses = [roller.inertia_kg_m2.value / roller.radius_m.value / roller.radius_m.value for roller in rollers]
    return [mass / sum(masses) for mass in masses]


def braking_torque_nm(brakes: Brakes, speed_m_per_s: FloatArray) -> FloatArray:
    """The greatest braking torque (n,) in Nm at surface speeds (n,) of either sign."""
    speed = np.maximum(np.abs(speed_m_per_s), 1e-9 * brakes.speed_max_m_per_s)
    return np.minimum(brakes.torque_nm, brakes.power_w * brakes.radius_least_m / speed)


def deceleration_m_per_s2(brakes: Brakes, speed_m_per_s: float, may_brake: BoolArray) -> FloatArray:
    """By how much each roller (n,) can be slowed down at a web speed, at the worst of its tolerances."""
    speed = np.full(len(brakes.braked), speed_m_per_s)
    force = np.where(may_brake, CAPABLE * braking_torque_nm(brakes, speed) / brakes.radius_least_m, brakes.carried_n)
    friction = brakes.friction_least_nms_per_rad * speed / brakes.radius_m**2
    # R^2/J at the least radius, too: a force at the surface is a torque through it.
    return brakes.radius_least_m**2 / brakes.inertia_most_kg_m2 * (force + friction)


def coasting_s(brakes: Brakes) -> FloatArray:
    """How long each roller (n,) coasts from the greatest speed to `REST` of it, on its friction alone, at worst."""
    return brakes.inertia_most_kg_m2 / brakes.friction_least_nms_per_rad * -np.log(REST)


def braking_s(brakes: Brakes) -> FloatArray:
    """How long each roller (n,) takes from the greatest speed to `REST` of it with its brake, at worst and alone."""
    speeds = np.linspace(brakes.speed_max_m_per_s, REST * brakes.speed_max_m_per_s, STEPS)
    rates = np.array([deceleration_m_per_s2(brakes, float(speed), brakes.braked) for speed in speeds])
    slowness = 1.0 / np.minimum(rates, brakes.wanted_m_per_s2)
    return np.asarray(np.trapezoid(slowness, -speeds, axis=0), dtype=np.float64)


def kinetic_energy_j(brakes: Brakes) -> FloatArray:
    """Of each roller (n,) at the greatest speed, at most."""
    return 0.5 * brakes.inertia_most_kg_m2 * (brakes.speed_max_m_per_s / brakes.radius_least_m) ** 2


def longest_braking_s(line: Line) -> float:
    """How long the line may be braked after a web break until torque goes off; 0: no drive may brake."""
    brakes = any(drive.braking_torque_nm and drive.braking_power_w for drive in line.drives)
    return BRAKING_MOST_S if brakes else 0.0
