"""What the phases write down: every attempt with its reason and its figures. Plain data, kept and sent as JSON."""

from gateway.commissioning.decisions import RULES, Decided
from gateway.core.line import NonNegative, Positive, Strict
from gateway.core.questions import Decision, Question, factors_that_turn


class DecisionRecord(Strict):
    """A question of a phase, and what was decided; of the question what a reader needs to judge that."""

    decision: Decision
    task: str
    options: dict[str, str]  #: name and title
    option: str  #: that was chosen
    factors: dict[str, Positive] = {}  #: on numbers of it; none: as they are
    by: str  #: "rules", or the agent's name
    reason: str
    usual: str  #: what the rules would choose
    why: str  #: and why
    instead: str = ""  #: why the rules have decided though somebody else was asked


def decision_record(question: Question, decided: Decided) -> DecisionRecord:
    """What was decided on `question`."""
    return DecisionRecord(
        decision=question.decision, task=question.task, options={one.id: one.title for one in question.options},
        option=decided.choice.option, factors=factors_that_turn(decided.choice), by=decided.by,
        reason=decided.choice.reason, usual=question.usual, why=question.why, instead=decided.instead,
    )  # fmt: skip


class Usual(Strict):
    """What the rules would have tried, where somebody else decides. No values: they would have ended the search."""

    values: dict[str, Positive]
    reason: str


class Suggestion(Strict):
    """Values of an architecture's knobs, and why."""

    values: dict[str, Positive]
    reason: str  #: of whoever suggests, in their words
    by: str = RULES  #: or the agent's name
    instead: str = ""  #: why the rules have decided though somebody else was asked
    usual: Usual | None = None  #: None: they have decided


class Stop(Strict):
    """Somebody other than the rules ends a search: they expect nothing better."""

    reason: str
    by: str
    usual: Usual


class Trial(Strict):
    """What became of a candidate in simulation. Tensions are those of the spans that have a load cell."""

    cost_n2s: NonNegative | None  #: J, over all plants; None: one of them ran away
    rmse_n: dict[str, NonNegative]  #: of the nominal model, by scenario
    settling_s: NonNegative | None  #: of its slowest span, without noise; None: never
    watched_s: NonNegative  #: from the change on: what counts for a span that never settles
    overshoot_pct: NonNegative  #: of its worst span, without noise
    tension_min_n: float  #: of any plant
    tension_max_n: float
    effort_n2m2s: NonNegative  #: of the nominal model, mean over the scenarios
    robustness_n: NonNegative | None  #: R: how far any plant is from the nominal course; None: one ran away
    weak: list[str]  #: where the linear loop stands too little: speeds, and plants of the box
    delay_margin_s: NonNegative
    decay_per_s: float
    chatter_nm: NonNegative
    noise_floor_n: NonNegative


class Attempt(Strict):
    """One turn of algorithm 1."""

    number: int  #: from 0
    values: dict[str, Positive]
    reason: str
    by: str = RULES  #: who suggested it: the rules, or an agent's name
    instead: str = ""  #: why the rules have, though somebody else was asked
    usual: Usual | None = None  #: what the rules would have tried; None: they have suggested it
    trial: Trial | None  #: None: no design came of it
    refused: str  #: why it does not count, "" where it does: not stable, a limit left, too little delay margin
    accepted: bool  #: validated, and better than everything before

    @property
    def cost_n2s(self) -> float | None:
        """J, of an attempt that counts."""
        return None if self.refused or self.trial is None else self.trial.cost_n2s
