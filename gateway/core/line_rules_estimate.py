"""Rules about spans without a load cell: their tension must be known well enough for its band to mean something.

And a web that breaks there must be seen.
"""

from collections.abc import Iterator

import numpy as np

from gateway.core.line import Line, Parameter
from gateway.core.line_limits import tension_bands_n
from gateway.core.line_problem import Finding
from gateway.core.signals import FloatArray
from gateway.core.tension_estimate import (
    CREEPING,
    balance_of,
    break_seen_n,
    estimate_n,
    fall_noise_n,
    least_fall_n,
    pull_n,
)
from gateway.core.web_model import equilibrium_torque, nominal_model, reference_speeds

REACHED = 0.8  #: of a fall, that is seen within the time in which it is looked for
_SHARES = (0.8, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.05)  #: of the tolerances, that are tried for an advice


def estimates_are_bounds(line: Line) -> Iterator[Finding]:
    """Refused where what torques say of a span's tension is wider than its band, anywhere in the range of speeds."""
    if not _estimates(line):
        return
    estimated, widths, bands_n = balance_of(line).estimated, _widths_n(line), _bands_n(line)
    for i in np.flatnonzero(estimated & ~(widths <= bands_n)).tolist():
        says = (
            f"without a load cell span {i + 1} has no bound: from creeping to full speed torque and speed tell its "
            f"tension within {widths[i]:.4g} N, and its band is {bands_n[i]:.4g} N wide"
        )
        yield Finding(("spans", i, "control"), says, f"a [[load_cells]] table with span = {i + 1}{_known(line, i)}")


def breaks_are_seen(line: Line) -> Iterator[Finding]:
    """Refused where a web that breaks in a span that no load cell sees could stay unseen, at a recipe's tensions."""
    if not _estimates(line):
        return
    balance = balance_of(line)
    noise_n, low_n = fall_noise_n(line, balance), tension_bands_n(line)[0]
    bounded = _widths_n(line) <= _bands_n(line)  # what has no bound is refused for that
    for i in np.flatnonzero(balance.estimated & bounded).tolist():
        for recipe in line.recipes:
            needed_n = float(least_fall_n(np.array(recipe.tension_n), low_n, noise_n)[i])
            seen_n = REACHED * break_seen_n(balance, i, recipe.tension_n[i])
            if not seen_n >= needed_n:
                says = (
                    f"without a load cell a web break in span {i + 1} would stay unseen until the roller behind it is "
                    f"too fast: of the {recipe.tension_n[i]:.4g} N of recipe {recipe.name} that it takes away torque "
                    f"and speed tell {max(seen_n, 0.0):.4g} N for certain, {needed_n:.4g} N are needed"
                )
                better = "rollers of which radius_m and inertia_kg_m2 are better known"
                yield Finding(("spans", i, "control"), says, f"a [[load_cells]] table with span = {i + 1}, or {better}")
                break


def _estimates(line: Line) -> bool:
    """Whether a span is estimated, as far as what that needs is there: else another rule says so."""
    n = len(line.spans)
    if len(line.rollers) != n or any(len(recipe.tension_n) != n for recipe in line.recipes):
        return False
    stretched = max(max(recipe.tension_n) for recipe in line.recipes) >= line.web.stiffness_n.value
    return bool(balance_of(line).estimated.any()) and not stretched


def _widths_n(line: Line) -> FloatArray:
    """How far apart the ends of each estimate (n,) are, at most, at the equilibrium of a recipe at any speed.

    They grow with friction, that is, with speed: the ends of the range are the worst.
    """
    balance, model, fastest = balance_of(line), nominal_model(line), line.limits.speed_max_m_per_s
    widths = np.zeros(line.n)
    for recipe in line.recipes:
        tension = np.array(recipe.tension_n)
        for unwind_m_per_s in (1.1 * CREEPING * fastest, recipe.speed_m_per_s, fastest):
            speed = reference_speeds(model, tension, unwind_m_per_s)
            pull = pull_n(balance, equilibrium_torque(model, tension, speed), speed, np.zeros(line.n))
            least, most = estimate_n(balance, tension, pull)
            widths = np.maximum(widths, most - least)
    return widths


def _bands_n(line: Line) -> FloatArray:
    """How wide each span's band is, (n,)."""
    low, high = tension_bands_n(line)
    return high - low


def _known(line: Line, i: int) -> str:
    """How well the rollers would have to be known; nothing where neither tolerance nor dry friction would do."""
    for share in _SHARES:
        if _widths_n(_better_known(line, share))[i] <= _bands_n(line)[i]:
            roller = line.rollers[i]
            return (
                f", or rollers of which more is known: with {share:g} times their tolerances, here "
                f"{share * roller.radius_m.tolerance:.2g} of radius_m and "
                f"{share * roller.friction_nms_per_rad.tolerance:.2g} of friction_nms_per_rad, it has one"
            )
    for share in _SHARES:
        dry_nm = share * line.gate.stress_coulomb_nm
        smoother = line.model_copy(update={"gate": line.gate.model_copy(update={"stress_coulomb_nm": dry_nm})})
        if _widths_n(smoother)[i] <= _bands_n(line)[i]:
            return (
                f", or rollers of less dry friction: with gate.stress_coulomb_nm of at most {dry_nm:.3g} Nm it has one"
            )
    return ""


def _better_known(line: Line, share: float) -> Line:
    def better(parameter: Parameter) -> Parameter:
        return parameter.model_copy(update={"tolerance": share * parameter.tolerance})

    rollers = [
        roller.model_copy(
            update={
                "radius_m": better(roller.radius_m),
                "friction_nms_per_rad": better(roller.friction_nms_per_rad),
            }
        )
        for roller in line.rollers
    ]
    return line.model_copy(update={"rollers": rollers})
