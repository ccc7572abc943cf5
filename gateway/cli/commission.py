"""The commissioning chain carried out: the next proposal is made and put before the gate, until the chain has ended.

Whoever runs it, on a simulated line in stepped time or on a gateway that runs, gives a `GateSide`. Nothing is kept
here: what has been tried stands in the gate's list, what measurements have shown in the line's baselines, and a
candidate that cannot be made is found so again.
"""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import inf

from gateway.cli.commission_changes import MOST_REASON, Changes, LineNow, Offer, first_speed_m_per_s
from gateway.cli.commission_measurements import keep
from gateway.cli.commission_questions import (
    MORE_DATA,
    diagnosis_question,
    fidelity_question,
    option_id,
    step_question,
)
from gateway.cli.commission_result import Commissioned, candidate_name, commissioned
from gateway.cli.commission_side import Away, CannotGoOn, GateSide, measured_on, proposed_on_model, put, region_kept
from gateway.commissioning.candidates import Exhausted, NotOffered, fastest_m_per_s
from gateway.commissioning.chain import (
    Look,
    Pending,
    may_experiment,
    may_use_all,
    next_step,
    refused_at_once,
    region_speed,
    still_due,
)
from gateway.commissioning.convergence import Convergence, Diagnosis
from gateway.commissioning.decisions import RULES, Decided, Decider, Rules
from gateway.commissioning.ladder import MOST_OWN, OWN, Ended, Next
from gateway.commissioning.past import KINDS, Follows, Outcome, Past, Step, named, past_of
from gateway.core.asked_before import asked
from gateway.core.decisions import ProposalShown
from gateway.core.line import Line
from gateway.core.line_problem import printable, quoted
from gateway.core.questions import Choice, Question, factors_that_turn
from gateway.identification.identify import Identified
from gateway.supervisor.baselines import BaselinesError

RULES_DECIDE = Rules()
MOST_QUOTED = 2000  #: letters of what an agent says, in a proposal

Tell = Callable[[str], None]


async def commission(
    line: Line,
    side: GateSide,
    tell: Tell = lambda text: None,
    *,
    wanted_m_per_s: float | None = None,
    adaptations: int = 1,
    most_redesigns: int | None = None,
    decider: Decider = RULES_DECIDE,
    last_word: bool = True,
) -> Commissioned:
    """Until the chain has ended, one way or the other. Every rung is tried once, so that it does.

    A gateway that goes away on the way is waited for. All that has been done stands in its list, so it goes on there.

    `wanted_m_per_s`: up to which the line is to be adapted; None: as fast as its drives hold.
    `adaptations`: redesigns at least; `most_redesigns`: once so many are kept none follows.
    `decider`: who chooses among the candidates. `last_word`: the rules propose theirs in the end, where agents have
    chosen what is in service and the rules' own design promises significantly more.
    """
    if why := refused_at_once(line):
        return Commissioned(False, why, [], None)
    chain, was_there = _Chain(line, side, tell, decider, wanted_m_per_s, adaptations), False
    while True:
        try:
            await chain.read()
            was_there = True
            step = await chain.next(most_redesigns, last_word)
            if isinstance(step, Ended):
                return chain.ended(step)
            if isinstance(step, Pending):
                await side.wait_for(step.proposal)
            elif isinstance(step, Look):
                await chain.look(step.proposal)
            else:
                await side.ready()
                await chain.propose(step)
        except CannotBeJudged as error:
            text = f"an adapted configuration is in service up to {region_speed(chain.past) or 0.0:.3g} m/s"
            return chain.ended(Ended(True, f"{text}; what was measured cannot be judged: {error}"))
        except Away as away:
            if not was_there or not await side.is_back(str(away)):
                return chain.ended(Ended(False, str(away)))
        except CannotGoOn as stopped:
            return chain.ended(Ended(False, str(stopped)))


class CannotBeJudged(Exception):
    """A measurement, and so whether the line does what it should."""


class _MoreData(NotOffered):
    """No model of the data that there are, from whichever recordings: another experiment comes first."""


class _Chain:
    """One run: what has been tried, as it was read last, and what could not be made since the run began."""

    def __init__(
        self, line: Line, side: GateSide, tell: Tell, decider: Decider, wanted_m_per_s: float | None, adaptations: int
    ) -> None:  # fmt: skip
        self._line = line
        self._side = side
        self._tell = tell
        self._decider = decider
        self._wanted_m_per_s = wanted_m_per_s
        self._adaptations = adaptations
        self._changes = Changes(line, inf if wanted_m_per_s is None else wanted_m_per_s)
        self._unmade: list[tuple[int, Past]] = []  #: by how many proposals there were
        self._shown: list[ProposalShown] = []
        self._measured: dict[str, Convergence] = {}
        self._doubted = False  #: more data have been asked for since a model was proposed
        self._asked: list[str] = []  #: of agents since the last candidate: ids in their log
        self.past: list[Past] = []

    async def read(self) -> None:
        """What has been tried until now."""
        self._shown, self._measured = await self._side.proposals(), await measured_on(self._line, self._side)
        self.past = _merged(self._shown, self._unmade, self._measured)

    async def next(self, most_redesigns: int | None, last_word: bool) -> Next | Pending | Look | Ended:
        now = await self._side.now()
        fastest = fastest_m_per_s(self._line, now.model)
        wanted = fastest if self._wanted_m_per_s is None else min(self._wanted_m_per_s, fastest)
        first = first_speed_m_per_s(self._line)
        return next_step(self.past, first, wanted, self._adaptations, most_redesigns, last_word)

    def ended(self, how: Ended) -> Commissioned:
        return commissioned(how, self.past, self._shown, self._measured)

    async def look(self, proposal: str) -> None:
        """At what the measurement under `proposal`, the newest experiment, has shown.

        Raises CannotGoOn and CannotBeJudged.
        """
        now, recordings = await self._side.now(), await self._side.recordings()
        if not recordings or now.model is None:
            raise CannotGoOn(
                "the data of the last measurement are older than gate.data_max_age_s: propose an experiment, then go on"
            )
        try:
            found = await asyncio.to_thread(self._changes.looked_at, now, recordings)
        except NotOffered as error:
            raise CannotBeJudged(str(error)) from error
        self._tell(f"measurement: {found.text}")
        due = still_due(self.past, self._adaptations)
        few = may_use_all(self.past, len(recordings))
        decided = await self._decided(diagnosis_question(self._line, found, now, self.past, due, few))
        follows, because = Follows(decided.choice.option), decided.choice.reason
        if decided.by != RULES or follows is not found.follows:
            found = found.model_copy(update={"diagnosis": Diagnosis(follows=follows, by=decided.by, because=because)})
        try:
            effort = self._changes.effort_n2m2s(recordings[0])
            keep(await self._side.folder(), self._line, now, proposal, found, effort)
        except BaselinesError as error:
            raise CannotGoOn(f"what was measured cannot be kept: {error}") from error

    async def propose(self, step: Next) -> None:
        """One of the step's candidates, or note that it cannot be made. Raises CannotGoOn."""
        now, recordings = await self._side.now(), await self._side.recordings()
        _require_slow(self._line, step, now)
        rung = step.rung
        try:
            offers = await asyncio.to_thread(
                self._changes.offers, step, now, recordings, region_kept(self._shown), proposed_on_model(self._shown)
            )
            decided, rung = await self._chosen(step, offers, now)
            what = f"{step.step}, {candidate_name(rung)}"
            self._tell(f"{what}: being made")
            offer = next(one for one in offers if option_id(one.rung) == decided.choice.option)
            made = await asyncio.to_thread(offer.make, factors_that_turn(decided.choice))
            if made.identified is not None:
                await self._require_faith(made.identified, now)
        except NotOffered as refused:
            self._tell(f"{step.step}, {candidate_name(rung)}: cannot be made: {refused}")
            more_data = isinstance(refused, _MoreData)
            last = more_data or isinstance(refused, Exhausted)
            failed = Past(
                KINDS[step.step], Outcome.FAILED, step.step, 0 if more_data else rung, str(refused), last=last
            )
            self._unmade.append((len(self._shown), failed))
            self._asked.clear()
            return
        self._tell(f"{what}: {made.reason}")
        reason = _reason(made.reason, decided)
        evidence = [named(step.step, rung), *map(asked, self._asked)]
        await put(self._line, self._side, made.change, reason, evidence, decided.author, now)
        self._asked.clear()
        self._doubted = self._doubted and step.step is not Step.MODEL

    async def _chosen(self, step: Next, offers: Sequence[Offer], now: LineNow) -> tuple[Decided, int]:
        """And the rung under which it is known."""
        if len(offers) == 1 and not offers[0].knobs:
            only = Choice(option=option_id(step.rung), reason="there is no other candidate")
            return Decided(only, RULES), step.rung
        decided = await self._decided(step_question(self._line, step, offers, now, self.past))
        if factors_that_turn(decided.choice):
            return decided, OWN + MOST_OWN - step.own
        return decided, next(one.rung for one in offers if option_id(one.rung) == decided.choice.option)

    async def _require_faith(self, found: Identified, now: LineNow) -> None:
        """Raises _MoreData where the model is not trusted enough to be proposed: once, then the gate judges it."""
        if self._doubted or not may_experiment(self.past):
            return
        decided = await self._decided(fidelity_question(self._line, found, now, self.past))
        if decided.choice.option == MORE_DATA:
            self._doubted = True
            raise _MoreData(f"{decided.by} asks for more data first: {decided.choice.reason}"[:MOST_REASON])

    async def _decided(self, question: Question) -> Decided:
        decided = await asyncio.to_thread(self._decider.decide, question)
        if decided.interaction:
            self._asked.append(decided.interaction)
        if decided.instead:
            self._tell(f"{question.decision}: {printable(decided.instead)}: the rules decide")
        elif decided.by != RULES:
            chosen = f"{decided.by} chooses {decided.choice.option}"
            self._tell(f"{question.decision}: {chosen}: {printable(decided.choice.reason)}")
        return decided


def _reason(made: str, decided: Decided) -> str:
    """With the words of whoever chose, as a quotation."""
    return made if decided.by == RULES else f"{made}. {decided.by} says: {quoted(decided.choice.reason, MOST_QUOTED)}"


def _require_slow(line: Line, step: Next, now: LineNow) -> None:
    """A first configuration is judged for low speed, and put on a line that runs no faster."""
    first = first_speed_m_per_s(line)
    if step.step is Step.FIRST and now.speed_m_per_s > first:
        raise CannotGoOn(
            f"the line shall run at {now.speed_m_per_s:g} m/s, and a first configuration is judged up to {first:g} m/s "
            f"(gate.first_speed_max_m_per_s): `r2rgate speed {first:g}`, then go on"
        )


def _merged(
    shown: Sequence[ProposalShown], unmade: Sequence[tuple[int, Past]], measured: Mapping[str, Convergence]
) -> list[Past]:
    past = [past_of(one) for one in shown]
    for at, one in enumerate(past):
        if found := measured.get(one.proposal):
            past[at] = replace(one, converged=found.settled, follows=found.follows, why=found.text)
    for before, (at, one) in enumerate(unmade):
        past.insert(at + before, one)
    return past
