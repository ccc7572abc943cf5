"""Rules about the process: limits, moves, timing, and whether the drives can hold every recipe."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from gateway.core.line import Line, Recipe
from gateway.core.line_limits import motor_torque_limit_nm, tension_bands_n, torque_limits_nm
from gateway.core.line_problem import Finding, odd
from gateway.core.signals import FloatArray
from gateway.core.web_model import WebModel, equilibrium_torque, nominal_model, reference_speeds

TENSIONING_SPEED_SHARE = 0.1  #: of the line's greatest speed: a roller's, at most, while tensioning
TENSIONING_SPEED_MAX_M_PER_S = 0.1  #: and whatever the line's: a person beside a roller can step back from it
_ROOM = 0.1  #: closer to a limit than this fraction is odd
_STRAIN = 0.1  #: the web model is linear in the strain
_COARSE = 20.0  #: rated torque over torque limit; drives take torque in per mille of the rated one


def tension_limits_ordered(line: Line) -> Iterator[Finding]:
    low, high = line.limits.tension_min_n, line.limits.tension_max_n
    if low >= high:
        yield Finding(("limits", "tension_min_n"), "leaves no band", f"below limits.tension_max_n, {high:g} N")
    elif low + line.limits.tension_margin_n >= high - line.limits.tension_margin_n:
        allowed = f"0 or more, and below {0.5 * (high - low):g} N, half of the band of {low:g} to {high:g} N"
        yield Finding(("limits", "tension_margin_n"), "leaves no room for a set-point", allowed)


def own_limits_within_common(line: Line) -> Iterator[Finding]:
    """What one roller or span has of its own is narrower than what all have in common."""
    limits = line.limits
    for i, roller in enumerate(line.rollers):
        if roller.torque_nm is not None and roller.torque_nm > limits.torque_nm:
            allowed = f"up to limits.torque_nm, {limits.torque_nm:g} Nm, which is the greatest of all drives"
            yield Finding(("rollers", i, "torque_nm"), "is more than all drives have in common", allowed)
    for i, span in enumerate(line.spans):
        low = limits.tension_min_n if span.tension_min_n is None else span.tension_min_n
        high = limits.tension_max_n if span.tension_max_n is None else span.tension_max_n
        allowed = f"{limits.tension_min_n:g} to {limits.tension_max_n:g} N, as in [limits]"
        for key, given in (("tension_min_n", span.tension_min_n), ("tension_max_n", span.tension_max_n)):
            if given is not None and not limits.tension_min_n <= given <= limits.tension_max_n:
                yield Finding(("spans", i, key), "is outside of what all spans have in common", allowed)
        if low + limits.tension_margin_n >= high - limits.tension_margin_n and (low, high) != (
            limits.tension_min_n,
            limits.tension_max_n,
        ):
            key = "tension_max_n" if span.tension_max_n is not None else "tension_min_n"
            margin = limits.tension_margin_n
            yield Finding(
                ("spans", i, key),
                f"leaves no room for a set-point between {low:g} and {high:g} N, {margin:g} N from either",
                allowed,
            )


def web_bears_the_tension(line: Line) -> Iterator[Finding]:
    stiffness = line.web.stiffness_n
    softest_n, highest_n = stiffness.value * (1.0 - stiffness.tolerance), line.limits.tension_max_n
    if softest_n <= highest_n:
        yield Finding(
            ("web", "stiffness_n"),
            f"the softest web ({softest_n:g} N) would double its length within limits.tension_max_n",
            f"value * (1 - tolerance) above {highest_n:g} N",
        )
    elif highest_n > _STRAIN * softest_n:
        yield odd(("web", "stiffness_n"), f"at limits.tension_max_n the web stretches by {highest_n / softest_n:.0%}")


def steps_within_limits(line: Line) -> Iterator[Finding]:
    limits = line.limits
    band_n = limits.tension_max_n - limits.tension_min_n
    if 0.0 < band_n < limits.tension_step_max_n:
        yield Finding(("limits", "tension_step_max_n"), "is larger than the tension band", f"0 to {band_n:g} N")
    if limits.speed_step_max_m_per_s > limits.speed_max_m_per_s:
        allowed = f"0 to limits.speed_max_m_per_s, {limits.speed_max_m_per_s:g} m/s"
        yield Finding(("limits", "speed_step_max_m_per_s"), "is larger than the highest speed", allowed)


def latency_is_possible(line: Line) -> Iterator[Finding]:
    """Every wire takes a torque over at the start of the next cycle (a SYNC, or the next transaction)."""
    period_s, latency_s = line.control.period_s, line.control.latency_s
    if latency_s < period_s:
        yield Finding(
            ("control", "latency_s"),
            f"is shorter than the wire gives: a torque acts with the next cycle, {1e3 * period_s:g} ms later",
            f"control.period_s ({period_s:g} s) or more",
        )
    elif latency_s > 4.0 * period_s:
        yield odd(("control", "latency_s"), f"is {latency_s / period_s:.0f} periods: the wire gives one")


def watchdog_outlasts_a_late_cycle(line: Line) -> Iterator[Finding]:
    period_s = line.control.period_s
    if line.limits.watchdog_s < 2.0 * period_s:
        yield Finding(
            ("limits", "watchdog_s"),
            "the drives would switch off after a single late cycle",
            f"at least two periods ({2.0 * period_s:g} s), up to 0.2 s",
        )


def stop_is_possible(line: Line) -> Iterator[Finding]:
    limits, moves = line.limits, line.moves
    needed_s = limits.speed_max_m_per_s / moves.stop_rate_m_per_s2
    if needed_s > moves.stop_time_s:
        yield Finding(
            ("moves", "stop_time_s"),
            f"torque would go off on a moving web: from {limits.speed_max_m_per_s:g} m/s at "
            f"{moves.stop_rate_m_per_s2:g} m/s2 a stop takes {needed_s:.3g} s",
            f"at least {needed_s:.3g} s, or a larger moves.stop_rate_m_per_s2",
        )
    if moves.torque_off_rate_nm_per_s > limits.torque_rate_nm_per_s:
        yield Finding(
            ("moves", "torque_off_rate_nm_per_s"),
            "is faster than a torque may change",
            f"up to limits.torque_rate_nm_per_s, {limits.torque_rate_nm_per_s:g} Nm/s",
        )
    if moves.speed_rate_m_per_s2 > moves.stop_rate_m_per_s2:
        yield odd(("moves", "stop_rate_m_per_s2"), "a controlled stop is slower than an ordinary speed change")


def drives_give_the_torque(line: Line) -> Iterator[Finding]:
    for i, drive in enumerate(line.drives):
        limit_nm = motor_torque_limit_nm(line, drive)
        path, rated_nm = ("drives", i, "rated_torque_nm"), drive.rated_torque_nm
        if rated_nm < limit_nm:
            yield Finding(
                path,
                "the limit asks for more than the drive gives",
                f"{_name_of_torque(line, drive.roller)} ({limit_nm:g} Nm) or more",
            )
        elif rated_nm > _COARSE * limit_nm:
            yield odd(path, f"commands have steps of {rated_nm / 1000:g} Nm, coarse against a limit of {limit_nm:g} Nm")


def _name_of_torque(line: Line, roller: int) -> str:
    own = 1 <= roller <= len(line.rollers) and line.rollers[roller - 1].torque_nm is not None
    return f"rollers[{roller}].torque_nm" if own else "limits.torque_nm"


def load_cells_see_the_tension(line: Line) -> Iterator[Finding]:
    highest_n = line.limits.tension_max_n
    for i, cell in enumerate(line.load_cells):
        path = ("load_cells", i, "capacity_n")
        if cell.capacity_n < highest_n:
            yield Finding(
                path, "cannot measure what the limits allow", f"limits.tension_max_n ({highest_n:g} N) or more"
            )
        elif cell.capacity_n - highest_n < _ROOM * highest_n:
            yield odd(path, f"hardly above limits.tension_max_n ({highest_n:g} N): a tear in the making is not seen")


def recipes_match_spans(line: Line) -> Iterator[Finding]:
    for i, recipe in enumerate(line.recipes):
        if len(recipe.tension_n) != len(line.spans):
            yield Finding(
                ("recipes", i, "tension_n"),
                f"{len(recipe.tension_n)} tensions for {len(line.spans)} spans",
                f"a list of {len(line.spans)} numbers, one per span",
            )


def recipes_within_tension(line: Line) -> Iterator[Finding]:
    margin, each = line.limits.tension_margin_n, _bands(line)
    for i, recipe in enumerate(line.recipes):
        for k, tension_n in enumerate(recipe.tension_n):
            low, high = each[k] if k < len(each) else (line.limits.tension_min_n, line.limits.tension_max_n)
            lowest, highest, room_n = low + margin, high - margin, _ROOM * (high - low)
            if lowest >= highest:
                continue  # another rule's
            path = ("recipes", i, "tension_n", k)
            if not (lowest <= tension_n <= highest and low < tension_n < high):
                says = "the limits exclude this set-point" if not low < tension_n < high else "is too near to a limit"
                allowed = (
                    f"{lowest:g} to {highest:g} N: limits.tension_margin_n ({margin:g} N) inside the tension limits"
                )
                yield Finding(path, says, allowed)
            elif min(tension_n - low, high - tension_n) < room_n:
                yield odd(path, f"within {room_n:g} N of a limit of {low:g} to {high:g} N: overshoot stops the line")


def _bands(line: Line) -> list[tuple[float, float]]:
    """Least and greatest tension of each span."""
    low, high = tension_bands_n(line)
    return list(zip(low.tolist(), high.tolist(), strict=True))


def recipes_within_speed(line: Line) -> Iterator[Finding]:
    """The web runs faster than v0 behind each span that stretches it."""
    fastest = line.limits.speed_max_m_per_s
    for i, recipe in enumerate(line.recipes):
        path = ("recipes", i, "speed_m_per_s")
        speed = _fastest_roller(line, recipe)
        if speed > fastest:
            reached = "" if speed == recipe.speed_m_per_s else f"; the stretched web reaches {speed:.4g} m/s"
            yield Finding(path, f"the limits exclude this set-point{reached}", f"up to {fastest:g} m/s at every roller")
        elif speed > (1.0 - _ROOM) * fastest:
            yield odd(path, f"within 10 % of limits.speed_max_m_per_s ({fastest:g} m/s)")


def _fastest_roller(line: Line, recipe: Recipe) -> float:
    stiffness_n = line.web.stiffness_n.value
    if not recipe.tension_n or max(recipe.tension_n) >= stiffness_n:
        return recipe.speed_m_per_s  # the stiffness is another rule's
    stretched = (stiffness_n - line.web.tension_before_n) / (stiffness_n - max(recipe.tension_n))
    return recipe.speed_m_per_s * max(1.0, stretched)


def tensioning_in_time(line: Line) -> Iterator[Finding]:
    rate, time_s = line.moves.tension_rate_n_per_s, line.limits.tensioning_time_s
    for i, recipe in enumerate(line.recipes):
        needed_s = max(recipe.tension_n, default=0.0) / rate
        needed_s *= 15.0 / 8.0 if line.moves.shape == "minimum-jerk" else 1.0
        if needed_s >= time_s:
            yield Finding(
                ("recipes", i, "tension_n"),
                f"at moves.tension_rate_n_per_s ({rate:g} N/s) the ramp takes {needed_s:.3g} s, "
                f"limits.tensioning_time_s is {time_s:g} s",
                "a faster rate, a longer time or lower tensions",
            )


def tensioning_is_slow(line: Line) -> Iterator[Finding]:
    given, fastest = line.stages.tensioning.roller_speed_max_m_per_s, line.limits.speed_max_m_per_s
    greatest = min(TENSIONING_SPEED_SHARE * fastest, TENSIONING_SPEED_MAX_M_PER_S)
    if given is not None and given > greatest:
        yield Finding(
            ("stages", "tensioning", "roller_speed_max_m_per_s"),
            "is too fast for a web that may not be there",
            f"up to {greatest:g} m/s: a tenth of limits.speed_max_m_per_s ({fastest:g} m/s), and at most "
            f"{TENSIONING_SPEED_MAX_M_PER_S:g} m/s",
        )


def tensioning_keeps_the_speed(line: Line) -> Iterator[Finding]:
    """Stretching every span at once moves the last roller at rate * sum(L) / (E A)."""
    rate, limit = line.moves.tension_rate_n_per_s, line.limits.speed_max_m_per_s
    per_newton = sum(span.length_m.value for span in line.spans) / line.web.stiffness_n.value
    if rate * per_newton > limit:
        yield Finding(
            ("moves", "tension_rate_n_per_s"),
            f"moving all tensions at this rate pulls the last roller at {rate * per_newton:.3g} m/s, "
            f"limits.speed_max_m_per_s is {limit:g} m/s",
            f"at most {limit / per_newton:.3g} N/s",
        )


@dataclass(frozen=True, slots=True)
class RecipeTorque:
    """Torques at the equilibrium of a recipe, in Nm, one per roller."""

    running: FloatArray  #: (n,), nominal model, at the recipe's speed
    nominal: FloatArray  #: (n,), largest magnitude with the nominal model, running or at standstill
    worst: FloatArray  #: (n,), largest magnitude over all corners of the tolerances, running or at standstill


def recipe_torque(line: Line, recipe: Recipe, speed_m_per_s: float | None = None) -> RecipeTorque:
    """What a recipe asks of the drives (eq. roller_velocity_dynamics at rest), at its own or another speed.

    u_i = f v_i / R + R (T_i - T_{i+1}) is convex or monotone in each of R, f and E A, and a roller's torque
    depends on no other roller's R and f: the corners of the tolerances, the same for all rollers, hold the
    largest magnitude. Needs as many tensions as spans and rollers.
    """
    speed = recipe.speed_m_per_s if speed_m_per_s is None else speed_m_per_s
    tension_n = np.array(recipe.tension_n)
    model = nominal_model(line)
    with np.errstate(all="ignore"):  # absurd numbers give inf or NaN, which no limit lets pass
        running = _equilibrium(model, tension_n, speed)
        nominal = np.maximum(np.abs(running), np.abs(_equilibrium(model, tension_n, 0.0)))
        worst = nominal
        for corner in _corners(line, model):
            for v0 in (0.0, speed):
                worst = np.maximum(worst, np.abs(_equilibrium(corner, tension_n, v0)))
    return RecipeTorque(running, nominal, worst)


def _equilibrium(model: WebModel, tension_n: FloatArray, speed_m_per_s: float) -> FloatArray:
    return equilibrium_torque(model, tension_n, reference_speeds(model, tension_n, speed_m_per_s))


def _corners(line: Line, model: WebModel) -> Iterator[WebModel]:
    radius = np.array([roller.radius_m.tolerance for roller in line.rollers])
    friction = np.array([roller.friction_nms_per_rad.tolerance for roller in line.rollers])
    for a, b, c in product((-1.0, 1.0), repeat=3):
        yield replace(
            model,
            stiffness_n=model.stiffness_n * (1.0 + a * line.web.stiffness_n.tolerance),
            radius_m=model.radius_m * (1.0 + b * radius),
            friction_nms_per_rad=model.friction_nms_per_rad * (1.0 + c * friction),
        )


def recipes_within_torque(line: Line) -> Iterator[Finding]:
    """Refused where the nominal model needs more than the limit, odd where the tolerances may."""
    limit_nm = torque_limits_nm(line)
    for i, recipe in enumerate(line.recipes):
        if not _computable(line, recipe):
            continue
        torque = recipe_torque(line, recipe)
        path = ("recipes", i)
        if not np.all(torque.nominal <= limit_nm):
            says, of = _needs(line, recipe, torque.nominal, "nominal model")
            yield Finding(path, says, f"{of}: lower the speed or the tension differences")
        elif np.any(torque.nominal > (1.0 - _ROOM) * limit_nm):
            says, of = _needs(line, recipe, torque.nominal, "nominal model")
            yield odd(path, says, f"{of.rpartition(', ')[2]}; room to control")
        elif not np.all(torque.worst <= limit_nm):
            says, of = _needs(line, recipe, torque.worst, "worst corner of the tolerances")
            yield odd(path, says, f"{of.rpartition(', ')[2]}; identification will tell")


def speed_limit_within_torque(line: Line) -> Iterator[Finding]:
    """Odd where not even the first recipe could be run at the highest speed."""
    fastest, recipe = line.limits.speed_max_m_per_s, line.recipes[0]
    if _computable(line, recipe):
        torque = recipe_torque(line, recipe, fastest)
        if not np.all(torque.nominal <= torque_limits_nm(line)):
            says, of = _needs(line, recipe, torque.nominal, "nominal model")
            yield odd(("limits", "speed_max_m_per_s"), f"at this speed {says}", of.rpartition(", ")[2])


def _computable(line: Line, recipe: Recipe) -> bool:
    softest_n = line.web.stiffness_n.value * (1.0 - line.web.stiffness_n.tolerance)
    return len(recipe.tension_n) == len(line.spans) == len(line.rollers) and max(recipe.tension_n) < softest_n


def _needs(line: Line, recipe: Recipe, torque_nm: FloatArray, model: str) -> tuple[str, str]:
    """What the roller needs that is nearest to its limit or furthest beyond it, and that limit with its name."""
    limit_nm = torque_limits_nm(line)
    worst = int(np.argmax(np.nan_to_num(torque_nm / limit_nm, nan=np.inf)))
    needs = f'"{recipe.name}" needs {torque_nm[worst]:.4g} Nm at roller {worst + 1}'
    return (
        f"{needs} ({line.rollers[worst].name}; {model})",
        f"{_name_of_torque(line, worst + 1)}, {limit_nm[worst]:g} Nm",
    )
