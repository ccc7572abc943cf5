"""The chain by which a new line is commissioned through the gate: what is proposed next, and when it is over. Pure.

    configuration on the line's file -> experiment -> model -> redesign on it -> experiment at higher speeds -> ...

Each link rests on what the gate has let through before: a first configuration needs no model, an experiment only the
configuration in service, a model only the experiment's data, a redesign the model, and speeds beyond what data have
shown only an experiment there. So the chain can always begin, and each round ends where the next one does.

Where a proposal is refused, the next, less ambitious candidate of a short ladder is taken (`LADDERS`). What has been
tried is read from the gate's own list of proposals, in which each says its step and its rung: whoever asks again after
a restart goes on where it ended.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import sqrt

from gateway.commissioning.candidates import FIRST_LAWS
from gateway.commissioning.redesign import RUNGS
from gateway.core.decisions import ProposalShown
from gateway.core.line import Line
from gateway.core.proposal import Evidence
from gateway.core.verdict import Verdict


class Step(StrEnum):
    FIRST = "first configuration"
    EXPERIMENT = "experiment"
    MODEL = "model"
    REDESIGN = "redesign"


class Outcome(StrEnum):
    OPEN = "open"  #: it is being judged, decided, or done
    DONE = "done"
    AGAIN = "again"  #: nothing was against it but the moment
    FAILED = "failed"


#: Candidates of each step.
LADDERS: dict[Step, int] = {
    Step.FIRST: len(FIRST_LAWS),
    Step.EXPERIMENT: 4,
    Step.MODEL: 2,
    Step.REDESIGN: RUNGS + 1,
}
AS_IT_IS = RUNGS  #: of a redesign: the configuration in service stays, and is judged for what data have shown since
MOST_AGAIN = 3  #: times that one rung is proposed again, because the moment was wrong
MOST_EXPERIMENTS = 3  #: in a row, without a model from their data
STRETCH = 3.0  #: of the speed that data have shown: an experiment goes no faster
NEAR = 0.98  #: of the speed that is wanted, which is as good
LEAST_RISE = 1.05  #: of the speed, from one adapted configuration to the next; fewer than two in a row rise less
SLOWER_LEG = 0.5  #: of an experiment's speed: its other one
#: The same of the first experiment. Moves of tensions that creep turn rollers back, and dry friction with them: at half
#: the first speed data of one line look like those of two.
SLOWER_FIRST_LEG = 0.75
PROPOSED_BY = "commissioning: "  #: how the evidence begins that names step and rung

#: Rules that speak against the moment, not against what is proposed.
OF_THE_MOMENT = frozenset({"state of the line", "cool-down", "freshness", "time", "judge process"})
OPEN_STAGES = frozenset({"received", "waiting", "approved", "deploying", "probation", "keeping", "running"})
STALE_STAGES = frozenset({"expired", "superseded", "not-deployed"})


@dataclass(frozen=True)
class Past:
    """A proposal of the gate's list, or a candidate that could not even be made."""

    kind: str
    outcome: Outcome
    step: Step | None = None  #: of this chain; None: somebody else has proposed it
    rung: int = 0
    why: str = ""
    speed_m_per_s: float | None = None  #: up to which a verdict lets a configuration run
    proposal: str = ""  #: hash; empty: it could not be made


@dataclass(frozen=True)
class Next:
    """To be proposed."""

    step: Step
    rung: int
    speeds_m_per_s: tuple[float, ...] = ()  #: of an experiment's legs
    size: float = 1.0  #: of an experiment, times the amplitude that it is designed with
    number: int = 0  #: of the experiment since the last model, from 0


@dataclass(frozen=True)
class Pending:
    """A proposal is on its way: nothing else is put before the gate meanwhile."""

    proposal: str
    kind: str


@dataclass(frozen=True)
class Ended:
    """`reached`: an adapted configuration is in service over the line's range of speeds."""

    reached: bool
    text: str


def next_step(
    past: Sequence[Past], first_speed_m_per_s: float, wanted_m_per_s: float, adaptations: int = 1
) -> Next | Pending | Ended:
    """`past` oldest first. Speeds: of a first configuration's region, and up to which the line is to be adapted.

    `adaptations`: redesigns, at least. Those beyond the first that covers the wanted speed may come to nothing.
    """
    found = _next(past, first_speed_m_per_s, wanted_m_per_s, adaptations)
    if isinstance(found, Ended) and not found.reached and _covered(past, wanted_m_per_s):
        return Ended(True, f"{_reached(past)}; nothing further gets through: {found.text}")
    return found


def _next(
    past: Sequence[Past], first_speed_m_per_s: float, wanted_m_per_s: float, adaptations: int
) -> Next | Pending | Ended:
    if open_ := next((one for one in reversed(past) if one.outcome is Outcome.OPEN), None):
        return Pending(open_.proposal, open_.kind)
    last = {kind: _last_done(past, kind) for kind in ("gains", "experiment", "model")}
    since = past[max(last.values()) + 1 :]
    if last["gains"] < 0:
        return _on_ladder(Step.FIRST if last["model"] < 0 else Step.REDESIGN, since)
    if last["experiment"] > last["model"]:
        found = _on_ladder(Step.MODEL, since)
        number = sum(_is_done(one, "experiment") for one in past[last["model"] + 1 :])
        if isinstance(found, Next) or number >= MOST_EXPERIMENTS:
            return found
        return _experiment(past, since, first_speed_m_per_s, wanted_m_per_s, number)
    if last["model"] > last["gains"]:
        return _on_ladder(Step.REDESIGN, since)
    if _covered(past, wanted_m_per_s):
        if len(_redesigned(past)) >= adaptations:
            return Ended(True, _reached(past))
    elif _stands_still(past):
        reached = region_speed(past) or 0.0
        return Ended(False, f"experiments at {wanted_m_per_s:.3g} m/s lead no further than {reached:.3g} m/s")
    return _experiment(past, since, first_speed_m_per_s, wanted_m_per_s, 0)


def _redesigned(past: Sequence[Past]) -> list[Past]:
    """Configurations that were kept since there is a model, the one of the begin among them."""
    first = next((i for i, one in enumerate(past) if _is_done(one, "model")), len(past))
    return [one for one in past[first:] if _is_done(one, "gains")]


def _covered(past: Sequence[Past], wanted_m_per_s: float) -> bool:
    """Whether what is in service was judged on a model, up to the speed that is wanted."""
    return bool(_redesigned(past)) and (region_speed(past) or 0.0) >= NEAR * wanted_m_per_s


def _reached(past: Sequence[Past]) -> str:
    adapted = any(one.rung != AS_IT_IS for one in _redesigned(past))
    what = "an adapted configuration" if adapted else "the configuration of the begin, judged on the line's own model,"
    return f"{what} is in service up to {region_speed(past) or 0.0:.3g} m/s"


def region_speed(past: Sequence[Past]) -> float | None:
    """Up to which the configuration that was kept last has been judged; None: there is none, or nobody says."""
    at = _last_done(past, "gains")
    return None if at < 0 else past[at].speed_m_per_s


def _stands_still(past: Sequence[Past]) -> bool:
    """Whether the last two adapted configurations were let through for hardly more speed than the one before them."""
    speeds = [one.speed_m_per_s or 0.0 for one in past if _is_done(one, "gains")][-3:]
    return len(speeds) == 3 and speeds[2] < LEAST_RISE**2 * speeds[0] and speeds[2] < LEAST_RISE * speeds[1]


def past_of(shown: ProposalShown) -> Past:
    """A proposal as the gate shows it."""
    verdict = shown.verdict
    step, rung = _named(shown.proposal.evidence)
    region = None if verdict is None else verdict.region
    return Past(
        kind=shown.proposal.kind,
        outcome=_outcome(shown.stage, shown.why, verdict),
        step=step,
        rung=rung,
        why=shown.why,
        speed_m_per_s=None if region is None else region.speed_max_m_per_s,
        proposal=shown.proposal_hash,
    )


def named(step: Step, rung: int) -> Evidence:
    """By which a proposal of the chain is known."""
    return Evidence(what=f"{PROPOSED_BY}{step}", value=float(rung))


def _named(evidence: Sequence[Evidence]) -> tuple[Step | None, int]:
    for one in evidence:
        name = one.what.removeprefix(PROPOSED_BY)
        if one.what.startswith(PROPOSED_BY) and name in set(Step) and one.value is not None:
            return Step(name), int(one.value)
    return None, 0


def _outcome(stage: str, why: str, verdict: Verdict | None) -> Outcome:
    if stage in OPEN_STAGES:
        return Outcome.OPEN
    if stage in STALE_STAGES:
        return Outcome.AGAIN
    if stage == "kept" or (stage == "done" and not why):
        return Outcome.DONE
    if stage == "refused" and verdict is not None:
        against = {one.rule for one in verdict.findings if not one.passed}
        return Outcome.AGAIN if against <= OF_THE_MOMENT else Outcome.FAILED
    return Outcome.FAILED


def _is_done(one: Past, kind: str) -> bool:
    return one.kind == kind and one.outcome is Outcome.DONE


def _last_done(past: Sequence[Past], kind: str) -> int:
    return max((i for i, one in enumerate(past) if _is_done(one, kind)), default=-1)


def _on_ladder(step: Step, since: Sequence[Past]) -> Next | Ended:
    """The first rung above those that have failed since something was done last."""
    tried = [one for one in since if one.step is step]
    rung = 1 + max((one.rung for one in tried if one.outcome is Outcome.FAILED), default=-1)
    if rung >= LADDERS[step]:
        return Ended(False, f"no {step} of {LADDERS[step]} candidates gets through; the last one: {tried[-1].why}")
    again = [one for one in tried if one.outcome is Outcome.AGAIN and one.rung == rung]
    if len(again) > MOST_AGAIN:
        return Ended(False, f"the {step} has come at a wrong moment {len(again)} times; the last time: {again[-1].why}")
    return Next(step, rung)


def _experiment(
    past: Sequence[Past], since: Sequence[Past], first_m_per_s: float, wanted_m_per_s: float, number: int
) -> Next | Ended:
    """No faster than `STRETCH` times what data have shown; smaller, then slower, where one has failed.

    Larger where the data of one before have given no model; the first one before that at one speed.
    """
    found = _on_ladder(Step.EXPERIMENT, since)
    if isinstance(found, Ended):
        return found
    shown = region_speed(past) or first_m_per_s
    if _last_done(past, "model") < 0:
        top = min(first_m_per_s, shown)
        legs = (SLOWER_FIRST_LEG * top, top) if number == 0 else (top,)
        return Next(Step.EXPERIMENT, found.rung, legs, 2.0 ** max(number - 1, 0) * 0.5**found.rung, number)
    top = min(wanted_m_per_s, STRETCH * shown)
    if found.rung >= 2:
        top = sqrt(shown * top)
    size = 2.0**number * 0.5 ** (found.rung % 2)
    return Next(Step.EXPERIMENT, found.rung, (SLOWER_LEG * top, top), size, number)


def refused_at_once(line: Line) -> str:
    """Why the line takes no proposals of the rules; empty: it does."""
    if line.gate.autonomy == "closed":
        return 'the line takes no changes: gate.autonomy is "closed" in its file'
    if "rules" not in line.gate.authors:
        return f'gate.authors is {", ".join(line.gate.authors) or "empty"}; "rules" proposes here: add it'
    return ""
