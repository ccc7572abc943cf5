"""Wiring mistakes on drawn lines: each is to be found and named by the proof of the wiring, within its torque.

The truth of the simulated web judges what tension there was; what was named must be what is wrong, and nothing else.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gateway.core.messages import Drill, Prove
from gateway.core.states import Phase
from tests.bench.harm_lines import Drawn, any_span, drawn
from tests.bench.harm_runs import NEVER_S, NotStarted, Outcome, Watched, armed, threaded

OVER_SHARE = 0.25  #: of tension_max_n: a fifth, and what overshoots; more counts as unsafe
LONGEST_S = 3000.0
DRILLED_WITHIN_S = 30.0
ZERO_OFF = 8.0 / 28.0  #: of the working tension


@dataclass(frozen=True)
class Mistake:
    """`code` and the span or roller that are to be named; a pair that is swapped is named by the first."""

    fault: str
    code: str
    number: int


def proof(row: str, seed: int, mistake: Callable[[Drawn, np.random.Generator], Mistake | None]) -> Outcome:
    """The wiring of a threaded line is proved with this mistake in it. Found is what names it, and nothing else."""
    draw, dice = drawn(seed), np.random.default_rng([seed, 36])
    wrong = mistake(draw, dice)
    loop = threaded(seed)
    if not (loop.arm(Drill()).ok and loop.step_until(Phase.OFF, DRILLED_WITHIN_S) and loop.cycle.drill.watchdogs):
        raise NotStarted(f"not drilled: {loop.cycle.machine.reason}")
    watched = Watched(row, seed, loop, [wrong.fault] if wrong else [])
    loop.step(3)
    if refused := armed(loop):
        raise NotStarted(refused)
    reply = loop.command(Prove())
    if not reply.ok:
        raise NotStarted("; ".join([reply.text, *reply.reasons]))
    most_n = 0.0

    def over() -> bool:
        nonlocal most_n
        most_n = max(most_n, float(loop.truth.world.tension_n.max()))
        return loop.cycle.machine.phase is Phase.OFF

    rest_s = watched.step_until(over, LONGEST_S)
    told = {
        (finding.rule, finding.parameters.get("span", finding.parameters.get("roller")))
        for _, finding in loop.stopped_by
    }
    named = told == ({(wrong.code, wrong.number)} if wrong else set())
    codes = "+".join(sorted(f"{code} {number}" for code, number in told))
    outcome = watched.outcome(rest_s, ("tension-band",))
    unsafe = dict(outcome.unsafe)
    if most_n > OVER_SHARE * draw.line.limits.tension_max_n:
        unsafe["tension over the proof's share"] = 1
    asked = {event.kind: event.data for event in loop.events}.get("proved", {}).get("questions", [])
    note = f"{most_n / draw.line.limits.tension_max_n:.3f} of tension_max_n, {len(asked)} asked; {outcome.note}"
    code = (wrong.code if wrong else "") if named else f"not named: {codes or 'nothing'}"
    return Outcome(row, seed, unsafe, code, rest_s if named and wrong else NEVER_S, rest_s, outcome.fastest, note[:300])


def _cell_factor(factor: float, code: str) -> Callable[[Drawn, np.random.Generator], Mistake]:
    def mistake(draw: Drawn, dice: np.random.Generator) -> Mistake:
        span = any_span(draw, dice)
        return Mistake(f"load-cell {span} cell-factor factor={factor:g}", code, span)

    return mistake


def _zero(share: float) -> Callable[[Drawn, np.random.Generator], Mistake]:
    def mistake(draw: Drawn, dice: np.random.Generator) -> Mistake:
        span = any_span(draw, dice)
        return Mistake(f"load-cell {span} offset by_n={share * draw.size.tension_n:.6g}", "cell-zero-off", span)

    return mistake


def _swapped(draw: Drawn, dice: np.random.Generator) -> Mistake:
    one, other = sorted(1 + dice.choice(draw.size.spans, 2, replace=False))
    return Mistake(f"load-cell {one} cells-swapped other={other}", "cells-swapped", int(one))


def _reversed(draw: Drawn, dice: np.random.Generator) -> Mistake:
    roller = any_span(draw, dice)
    return Mistake(f"drive {roller} reversed", "drive-reversed", roller)


#: By the name of their row.
MISTAKES: dict[str, Callable[[Drawn, np.random.Generator], Mistake | None]] = {
    "wired-right": lambda draw, dice: None,
    "drive-reversed": _reversed,
    "cell-inverted": _cell_factor(-1.0, "cell-inverted"),
    "cells-swapped": _swapped,
    "cell-silent": _cell_factor(0.0, "cell-silent"),
    "cell-half": _cell_factor(0.5, "cell-factor-off"),
    "cell-double": _cell_factor(2.0, "cell-factor-off"),
    "zero-above": _zero(ZERO_OFF),
    "zero-below": _zero(-ZERO_OFF),
}
