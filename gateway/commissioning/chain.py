"""The chain by which a new line is commissioned through the gate: what is proposed next, and when it is over. Pure.

    configuration on the line's file -> experiment -> model -> redesign on it -> experiment at higher speeds -> ...
        -> measurement -> model of all data -> redesign -> measurement
        or -> measurement -> experiment -> model -> redesign -> measurement -> ...

Each link rests on what the gate has let through before: a first configuration needs no model, an experiment only the
configuration in service, a model only the experiment's data, a redesign the model, and speeds beyond what data have
shown only an experiment there. So the chain can always begin, and each round ends where the next one does.

Once a configuration is in service over the line's range of speeds, what it does there is measured (algorithm 2):
where the criteria of convergence are met and no significant gain is predicted any more, the chain has come to its end,
after a model of all that has been recorded and a redesign on it (decision 41); where the line does otherwise than
foreseen another experiment, model, redesign and measurement follow, `MOST_ROUNDS` measurements at most. Where the model
has foreseen what is not as it should be, a calmer candidate follows at once.

Where a proposal is refused, the next, less ambitious candidate of a short ladder is taken (`LADDERS`), or whichever of
those that are left somebody chooses, or one with numbers of its own. What has been tried is read from the gate's own
list of proposals, in which each says its step and its rung: whoever asks again after a restart goes on where it ended.

The rules have the last word: where agents have led to what is in service in the end, and the rules' design on the same
model promises significantly more, that one is proposed before the chain ends; where no model came to be accepted, the
quicker configurations that the rules would have begun with (decision 40).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import sqrt

from gateway.commissioning.candidates import NEAR
from gateway.commissioning.ladder import ALL, AS_IT_IS, MOST_EXPERIMENTS, NEWEST, Ended, Next, on_ladder
from gateway.commissioning.last_word import by_rules
from gateway.commissioning.past import Follows, Outcome, Past, Step, experiments_since_model, is_done, last_done
from gateway.core.line import Line

MOST_ROUNDS = 3  #: measurements, before what they show is left as it is
STRETCH = 3.0  #: of the speed that data have shown: an experiment goes no faster
LEAST_RISE = 1.05  #: of the speed, from one adapted configuration to the next; fewer than two in a row rise less
SLOWER_LEG = 0.5  #: of an experiment's speed: its other one
#: Of the highest speed: a measurement. While spans step together the rollers behind them go faster than the web, and a
#: line at its highest speed takes that for a broken one.
MEASURED_AT = 0.75
#: The same of the first experiment. Moves of tensions that creep turn rollers back, and dry friction with them: at half
#: the first speed data of one line look like those of two.
SLOWER_FIRST_LEG = 0.75


@dataclass(frozen=True)
class Pending:
    """A proposal is on its way: nothing else is put before the gate meanwhile."""

    proposal: str
    kind: str


@dataclass(frozen=True)
class Look:
    """At what a measurement has shown."""

    proposal: str


def next_step(
    past: Sequence[Past], first_speed_m_per_s: float, wanted_m_per_s: float, adaptations: int = 1,
    most_redesigns: int | None = None, last_word: bool = True,
) -> Next | Pending | Look | Ended:  # fmt: skip
    """`past` oldest first. Speeds: of a first configuration's region, and up to which the line is to be adapted.

    `adaptations`: redesigns at least, also where the first has converged already. A further one may come to nothing.
    `most_redesigns`: once so many are kept none follows; what the last one does is measured, where it may go as fast as
    is wanted. `last_word`: the rules have it.
    """
    if open_ := next((one for one in reversed(past) if one.outcome is Outcome.OPEN), None):
        return Pending(open_.proposal, open_.kind)
    kept = sum(one.step is Step.REDESIGN and one.outcome is Outcome.DONE for one in past)
    found = _next_step(past, first_speed_m_per_s, wanted_m_per_s, adaptations)
    if most_redesigns is not None and kept >= most_redesigns and _goes_on(found):
        found = _enough(past, kept)
    return by_rules(past, found) if last_word and isinstance(found, Ended) else found


def _goes_on(found: Next | Look | Ended) -> bool:
    """To something else than a measurement, or nowhere."""
    if isinstance(found, Ended):
        return not found.reached
    return isinstance(found, Next) and found.step is not Step.MEASUREMENT


def _enough(past: Sequence[Past], kept: int) -> Ended:
    """So many redesigns were kept, and the last one has been measured."""
    at = last_done(past, "experiment")
    measured = past[at] if at > last_done(past, "gains") and past[at].step is Step.MEASUREMENT else None
    told = f"{kept} redesign{'' if kept == 1 else 's'} kept" + (f"; {measured.why}" if measured else "")
    return Ended(True, told, measured is not None and measured.converged)


def _next_step(
    past: Sequence[Past], first_speed_m_per_s: float, wanted_m_per_s: float, adaptations: int
) -> Next | Look | Ended:
    last = {kind: last_done(past, kind) for kind in ("gains", "experiment", "model")}
    since = past[max(last.values()) + 1 :]
    if last["gains"] < 0:
        return on_ladder(Step.FIRST if last["model"] < 0 else Step.REDESIGN, since)
    newest = past[last["experiment"]] if last["experiment"] > last["model"] else None
    of_measurement = newest is not None and newest.step is Step.MEASUREMENT
    if newest is not None and of_measurement and last["experiment"] > last["gains"]:
        more = _experiment(past, since, first_speed_m_per_s, wanted_m_per_s, 0)
        return _measured(past, newest, since, adaptations, more)
    if newest is not None and not of_measurement:
        data = past[last["experiment"] + 1 :]  # whatever has been put into service since: the same data give the same
        return _model(past, data, since, first_speed_m_per_s, wanted_m_per_s)
    reached = region_speed(past) or 0.0
    if last["model"] > last["gains"]:
        found = on_ladder(Step.REDESIGN, since, _known_by_measurement(past))
        measured = any(one.step is Step.MEASUREMENT and is_done(one, "experiment") for one in past)
        return Ended(True, found.text) if isinstance(found, Ended) and measured else found
    if last["model"] >= 0 and reached >= NEAR * wanted_m_per_s:
        adapted = any(is_done(one, "gains") and one.rung != AS_IT_IS for one in past[_first_model(past) :])
        what = (
            "an adapted configuration" if adapted else "the configuration of the begin, judged on the line's own model,"
        )
        text = f"{what} is in service up to {reached:.3g} m/s"
        found = on_ladder(Step.MEASUREMENT, since)
        if isinstance(found, Ended):
            return Ended(True, f"{text}; what it does there could not be measured: {found.text}")
        number = sum(one.step is Step.MEASUREMENT for one in past)
        top = MEASURED_AT * reached
        return Next(Step.MEASUREMENT, found.rung, (SLOWER_LEG * top, top), 0.5**found.rung, number)
    if _stands_still(past):
        return Ended(False, f"experiments at {wanted_m_per_s:.3g} m/s lead no further than {reached:.3g} m/s")
    return _experiment(past, since, first_speed_m_per_s, wanted_m_per_s, 0)


def _model(
    past: Sequence[Past], data: Sequence[Past], since: Sequence[Past], first_speed_m_per_s: float,
    wanted_m_per_s: float,
) -> Next | Ended:  # fmt: skip
    """From the data of an experiment; another experiment where they give none.

    `data`: what has been tried since the experiment; `since`: since anything was done.
    Once a measurement has been made all data come first: each by itself has been made use of.
    """
    measured = any(one.step is Step.MEASUREMENT and is_done(one, "experiment") for one in past)
    found = on_ladder(Step.MODEL, data, ALL) if measured else on_ladder(Step.MODEL, data, NEWEST, ALL + 1)
    if isinstance(found, Next):
        return found
    number = experiments_since_model(past)
    if number >= MOST_EXPERIMENTS:
        return Ended(measured, found.text)
    return _experiment(past, since, first_speed_m_per_s, wanted_m_per_s, number)


def _measured(
    past: Sequence[Past], measured: Past, since: Sequence[Past], adaptations: int, more: Next | Ended
) -> Next | Look | Ended:
    """After a measurement. `more`: the experiment with which another round begins."""
    if measured.follows is None:
        return Look(measured.proposal)
    what = f"an adapted configuration is in service up to {region_speed(past) or 0.0:.3g} m/s"
    due = still_due(past, adaptations)
    if measured.follows is Follows.LEAVE and not due:
        return Ended(True, f"{what}; {measured.why}", measured.converged)
    if not _rounds_left(past):
        left = f"{what}, and after {MOST_ROUNDS} measurements that is left as it is; {measured.why}"
        return Ended(True, left, measured.converged)
    found = more
    if measured.follows is Follows.CALMER and not due:
        # What is in service has been judged for all that data have shown: as it is, it is no candidate here.
        found = on_ladder(Step.REDESIGN, since, _known_by_measurement(past), AS_IT_IS)
    elif from_one_experiment(past) and (measured.follows is not Follows.NEWER_MODEL or isinstance(more, Ended)):
        found = on_ladder(Step.MODEL, since, ALL, ALL + 1)
        if isinstance(found, Ended) and (due or not measured.converged):
            found = more
    if isinstance(found, Ended):
        return Ended(True, f"{what}; {measured.why}; {found.text}", measured.converged)
    return found


def from_one_experiment(past: Sequence[Past]) -> bool:
    """Whether the accepted model is one of this chain, of the newest experiment that there was alone."""
    at = last_done(past, "model")
    return at >= 0 and past[at].step is Step.MODEL and past[at].rung == NEWEST


def may_use_all(past: Sequence[Past], recordings: int) -> bool:
    """Whether a model of all recordings may follow a measurement."""
    return from_one_experiment(past) and recordings > 1 and _rounds_left(past)


def _rounds_left(past: Sequence[Past]) -> bool:
    return sum(one.step is Step.MEASUREMENT and is_done(one, "experiment") for one in past) < MOST_ROUNDS


def may_experiment(past: Sequence[Past]) -> bool:
    """Whether another experiment follows where there is no model from the data of the newest."""
    at = last_done(past, "experiment")
    of_measurement = at >= 0 and past[at].step is Step.MEASUREMENT
    return not of_measurement and experiments_since_model(past) < MOST_EXPERIMENTS


def still_due(past: Sequence[Past], adaptations: int) -> bool:
    """Whether a further adaptation follows whatever a measurement has shown. A model has been accepted."""
    return sum(is_done(one, "gains") for one in past[_first_model(past) :]) < adaptations


def region_speed(past: Sequence[Past]) -> float | None:
    """Up to which the configuration that was kept last has been judged; None: there is none, or nobody says."""
    at = last_done(past, "gains")
    return None if at < 0 else past[at].speed_m_per_s


def _first_model(past: Sequence[Past]) -> int:
    return next(i for i, one in enumerate(past) if is_done(one, "model"))


def _stands_still(past: Sequence[Past]) -> bool:
    """Whether the last two adapted configurations were let through for hardly more speed than the one before them."""
    speeds = [one.speed_m_per_s or 0.0 for one in past if is_done(one, "gains")][-3:]
    return len(speeds) == 3 and speeds[2] < LEAST_RISE**2 * speeds[0] and speeds[2] < LEAST_RISE * speeds[1]


def _known_by_measurement(past: Sequence[Past]) -> int:
    """Candidates on the model that need not be tried again: measured, not as they should be, and foreseen by it.

    A newer model would give the same: the next candidate on the same model is a calmer one.
    """
    on_it = past[last_done(past, "model") + 1 :]
    done = [one for one in on_it if one.step is Step.MEASUREMENT and is_done(one, "experiment")]
    calmer = sum(one.follows is Follows.CALMER for one in done)
    rungs = [one.rung for one in on_it if one.step is Step.REDESIGN and is_done(one, "gains") and one.rung < AS_IT_IS]
    return min(max(calmer, *(1 + rung for rung in rungs)), AS_IT_IS) if calmer and rungs else calmer


def _experiment(
    past: Sequence[Past], since: Sequence[Past], first_m_per_s: float, wanted_m_per_s: float, number: int
) -> Next | Ended:
    """No faster than `STRETCH` times what data have shown; smaller, then slower, where one has failed.

    Larger where the data of one before have given no model; the first one before that at one speed.
    """
    found = on_ladder(Step.EXPERIMENT, since)
    if isinstance(found, Ended):
        return found
    shown = region_speed(past) or first_m_per_s
    first = last_done(past, "model") < 0

    def at(rung: int) -> Next:
        if first:
            top = min(first_m_per_s, shown)
            legs = first_legs(top) if number == 0 else (top,)
            return Next(Step.EXPERIMENT, rung, legs, 2.0 ** max(number - 1, 0) * 0.5**rung, number)
        top = min(wanted_m_per_s, STRETCH * shown)
        if rung >= 2:
            top = sqrt(shown * top)
        return Next(Step.EXPERIMENT, rung, (SLOWER_LEG * top, top), 2.0**number * 0.5 ** (rung % 2), number)

    return replace(at(found.rung), others=tuple(at(one.rung) for one in found.others), own=found.own)


def first_legs(top_m_per_s: float) -> tuple[float, ...]:
    """Speeds of the first experiment."""
    return (SLOWER_FIRST_LEG * top_m_per_s, top_m_per_s)


def refused_at_once(line: Line) -> str:
    """Why the line takes no proposals of the rules; empty: it does."""
    if line.gate.autonomy == "closed":
        return 'the line takes no changes: gate.autonomy is "closed" in its file'
    if "rules" not in line.gate.authors:
        return f'gate.authors is {", ".join(line.gate.authors) or "empty"}; "rules" proposes here: add it'
    return ""
