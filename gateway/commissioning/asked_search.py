"""Algorithm 1 with somebody who is asked: turns that the search would try, a calmer loop, numbers of their own, an end.

It keeps nothing, as the search does not: whether somebody is asked follows from the length of the history, so that what
was interrupted goes on as if it had not been. What they choose is tried like anything else.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

from gateway.commissioning.architectures import Architecture
from gateway.commissioning.decisions import RULES, Decided, Decider
from gateway.commissioning.ground import Ground
from gateway.commissioning.records import Attempt, Stop, Suggestion, Usual
from gateway.commissioning.search import PatternSearch, alike, calmer, turned, untried_turns
from gateway.commissioning.tuning import best_of
from gateway.commissioning.tuning_question import NEXT, STOP, Offer, tuning_question
from gateway.core.questions import factors_that_turn

STILL = 3  #: attempts in a row without a gain, after which somebody may end the search
MOST_OTHERS = 7  #: turns that are offered beside the one that the search would try


@dataclass(frozen=True)
class AskedSearch:
    """`Proposer` that asks `decider` for each of the `questions` attempts after the first, then searches alone.

    The first guess is nobody's choice: whoever is asked, what comes of it is no worse than that.
    """

    decider: Decider
    site: str
    line: str
    questions: int

    def suggest(
        self, architecture: Architecture, ground: Ground, history: Sequence[Attempt]
    ) -> Suggestion | Stop | None:
        search = PatternSearch().suggest(architecture, ground, _of_the_search(history))
        if not history or len(history) > self.questions:
            return search
        offers = offers_of(architecture, ground, history, search)
        question = tuning_question(self.site, self.line, architecture, ground, history, offers)
        return _taken(architecture, history, search, offers, self.decider.decide(question))


def _of_the_search(history: Sequence[Attempt]) -> Sequence[Attempt]:
    """What the search goes on from: as long as nothing holds, its own steps alone. Others' may have led astray."""
    if best_of(history) is not None:
        return history
    return [one for one in history if one.usual is None or one.usual.values == one.values]


def offers_of(
    architecture: Architecture, ground: Ground, history: Sequence[Attempt], search: Suggestion | None
) -> list[Offer]:
    """What may be tried next; first what the search says, None: that nothing better is to be expected.

    An end is offered where the last `STILL` attempts have brought nothing better, or the search sees one.
    """
    best = best_of(history)
    stop = Offer(STOP, "end the search here: nothing better is to be expected", None)
    found = [stop] if search is None else [Offer(NEXT, search.reason, search.values)]
    if best is not None:
        others = islice(untried_turns(architecture, ground, history, best), 1, 1 + MOST_OTHERS)
        found += [Offer(f"turn-{number}", one.reason, one.values) for number, one in enumerate(others, 1)]
        calm = calmer(architecture, best.values)
        if _tried_before(calm, history) is None:
            found.append(Offer("calmer", "all that makes the loop calmer, twice as much", calm))
        found.append(Offer("best", "the best so far, with factors of your own: without any it is no new attempt",
                           best.values))  # fmt: skip
    elif history and not architecture.wrong(history[-1].values):
        found.append(Offer("last", "what was tried last, with factors of your own: without any it is no new attempt",
                           history[-1].values))  # fmt: skip
    if search is not None and best is not None and len(history) - 1 - best.number >= STILL:
        found.append(stop)
    return found


def _taken(
    architecture: Architecture, history: Sequence[Attempt], search: Suggestion | None, offers: Sequence[Offer],
    decided: Decided,
) -> Suggestion | Stop | None:  # fmt: skip
    """What was chosen as a suggestion. What has been tried before is none: the search goes on in its place."""
    if decided.by == RULES:
        return _instead(search, decided.instead)
    usual = Usual(values={}, reason="nothing better is to be expected")
    if search is not None:
        usual = Usual(values=search.values, reason=search.reason)
    reason = decided.choice.reason
    offer = next(one for one in offers if one.id == decided.choice.option)
    if offer.values is None:
        return Stop(reason=reason, by=decided.by, usual=usual)
    values = turned(architecture, offer.values, factors_that_turn(decided.choice))
    if (number := _tried_before(values, history)) is not None:
        return _instead(search, f"{decided.by} chooses what attempt {number} has tried")
    return Suggestion(values=values, reason=reason, by=decided.by, usual=usual)


def _instead(search: Suggestion | None, why: str) -> Suggestion | None:
    """What the search says, with why it is asked."""
    return search.model_copy(update={"instead": why}) if search is not None and why else search


def _tried_before(values: dict[str, float], history: Sequence[Attempt]) -> int | None:
    """The number of the attempt."""
    return next((one.number for one in history if alike(values, one.values)), None)
