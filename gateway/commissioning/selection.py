"""From tuned candidates to the one that is offered: the score S = w . metrics (eq. performance_score), and why."""

from collections.abc import Mapping, Sequence
from math import inf, isnan

from gateway.commissioning.beforehand import GateAnswer
from gateway.commissioning.records import Trial
from gateway.core.line import NonNegative, Positive, Priorities, Strict
from gateway.core.metrics import Performance, score, weights

TERMS = ("tracking error", "settling time", "overshoot", "effort", "robustness", "computing")
UNITS = ("N", "s", "%", "(Nm)2 s", "N", "ms")
SHOWN = (1.0, 1.0, 1.0, 1.0, 1.0, 1e3)  #: factor from SI to the unit above
CLOSE = 0.02  #: of the score: a difference that no line would show
WAY_ON = (
    "The way on: `r2rgate commission` goes on by itself, with calmer laws and more data; or ask for less in the line's "
    "file: limits.tension_step_max_n, limits.speed_max_m_per_s."
)


class Candidate(Strict):
    """A tuned architecture, evaluated on the whole ground."""

    architecture: str
    title: str
    hash: str  #: of its configuration; "" where there is none
    values: dict[str, Positive]
    trial: Trial | None
    compute_s: NonNegative | None  #: median of a step
    refused: str  #: why it is not offered; "" where it is
    gate: GateAnswer | None = None  #: what the gate says of it beforehand; None: it was not asked
    score: NonNegative | None  #: S; None: not offered, or a metric is without bound
    score_otherwise: NonNegative | None = None  #: S by the weights that somebody has proposed; None: nobody has
    terms: list[float]  #: the parts of S, in the order of TERMS

    @property
    def can_be_chosen(self) -> bool:
        return self.score is not None and not isnan(self.score) and (self.gate is None or self.gate.passed)


def candidate(
    architecture: str,
    title: str,
    values: Mapping[str, float],
    config_hash: str,
    trial: Trial | None,
    compute_s: float | None,
    refused: str,
    priorities: Priorities,
    otherwise: Priorities | None = None,
    gate: GateAnswer | None = None,
) -> Candidate:
    """With its score, where it has one; `otherwise`: other weights, by which it is scored, too."""
    performance = None if refused or trial is None or compute_s is None else performance_of(trial, compute_s)
    whole = score(performance, priorities) if performance else None
    return Candidate(
        architecture=architecture, title=title, hash=config_hash, values=dict(values), trial=trial,
        compute_s=compute_s, refused=refused, gate=gate, score=whole,
        score_otherwise=score(performance, otherwise) if performance and otherwise else None,
        terms=(weights(priorities) * performance.vector()).tolist() if performance else [],
    )  # fmt: skip


def performance_of(trial: Trial, compute_s: float) -> Performance | None:
    """The six metrics of a trial; None where one has run away. What never settles counts as long as it was watched."""
    if trial.robustness_n is None:
        return None
    return Performance(
        rmse_n=sum(trial.rmse_n.values()) / len(trial.rmse_n),
        overshoot_pct=trial.overshoot_pct,
        settling_s=trial.watched_s if trial.settling_s is None else trial.settling_s,
        effort_n2m2s=trial.effort_n2m2s,
        robustness_n=trial.robustness_n,
        compute_s=compute_s,
    )


def ranked(candidates: Sequence[Candidate]) -> list[Candidate]:
    """C* first: of what the gate lets through the one with the least S. Then the others by S, and what has none."""

    def place(one: Candidate) -> tuple[bool, float]:
        return not one.can_be_chosen, inf if one.score is None or isnan(one.score) else one.score

    return sorted(candidates, key=place)


def explanation(candidates: Sequence[Candidate], chosen: str = "", by: str = "") -> list[str]:
    """Why the first of `ranked` is chosen and what it costs, from the numbers alone.

    Or that `by` has chosen another of those with a score, `chosen`, and what that costs.
    """
    order = ranked(candidates)
    said: list[str] = []
    scored = [one for one in order if one.can_be_chosen]
    if scored:
        best = scored[0]
        if chosen in ("", best.architecture):
            least = "the least" if best.gate is None else "the least of those that the gate lets through"
            said.append(f"{best.architecture} is chosen: its score of {best.score:.3f} is {least}.")
            said += [_against(best, other) for other in scored[1:2]]
            if best.gate is not None:
                then = f"; should the line show otherwise, {scored[1].architecture} is the next" if scored[1:] else ""
                said.append(f"The gate's nearest rule is {best.gate.short}: {best.gate.text}{then}.")
        else:
            taken = next(one for one in scored if one.architecture == chosen)
            said.append(
                f"{chosen} is chosen by {by}: its score is {taken.score:.3f}. The least, which the rules would choose, "
                f"is the {best.score:.3f} of {best.architecture}."
            )
            said.append(_against(best, taken, f"{best.architecture} is ahead of {chosen}"))
    else:
        said.append("No architecture can be offered.")
        if any(one.gate is not None for one in order):
            said.append(WAY_ON)
    said += _unscored(order)
    return said


def _unscored(order: Sequence[Candidate]) -> list[str]:
    """Of each that is not offered, or does not settle."""
    said: list[str] = []
    for one in order:
        if one.refused:
            said.append(f"{one.architecture} is not offered: {one.refused}.")
        elif one.gate is not None and not one.gate.passed:
            said.append(f"{one.architecture} is not offered: the gate would refuse it: {'; '.join(one.gate.refusals)}.")
        elif one.trial is not None and one.trial.settling_s is None:
            said.append(f"{one.architecture} does not settle within 2 % of its set-points while it is watched.")
    return said


def _against(best: Candidate, other: Candidate, ahead_of: str = "") -> str:
    """The two side by side: where the difference of their scores comes from."""
    assert best.score is not None and other.score is not None
    ahead = other.score - best.score
    parts = sorted(((b - a, name) for a, b, name in zip(best.terms, other.terms, TERMS, strict=True)), reverse=True)
    gains = [f"{name} ({difference:+.3f})" for difference, name in parts if difference > 0.05 * abs(ahead)]
    costs = [f"{name} ({difference:+.3f})" for difference, name in parts if difference < -0.05 * abs(ahead)]
    text = f"{ahead_of or f'It is ahead of {other.architecture}'} by {ahead:.3f}"
    text += f" through {_listed(gains)}" if gains else ""
    text += f", and behind it in {_listed(costs)}" if costs else ""
    return f"{text}.{_if_close(best, other) if ahead < CLOSE * best.score else ''}"


def _if_close(best: Candidate, other: Candidate) -> str:
    """What decides between two that no line would tell apart: what the latency may do."""
    text = " The two are so close that either will do."
    if best.trial is not None and other.trial is not None:
        own_ms, other_ms = 1e3 * best.trial.delay_margin_s, 1e3 * other.trial.delay_margin_s
        if other_ms > 2.0 * own_ms:
            text += (
                f" Where the latency is not certain take {other.architecture}, which stands {other_ms:.1f} ms more "
                f"delay instead of {own_ms:.1f} ms."
            )
    return text


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
