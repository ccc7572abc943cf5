"""Algorithm 1: from a first guess to the best hyperparameters of one architecture, with every attempt on record.

Whoever proposes - a search, a language model - sees the same history and answers with values and a reason. What is
proposed is designed, simulated and validated here; it is accepted only where it is valid and J falls.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf
from typing import Protocol
from warnings import catch_warnings

from numpy.linalg import LinAlgError
from scipy.linalg import LinAlgWarning

from gateway.commissioning.architectures import Architecture
from gateway.commissioning.ground import Ground
from gateway.commissioning.records import Attempt, Stop, Suggestion, Trial
from gateway.commissioning.trial import reasons_against, tried
from gateway.control.design import DesignRefused
from gateway.core.controller import Controller

MOST_ITERATIONS = 50


class Proposer(Protocol):
    """Who chooses the next values."""

    def suggest(
        self, architecture: Architecture, ground: Ground, history: Sequence[Attempt]
    ) -> Suggestion | Stop | None:
        """The next values, the first when there is no history; None: nothing better is to be expected.

        A Stop says the same for somebody other than the rules.
        """
        ...


@dataclass(frozen=True)
class Tuned:
    history: tuple[Attempt, ...]
    converged: bool  #: the proposer had nothing more to say
    stopped: Stop | None = None  #: and it was not the rules that saw an end there

    @property
    def best(self) -> Attempt | None:
        """The last one accepted; None: nothing could be offered."""
        return best_of(self.history)

    def reasons(self) -> str:
        """Why nothing can be offered, where there is no best."""
        found = list(dict.fromkeys(attempt.refused for attempt in self.history if attempt.refused))
        tries = f"{len(self.history)} attempt{'' if len(self.history) == 1 else 's'}"
        return f"none of {tries} holds; {'; '.join(found[:3])}"

    def config(self, architecture: Architecture, ground: Ground) -> Controller:
        """The configuration of the best attempt with `architecture`. Raises DesignRefused where there is none."""
        if self.best is None:
            raise DesignRefused(self.reasons())
        return architecture.design(ground.task, self.best.values, ground.speeds_m_per_s)


def best_of(history: Sequence[Attempt]) -> Attempt | None:
    """The last one accepted."""
    return next((attempt for attempt in reversed(history) if attempt.accepted), None)


def tune(
    architecture: Architecture,
    ground: Ground,
    proposer: Proposer,
    most: int = MOST_ITERATIONS,
    history: Sequence[Attempt] = (),
    on_attempt: Callable[[Attempt], None] = lambda attempt: None,
) -> Tuned:
    """Run algorithm 1, or go on with a `history` that was interrupted. `most` attempts follow the first guess."""
    done = list(history)
    while len(done) <= most:
        suggestion = proposer.suggest(architecture, ground, done)
        if suggestion is None:
            return Tuned(tuple(done), converged=True)
        if isinstance(suggestion, Stop):
            return Tuned(tuple(done), converged=True, stopped=suggestion)
        attempt = attempted(architecture, ground, suggestion, done)
        done.append(attempt)
        on_attempt(attempt)
    return Tuned(tuple(done), converged=False)


def _cost(trial: Trial | None) -> float:
    """J; infinite where there is none."""
    return inf if trial is None or trial.cost_n2s is None else trial.cost_n2s


def attempted(
    architecture: Architecture, ground: Ground, suggestion: Suggestion, history: Sequence[Attempt]
) -> Attempt:
    """What became of a suggestion: designed, simulated, validated, and compared with the best before."""

    def attempt(trial: Trial | None, refused: str, accepted: bool) -> Attempt:
        return Attempt(
            number=len(history), values=dict(suggestion.values), reason=suggestion.reason, by=suggestion.by,
            instead=suggestion.instead, usual=suggestion.usual, trial=trial, refused=refused, accepted=accepted,
        )  # fmt: skip

    try:
        # At the far ends of knobs a loop may be such that its figures mean nothing: it is no candidate.
        with catch_warnings(action="error", category=LinAlgWarning):
            trial = tried(architecture.design(ground.task, suggestion.values, ground.speeds_m_per_s), ground)
    except DesignRefused as refused:
        return attempt(None, str(refused), accepted=False)
    except (LinAlgError, LinAlgWarning) as error:
        return attempt(None, f"its figures cannot be computed: {error}", accepted=False)
    against = "; ".join(reasons_against(trial, ground))
    best = best_of(history)
    better = best is None or _cost(trial) < _cost(best.trial)  # one that is no number is less than none
    return attempt(trial, against, accepted=not against and better)
