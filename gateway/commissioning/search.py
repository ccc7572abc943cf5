"""The proposer that needs nobody: a pattern search over the logarithms of the knobs (Hooke and Jeeves 1961).

It keeps nothing: where it stands follows from the history, so that it takes over from any other proposer, or goes on
after an interruption, as if nothing had happened.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import log

from gateway.commissioning.architectures import Architecture, Knob
from gateway.commissioning.ground import Ground
from gateway.commissioning.records import Attempt, Suggestion
from gateway.commissioning.trial import diagnosis
from gateway.commissioning.tuning import best_of

FIRST_FACTOR = 2.0
LAST_FACTOR = 1.1  #: turning a knob by less changes nothing that anybody would notice
CALMER = {"torque_per_nm2": 1, "disturbance_nm_per_sqrt_s": -1, "speed_share": -1, "tension_share": -1}
SAME = 1e-3  #: relative


@dataclass(frozen=True)
class Turn:
    """One knob by a factor."""

    knob: Knob
    factor: float

    def applied(self, values: dict[str, float]) -> dict[str, float] | None:
        """The values after the turn; None where the knob is at its end already."""
        before = values[self.knob.name]
        after = _rounded(min(max(before * self.factor, self.knob.least), self.knob.most))
        return None if _same(before, after) else values | {self.knob.name: after}


class PatternSearch:
    """`Proposer`: every knob up and down by a factor; what helps is repeated, else the factor becomes smaller."""

    def suggest(self, architecture: Architecture, ground: Ground, history: Sequence[Attempt]) -> Suggestion | None:
        if not history:
            known = "where this architecture did well on lines of this kind"
            return Suggestion(values=architecture.first(ground.task), reason=known)
        best = best_of(history)
        if best is None:
            return self._calmer(architecture, ground, history)
        return next(untried_turns(architecture, ground, history, best), None)

    def _calmer(self, architecture: Architecture, ground: Ground, history: Sequence[Attempt]) -> Suggestion | None:
        """Nothing has been valid yet: all knobs towards a calmer loop at once."""
        told = history[-1].values  # somebody else's, perhaps: of knobs that there are not
        first = architecture.first(ground.task)
        last = first | {name: told[name] for name in first if name in told}
        values = calmer(architecture, last)
        if alike(values, told):
            return None
        return Suggestion(values=values, reason=f"{history[-1].refused}: a calmer loop")


def untried_turns(
    architecture: Architecture, ground: Ground, history: Sequence[Attempt], best: Attempt
) -> Iterator[Suggestion]:
    """Turns of `best` that lead to values not in `history`, in the order in which the search would try them."""
    seen = [attempt.values for attempt in history]
    factor = FIRST_FACTOR
    while factor >= LAST_FACTOR:
        for turn in _turns(architecture, history, best, factor):
            values = turn.applied(best.values)
            if values is not None and not any(alike(values, other) for other in seen):
                yield Suggestion(values=values, reason=_reason(best, ground, turn))
        factor = factor**0.5


def calmer(architecture: Architecture, values: Mapping[str, float]) -> dict[str, float]:
    """All knobs that make a loop calmer, by a factor of 2 within their ranges."""
    factors = {name: 2.0**direction for name, direction in CALMER.items()}
    return turned(architecture, values, {name: factor for name, factor in factors.items() if name in values})


def turned(architecture: Architecture, values: Mapping[str, float], factors: Mapping[str, float]) -> dict[str, float]:
    """`values` with some times a factor, within the knobs' ranges, to three digits."""
    knobs = {knob.name: knob for knob in architecture.knobs}
    ends = {name: (knobs[name].least, knobs[name].most) for name in factors}
    moved = {name: _rounded(min(max(values[name] * factors[name], low), high)) for name, (low, high) in ends.items()}
    return {**values, **moved}


def _turns(architecture: Architecture, history: Sequence[Attempt], best: Attempt, factor: float) -> list[Turn]:
    """Every turn by `factor`, first the one that has led to the best."""
    turns = [Turn(knob, f) for knob in architecture.knobs for f in (1.0 / factor, factor)]
    before = best_of(history[: best.number])
    if before is None:
        return turns
    return sorted(turns, key=lambda turn: -_along(turn, before, best))


def _along(turn: Turn, before: Attempt, best: Attempt) -> float:
    """How far the step from `before` to `best` went the way of `turn`."""
    return log(turn.factor) * log(best.values[turn.knob.name] / before.values[turn.knob.name])


def _reason(best: Attempt, ground: Ground, turn: Turn) -> str:
    found = diagnosis(best.trial, ground) if best.trial is not None else "the best so far"
    way = turn.knob.more if turn.factor > 1.0 else turn.knob.less
    return f"{found}: {turn.knob.name} times {turn.factor:.2f} ({way})"


def _rounded(value: float) -> float:
    """Three digits: more say nothing."""
    return float(f"{value:.3g}")


def _same(a: float, b: float) -> bool:
    return abs(log(a / b)) < SAME


def alike(a: Mapping[str, float], b: Mapping[str, float]) -> bool:
    """Whether they are the same values, as far as anybody would notice."""
    return a.keys() == b.keys() and all(_same(a[name], b[name]) for name in a)
