"""The candidates of a step of the chain: which is proposed next, and which may be in its place. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from gateway.commissioning.candidates import FIRST_LAWS
from gateway.commissioning.past import BY_RULES, Outcome, Past, Step
from gateway.commissioning.redesign import RUNGS

#: Candidates of each step.
LADDERS: dict[Step, int] = {
    Step.FIRST: len(FIRST_LAWS),
    Step.EXPERIMENT: 4,
    Step.MODEL: 3,
    Step.REDESIGN: RUNGS + 1,
    Step.MEASUREMENT: 2,
}
#: From here on: no rung, but somebody's own numbers. So many in a row, then only the ladder is left.
OWN, MOST_OWN = 100, 3
#: Of a model: from the newest experiment, from all recordings, and where those were tried first, from the newest.
NEWEST, ALL, NEWEST_AFTER_ALL = 0, 1, 2
AS_IT_IS = RUNGS  #: of a redesign: the configuration in service stays, and is judged for what data have shown since
MOST_EXPERIMENTS = 3  #: in a row, without a model from their data
MOST_AGAIN = 3  #: times that one rung is proposed again, because the moment was wrong


@dataclass(frozen=True)
class Next:
    """To be proposed."""

    step: Step
    rung: int
    speeds_m_per_s: tuple[float, ...] = ()  #: of an experiment's legs
    size: float = 1.0  #: of an experiment, times the amplitude that it is designed with
    number: int = 0  #: of the experiment since the last model, from 0
    others: tuple["Next", ...] = field(default=(), compare=False)  #: that may be taken in its place
    own: int = field(default=MOST_OWN, compare=False)  #: proposals with numbers of somebody's own that may still follow


@dataclass(frozen=True)
class Ended:
    """`reached`: an adapted configuration is in service over the line's range of speeds.

    `converged`: and it does there what it should, with nothing significant left to gain.
    """

    reached: bool
    text: str
    converged: bool = False


def on_ladder(step: Step, since: Sequence[Past], least: int = 0, end: int | None = None) -> Next | Ended:
    """The lowest rung that has not failed since something was done last; from `least` up to before `end`."""
    end = LADDERS[step] if end is None else end
    tried = [one for one in since if one.step is step]
    left = [rung for rung in range(least, end) if not _has_failed(rung, tried)]
    if not left:
        last = f"; the last one: {tried[-1].why}" if tried else ""
        return Ended(False, f"no {step} of {end - least} candidates gets through{last}")
    again = {rung: [one for one in tried if one.outcome is Outcome.AGAIN and one.rung == rung] for rung in left}
    if len(usual := again[left[0]]) > MOST_AGAIN:
        return Ended(False, f"the {step} has come at a wrong moment {len(usual)} times; the last time: {usual[-1].why}")
    # What is in service, as it is, comes last: it is no answer to the question which design is the next.
    designs = [rung for rung in left[1:] if step is not Step.REDESIGN or rung != AS_IT_IS]
    others = tuple(Next(step, rung) for rung in designs if len(again[rung]) <= MOST_AGAIN)
    return Next(step, left[0], others=others, own=MOST_OWN - sum(OWN <= one.rung < BY_RULES for one in tried))


def _has_failed(rung: int, tried: Sequence[Past]) -> bool:
    failed = [one for one in tried if one.outcome is Outcome.FAILED]
    return any(
        one.rung == rung or (one.last and one.rung <= rung and not one.rung < AS_IT_IS <= rung) for one in failed
    )
