"""Lines of every size that a line may have: a 0.1 N foil, a 10 kN laminator, 0.1 to 10 m/s, 2 to 10 spans.

A line is drawn by what has no dimension, then given its size: strain at the working tension, how fast a span swings on
its rollers, how much of the torque friction takes at full speed. What the gateway's file says of it is off by up to
half of the tolerances that the file names. A function of its seed alone.

Seeds from `DRAW_SPANS` on are lines with draw-controlled spans that no load cell measures, whose rollers are known as
well as `check` asks for.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from gateway.core.line import Line
from gateway.core.line_checks import RULES
from gateway.core.line_defaults import derived_defaults
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from sim_plant.plant import Plant, load_plant

PLANT = "sim_plant/plants/s_real.toml"
NOISE = 0.003  #: of a load cell, as a share of the working tension; S_real has 0.1 of 28 N
DRAW_SPANS = 1_000_000  #: the first seed of such lines
DRAW_SHARE = 0.3  #: of the spans of such a line, and one at least
#: Shares of the tolerances: the first that `check` takes counts.
KNOWN = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
SPREAD = 0.05  #: by which rollers and spans of one line differ, where tolerances are the template's
OFF = 0.5  #: of a tolerance, by which what the file says may be off


@dataclass(frozen=True)
class Size:
    """What a line is drawn from."""

    spans: int
    tension_n: float  #: the working tension of the middle span
    speed_max_m_per_s: float
    length_m: float
    radius_m: float
    strain: float  #: at the working tension
    swing_rad_per_s: float  #: sqrt(EA / (L M)), M the roller's inertia at its surface
    friction: float  #: force at full speed over the working tension
    draw_spans: tuple[int, ...] = ()  #: from 1: draw-controlled, without a load cell
    known: float = 1.0  #: tolerances, and what rollers and spans differ by, as a share of the usual ones

    @property
    def mass_kg(self) -> float:
        """Of a roller, at its surface: J / R^2."""
        return self.tension_n / (self.strain * self.length_m * self.swing_rad_per_s**2)


@dataclass(frozen=True)
class Drawn:
    """A line's file and its truth."""

    size: Size
    line: Line
    plant: Plant
    seed: int


def draw_size(seed: int) -> Size:
    """Log-uniform in everything that has a dimension."""
    dice = np.random.default_rng([seed, 31])

    def between(low: float, high: float) -> float:
        return float(np.exp(dice.uniform(np.log(low), np.log(high))))

    return Size(
        spans=int(dice.integers(2, 11)), tension_n=between(0.1, 1e4), speed_max_m_per_s=between(0.1, 10.0),
        length_m=between(0.4, 5.0), radius_m=between(0.03, 0.4), strain=between(5e-4, 1e-2),
        swing_rad_per_s=between(2.0, 15.0), friction=between(0.2, 4.0),
    )  # fmt: skip


def any_span(draw: Drawn, dice: np.random.Generator) -> int:
    """A span, or the roller at its end, from 1."""
    return int(dice.integers(1, draw.size.spans + 1))


@lru_cache(maxsize=8)
def drawn(seed: int) -> Drawn:
    """A line of a size of its own, threaded and slack at the start. Its file may be one that `check` refuses."""
    size = draw_size(seed)
    if seed < DRAW_SPANS:
        return _of_size(size, seed)
    dice = np.random.default_rng([seed, 36])
    chosen = np.flatnonzero(dice.uniform(size=size.spans) < DRAW_SHARE) + 1
    spans = tuple(chosen.tolist()) or (int(dice.integers(1, size.spans + 1)),)
    for known in KNOWN:
        found = _of_size(replace(size, draw_spans=spans, known=known), seed)
        if not is_refused(found.line):
            break
    return found


def is_refused(line: Line) -> bool:
    """Whether `check` does not take it, whatever else it advises."""
    return any(found.severity == "error" for rule in RULES for found in rule.check(line))


def _of_size(size: Size, seed: int) -> Drawn:
    dice = np.random.default_rng([seed, 32])
    return Drawn(size, _line(size, dice), _plant(size, dice), seed)


def _line(size: Size, dice: np.random.Generator) -> Line:
    """The line's file, as an engineer would fill it in."""
    n, tension_n, top = size.spans, size.tension_n, size.speed_max_m_per_s
    base = load_line(line_template(n, "line.toml"), "line.toml")
    believed = {
        "stiffness_n": tension_n / size.strain, "length_m": size.length_m, "radius_m": size.radius_m,
        "inertia_kg_m2": size.mass_kg * size.radius_m**2,
        "friction_nms_per_rad": size.friction * tension_n * size.radius_m**2 / top,
    }  # fmt: skip

    def parameter(of: object, name: str) -> dict[str, object]:
        tolerance = size.known * getattr(of, name).tolerance
        value = believed[name] * (1.0 + OFF * tolerance * float(dice.uniform(-1.0, 1.0)))
        return {name: getattr(of, name).model_copy(update={"value": value, "tolerance": tolerance})}

    stiffness, radius = parameter(base.web, "stiffness_n"), parameter(base.rollers[0], "radius_m")
    inertia, friction = (parameter(base.rollers[0], name) for name in ("inertia_kg_m2", "friction_nms_per_rad"))
    length = parameter(base.spans[0], "length_m")
    torque_nm, accelerates_s = _torque_nm(size), _accelerates_s(size)
    brake = {"braking_torque_nm": torque_nm, "braking_power_w": torque_nm * top / size.radius_m}
    line = base.model_copy(
        update={
            "web": base.web.model_copy(update=stiffness),
            "rollers": [roller.model_copy(update=radius | inertia | friction) for roller in base.rollers],
            "spans": [
                span.model_copy(update=length | ({"control": "draw"} if i in size.draw_spans else {}))
                for i, span in enumerate(base.spans, start=1)
            ],
            "drives": [drive.model_copy(update={"rated_torque_nm": torque_nm, **brake}) for drive in base.drives],
            "load_cells": [
                cell.model_copy(update={"capacity_n": 4.0 * tension_n})
                for cell in base.load_cells
                if cell.span not in size.draw_spans
            ],
            "limits": base.limits.model_copy(
                update={
                    "torque_nm": torque_nm, "torque_rate_nm_per_s": 16.0 * torque_nm,
                    "tension_min_n": 0.07 * tension_n, "tension_max_n": 2.1 * tension_n,
                    "tension_margin_n": 0.035 * tension_n, "speed_max_m_per_s": top,
                    "tension_step_max_n": 0.15 * tension_n, "speed_step_max_m_per_s": 0.05 * top,
                }
            ),
            "moves": base.moves.model_copy(
                update={
                    "tension_rate_n_per_s": 0.7 * tension_n, "speed_rate_m_per_s2": top / accelerates_s,
                    "stop_rate_m_per_s2": 2.0 * top / accelerates_s, "stop_time_s": min(120.0, 10.0 + accelerates_s),
                    "torque_off_rate_nm_per_s": 4.0 * torque_nm,
                }
            ),
            "recipes": [
                recipe.model_copy(
                    update={"tension_n": [tension_n * (0.8 + 0.4 * float(u)) for u in dice.uniform(size=n)],
                            "speed_m_per_s": 0.4 * top}
                )
                for recipe in base.recipes[:1]
            ],
        }
    )  # fmt: skip
    # What the file does not give follows from its limits, not from those of the line that it was written from.
    return line.model_copy(update={"gate": line.gate.model_copy(update=derived_defaults(line)["gate"])})


def _torque_nm(size: Size) -> float:
    """Twice what friction at full speed and the difference of neighbouring tensions take, and as much to accelerate."""
    return size.radius_m * size.tension_n * (2.0 * size.friction + 2.5)


def _accelerates_s(size: Size) -> float:
    """To full speed, with half of the working tension for it at the most, and not in less than 2 s."""
    return max(2.0, size.mass_kg * size.speed_max_m_per_s / (0.5 * size.tension_n))


def _plant(size: Size, dice: np.random.Generator) -> Plant:
    n, tension_n, torque_nm = size.spans, size.tension_n, _torque_nm(size)
    base = load_plant(PLANT)

    def each(value: float) -> list[float]:
        return (value * (1.0 + SPREAD * size.known * dice.uniform(-1.0, 1.0, n))).tolist()

    web = base.web.model_copy(update={"stiffness_n": each(tension_n / size.strain), "length_m": each(size.length_m)})
    rollers = base.rollers.model_copy(
        update={
            "radius_m": each(size.radius_m), "inertia_kg_m2": each(size.mass_kg * size.radius_m**2),
            "friction_nms_per_rad": each(size.friction * tension_n * size.radius_m**2 / size.speed_max_m_per_s),
            "disturbance_m_per_s2": 0.02 * tension_n / size.mass_kg,
        }
    )  # fmt: skip
    sensors = base.sensors.model_copy(
        update={"tension_noise_n": NOISE * tension_n, "speed_noise_m_per_s": 1e-3 * size.speed_max_m_per_s}
    )
    drives = base.drives.model_copy(update={"rated_torque_nm": torque_nm, "max_torque_nm": torque_nm})
    recorder = base.recorder.model_copy(
        update={"torque_nm": torque_nm, "torque_rate_nm_per_s": 16.0 * torque_nm,
                "tension_min_n": 0.07 * tension_n, "tension_max_n": 2.1 * tension_n}
    )  # fmt: skip
    effects = base.effects.model_copy(update={"slack": True})
    return base.model_copy(
        update={"name": "drawn", "spans": n, "web": web, "rollers": rollers, "sensors": sensors, "drives": drives,
                "recorder": recorder, "effects": effects}
    )  # fmt: skip
