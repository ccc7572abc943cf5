"""Rules about what still turns after a web break: brakes that are given whole, and how long each roller runs on."""

from collections.abc import Iterator

import numpy as np

from gateway.core.braking import (
    brakes_of,
    braking_devices,
    braking_s,
    coasting_s,
    device_energy_j,
    device_power_w,
    kinetic_energy_j,
)
from gateway.core.line import Line
from gateway.core.line_limits import torque_limit_nm
from gateway.core.line_problem import Finding, odd

AT_REST_S = 10.0  #: after a web break everything should stand


def brakes_are_whole(line: Line) -> Iterator[Finding]:
    """A braking torque without a power says nothing of what the DC link takes, and a power nothing without a torque."""
    for i, drive in enumerate(line.drives):
        limit_nm = torque_limit_nm(line, drive.roller)
        torque, power, energy = drive.braking_torque_nm, drive.braking_power_w, drive.braking_energy_j
        if torque is not None and power is None:
            yield Finding(
                ("drives", i, "braking_torque_nm"),
                "says nothing of what the drive's DC link takes: it would trip, and the roller coast",
                "together with braking_power_w, of its brake resistor or of what it feeds back",
            )
        if torque is None and (power is not None or energy is not None):
            key = "braking_power_w" if power is not None else "braking_energy_j"
            yield Finding(
                ("drives", i, key), "brakes nothing without a torque", "together with braking_torque_nm, in Nm"
            )
        if torque is not None and torque > limit_nm:
            yield Finding(
                ("drives", i, "braking_torque_nm"),
                "is more than a torque may be",
                f"up to the torque limit of roller {drive.roller}, {limit_nm:g} Nm",
            )


def one_resistor_is_given_once(line: Line) -> Iterator[Finding]:
    """Odd where axes of one device are given different powers or energies: they have one DC link between them."""
    for drives in braking_devices(line):
        for key, least in (("braking_power_w", device_power_w(drives)), ("braking_energy_j", device_energy_j(drives))):
            others = [drive for drive in drives if (getattr(drive, key) or least) != least]
            if not others:
                continue
            names = ", ".join(drive.name for drive in drives)
            says = f"{names} are axes of one device with one DC link: the least that is given, {least:g}, is taken"
            advice = "the same number for all of them: what the device takes, all its axes together"
            yield odd(("drives", line.drives.index(others[0]), key), says, advice)


def rollers_come_to_rest(line: Line) -> Iterator[Finding]:
    """Odd where a roller runs on for long after a web break: with its brake, or on its friction alone."""
    if len(line.drives) != len(line.rollers) or {d.roller for d in line.drives} != {*range(1, len(line.rollers) + 1)}:
        return  # another rule's
    with np.errstate(over="ignore", invalid="ignore"):  # a radius of 1e300 m: what is not seen to end is said
        brakes = brakes_of(line)
        coasting, braking, energy = coasting_s(brakes), braking_s(brakes), kinetic_energy_j(brakes)
    for i, drive in enumerate(line.drives):
        k = drive.roller - 1
        name, fastest = f"roller {k + 1} ({line.rollers[k].name})", line.limits.speed_max_m_per_s
        if not brakes.braked[k]:
            if not coasting[k] <= AT_REST_S:
                says = f"after a web break {name} coasts for {coasting[k]:.0f} s from {fastest:g} m/s, at worst"
                yield odd(("drives", i), says, "braking_torque_nm and braking_power_w, if its drive can brake it")
        elif not braking[k] <= AT_REST_S:
            says = f"after a web break {name} takes {braking[k]:.3g} s from {fastest:g} m/s to rest, at worst"
            yield odd(("drives", i, "braking_torque_nm"), says, f"{AT_REST_S:g} s; more torque and braking_power_w")
        elif not energy[k] <= brakes.energy_j[k]:
            left = fastest * float(np.sqrt(1.0 - brakes.energy_j[k] / energy[k]))
            says = f"{name} has up to {energy[k]:.4g} J at {fastest:g} m/s: it would coast from {left:.3g} m/s on"
            yield odd(("drives", i, "braking_energy_j"), says, f"{energy[k]:.4g} J or more")
