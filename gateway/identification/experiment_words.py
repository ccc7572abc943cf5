"""A designed experiment in plain words: why so, what is expected, what ends it; and why there is none."""

from collections.abc import Mapping, Sequence
from math import inf

from gateway.core.experiment import Experiment
from gateway.core.line import Line
from gateway.identification.assess_excitation import Wanted as IdentifyWanted

WORDS = {
    "stiffness_per_length": "EA/L", "radius_per_inertia": "R/J", "friction_per_inertia": "f/J", "stiffness_n": "EA",
    "length_m": "L", "radius_m": "R", "inertia_kg_m2": "J", "friction_nms_per_rad": "f",
}  # fmt: skip


def why(
    experiment: Experiment,
    line: Line,
    *,
    speeds: Sequence[float],
    duration_s: float,
    least: bool,
    quiet_n: float,
    most_n: float,
    needs: Mapping[float, float],
    expected: Mapping[str, float],
    worst: Mapping[str, float],
    foreseen: str,
    saturated_share: float,
    drawn_in: int,
) -> tuple[str, ...]:
    """`least`: the amplitude is the least that tells enough in the preferred time; `quiet_n`: what it would be, were
    there no noise to move tensions out of; `needs`: by dwell in s."""
    amplitude, limits, abort = max(experiment.amplitude_n), line.limits, experiment.abort
    moved = (
        "at once" if experiment.rate_n_per_s is None else f"at {experiment.rate_n_per_s:g} N/s: no steps are allowed"
    )
    needed = ", ".join(
        f"{1e3 * dwell_s:g} ms {'more than is allowed' if need == inf else f'{need:g} N'}"
        for dwell_s, need in needs.items()
    )
    if quiet_n < amplitude:
        amplitude_why = f"{quiet_n:g} N would tell what is wanted, but tensions would move hardly more than by noise"
    elif least:
        amplitude_why = (
            "the least that tells what is wanted in the preferred time, on the nominal line and corners of its "
            "tolerances"
        )
    else:
        amplitude_why = (
            f"what keeps tensions in their band (set-points may have {most_n:g} N); time makes up for the rest"
        )
    speeds_why = (
        "at one speed viscous and dry friction act alike, and EA and L part only through T v / L"
        if len(speeds) > 1
        else "one, as was asked: viscous and dry friction are told apart badly, and a model is tried where it was made"
    )
    left = f"; {drawn_in} corners were drawn in to where the controller still holds the line" if drawn_in else ""
    told = ", ".join(f"{word} {percent(expected[name])} ({percent(worst[name])})" for name, word in WORDS.items())
    return (
        f"amplitude: {amplitude:g} N either way in every span with a load cell, {moved}; {amplitude_why}",
        f"dwell: {1e3 * experiment.dwell_s:g} ms; amplitudes that the nominal line needs: {needed}",
        f"duration: {duration_s:g} s at each speed, and the ways to them: {experiment.duration_s:g} s in all",
        f"speeds: {speeds_text(speeds)}; {speeds_why}",
        f"expected half-widths of 95 % intervals (at the worst corner tried): {told}",
        f"foreseen within the tolerances: {foreseen}, limits {limits.tension_min_n:g} and {limits.tension_max_n:g} N; "
        f"a torque at a limit in up to {saturated_share:.0%} of the periods of a second{left}",
        enough(worst),
        f"it ends itself when a tension is {abort.deviation_n:g} N off; when in {abort.window_s:g} s torques are at a "
        f"limit in more than {abort.saturated_share:.0%} of the periods, or turn round by {abort.reversal_nm:g} Nm in "
        f"more than {abort.reversal_share:.0%}; when the line leaves RUN; when signals are missing for more than "
        f"{abort.held_periods} period{'' if abort.held_periods == 1 else 's'} in a row",
    )


def enough(worst: Mapping[str, float]) -> str:
    """Whether what is expected is what `identify` asks of data before it estimates anything."""
    wanted = IdentifyWanted()
    limits = {name: getattr(wanted, name) for name in ("stiffness_per_length", "radius_per_inertia",
              "friction_per_inertia")}  # fmt: skip
    asked = ", ".join(f"{WORDS[name]} {percent(limit)}" for name, limit in limits.items())
    if all(worst[name] <= limit for name, limit in limits.items()):
        return f"identify will have enough, also at the worst corner: it wants {asked}"
    return (
        f"identify may refuse the data of a line at the worst corner: it wants {asked}; a second speed, a faster one "
        "or smaller half-widths (--strong) tell more"
    )


def too_little(
    missed: Mapping[str, float], wanted: str, duration_s: float, amplitude_n: float, speeds: Sequence[float]
) -> str:
    """Why no duration is enough, and what would help."""
    hints = ["a greater amplitude, where limits allow it"]
    if len(speeds) == 1:
        hints.insert(0, "a second speed: at one, viscous and dry friction act alike")
    if {"stiffness_n", "length_m"} & set(missed):
        hints.append("a faster line, or lengths measured by tape and written into the line's file with their tolerance")
    if {"radius_m", "inertia_kg_m2", "friction_nms_per_rad"} & set(missed):
        hints.append("radii measured by tape and written into the line's file with their tolerance")
    found = ", ".join(f"{WORDS[name]} {percent(width)}" for name, width in missed.items())
    return (
        f"{duration_s:g} s at {speeds_text(speeds)} with {amplitude_n:g} N tell too little: {found}; wanted: {wanted}. "
        f"What would help: {'; '.join(hints)}"
    )


def percent(fraction: float) -> str:
    return f"{100.0 * fraction:.2g} %"


def speeds_text(speeds: Sequence[float]) -> str:
    return " and ".join(f"{speed:.3g} m/s" for speed in speeds)
