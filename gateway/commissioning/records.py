"""What the phases write down: every attempt with its reason and its figures. Plain data, kept and sent as JSON."""

from gateway.core.line import NonNegative, Positive, Strict


class Suggestion(Strict):
    """Values of an architecture's knobs, and why."""

    values: dict[str, Positive]
    reason: str


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
    trial: Trial | None  #: None: no design came of it
    refused: str  #: why it does not count, "" where it does: not stable, a limit left, too little delay margin
    accepted: bool  #: validated, and better than everything before

    @property
    def cost_n2s(self) -> float | None:
        """J, of an attempt that counts."""
        return None if self.refused or self.trial is None else self.trial.cost_n2s
