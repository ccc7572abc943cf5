"""Load cells that change while the line runs, or have lost their zero before it is armed, on drawn lines.

Found is what ends production, not what is only told; the truth of the simulated web says how far tension went.
"""

from collections.abc import Callable
from dataclasses import replace
from math import isfinite

import numpy as np

from gateway.core.states import LoopState, Phase
from tests.bench.harm_lines import Drawn, any_span, drawn
from tests.bench.harm_runs import NEVER_S, Outcome, Watched, begun, threaded

STEADY_S = 3.0  #: of production before
WITHIN_S = 20.0
ZEROED_SHARE = 0.9  #: of the working tension, that was taken for nothing


def tared(draw: Drawn, dice: np.random.Generator) -> str:
    """Zeroed, or a tare that was pressed, by a good part of the working tension either way."""
    by_n = float(dice.choice((-1.0, 1.0)) * dice.uniform(0.3, 0.9)) * draw.size.tension_n
    return f"load-cell {any_span(draw, dice)} offset by_n={by_n:.6g}"


def decimals(draw: Drawn, dice: np.random.Generator) -> str:
    """Another factor, or other decimals at the terminal."""
    factor = float(dice.choice((0.1, 0.5, 2.0, 10.0)))
    return f"load-cell {any_span(draw, dice)} cell-factor factor={factor:g}"


def in_service(row: str, seed: int, fault: Callable[[Drawn, np.random.Generator], str]) -> Outcome:
    """At a random speed. Unsafe is also a true tension beyond the line's limit before production ends."""
    dice = np.random.default_rng([seed, 37])
    loop = begun(seed, float(dice.uniform(0.1, 0.9)))
    loop.step(round(STEADY_S / loop.line.control.period_s))
    watched = Watched(row, seed, loop, [fault(drawn(seed), dice)])
    most_n = 0.0

    def stopped() -> bool:
        nonlocal most_n
        most_n = max(most_n, float(loop.truth.world.tension_n.max()))
        return loop.cycle.machine.state is LoopState.STOP

    stopped_s = watched.step_until(stopped, WITHIN_S)
    until_s = min(stopped_s, WITHIN_S) + loop.line.longest_stop_s
    rest_s = watched.step_until(watched.rests, until_s) if isfinite(stopped_s) else NEVER_S
    outcome = watched.outcome(rest_s, ("tension-band",))
    unsafe = dict(outcome.unsafe)
    if most_n > loop.line.limits.tension_max_n:
        unsafe["tension over the limit"] = 1
    code = loop.stopped_by[0][1].rule if loop.stopped_by else ""
    return replace(outcome, unsafe=unsafe, code=code, found_s=stopped_s)


def zeroed_at_rest(row: str, seed: int) -> Outcome:
    """Zeroed with the web in it, which is slack now: it must not be armed."""
    loop, dice = threaded(seed), np.random.default_rng([seed, 38])
    draw = drawn(seed)
    by_n = -ZEROED_SHARE * draw.size.tension_n
    watched = Watched(row, seed, loop, [f"load-cell {any_span(draw, dice)} offset by_n={by_n:.6g}"])
    loop.step(10)
    reply = loop.arm()
    outcome = watched.outcome(0.0)
    codes = [one.code for one in reply.findings]
    refused = "load-cell-below-zero" in codes and loop.cycle.machine.phase is Phase.SILENT
    return replace(outcome, code=codes[0] if codes else "", found_s=0.0 if refused else NEVER_S, note=reply.text)
