"""Recordings of simulated lines under control, in stepped time, while set-points move at random."""

from dataclasses import replace
from typing import Literal

import numpy as np

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.controller import Controller
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.recording import ARRAYS, Recording, recording_of
from gateway.core.telemetry import frame_dtype
from sim_plant.plant import Plant, load_plant

TENSION_N = (28.0, 36.0, 20.0, 40.0, 24.0, 30.0)


def demonstration_line(spans: int = 6) -> Line:
    """The template, which believes S_sim."""
    return load_line(line_template(spans, "line.toml"), "line.toml")


def real_plant(name: str = "s_real") -> Plant:
    return load_plant(f"sim_plant/plants/{name}.toml")


def recorded(
    plant: Plant,
    seed: int = 0,
    duration_s: float = 5.0,
    speeds_m_per_s: tuple[float, ...] = (0.05,),
    amplitude_n: float = 2.0,
    dwell_s: float = 0.1,
    line: Line | None = None,
    stops: Literal["fail", "keep"] = "fail",
    config: Controller | None = None,
) -> Recording:
    """`duration_s` at each speed: at the plant's equilibrium first, under `config`, or the LQI of the line's file.

    Every `dwell_s` each tension set-point goes to one of two values, `amplitude_n` above or below.
    A line that the gateway stops is an error, or what was until then is kept.
    """
    line = line or demonstration_line(plant.spans)
    generator = np.random.default_rng(seed)
    center = np.resize(TENSION_N, plant.spans)
    loop = SteppedLoop(line, config or design_lqi(task_of(line)), plant, seed)
    loop.begin_in_production(center, speeds_m_per_s[0])
    periods = round(duration_s / line.control.period_s)
    dwell = round(dwell_s / line.control.period_s)
    for speed in speeds_m_per_s:
        loop.cycle.setpoints.step_speed(speed, loop.now_s)
        for period in range(periods):
            if period % dwell == 0:
                for i, sign in enumerate(generator.choice([-1.0, 1.0], plant.spans)):
                    loop.cycle.setpoints.step_tension(i, center[i] + amplitude_n * sign, loop.now_s)
            loop.step()
    assert stops == "keep" or not loop.transitions, loop.transitions
    frames = np.frombuffer(b"".join(loop.frames), frame_dtype(plant.spans))
    return recording_of(frames, line.control.period_s, f"{plant.name}, seed {seed}")


def per_roller(plant: Plant, spread: float, seed: int) -> Plant:
    """`plant` with every roller and span off by up to `spread` (a fraction), each by itself."""
    generator = np.random.default_rng(seed)

    def spread_out(value: float) -> list[float]:
        return [value * (1.0 + spread * off) for off in generator.uniform(-1.0, 1.0, plant.spans).tolist()]

    rollers, web = plant.rollers, plant.web
    return plant.model_copy(
        update={
            "rollers": rollers.model_copy(
                update={
                    "radius_m": spread_out(float(np.mean(rollers.radius_m))),
                    "inertia_kg_m2": spread_out(float(np.mean(rollers.inertia_kg_m2))),
                    "friction_nms_per_rad": spread_out(float(np.mean(rollers.friction_nms_per_rad))),
                }
            ),
            "web": web.model_copy(update={"length_m": spread_out(float(np.mean(web.length_m)))}),
        }
    )


def without(recording: Recording, begin: int, end: int) -> Recording:
    """With a gap where samples begin <= k < end have been lost."""
    arrays = {
        name: np.concatenate((getattr(recording, name)[:begin], getattr(recording, name)[end:])) for name in ARRAYS
    }
    return replace(recording, **arrays)
