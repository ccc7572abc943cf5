"""A scenario: where a line stands, what changes, how long it is watched. The two of the paper, and those in files.

A file is TOML:

    name = "grade-change"
    tension_n = [30.0, 30.0]        # before the change, one per span
    speed_m_per_s = 0.05            # of the unwinder, before the change
    tension_after_n = [36.0, 30.0]  # without this key: as before
    speed_after_m_per_s = 0.05      # likewise
    change_at_s = 1.0
    duration_s = 15.0
    move_s = 0.0                    # 0: a literal step; otherwise along minimum-jerk curves that take so long
"""

from typing import Annotated, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from gateway.core.line import Limits, Name, NonNegative, Positive, Strict
from gateway.core.messages import SetSpeed, SetTension
from gateway.core.signals import FloatArray

SHORTEST_MOVE_S = 0.2  #: however small its distance


class ScenarioRefused(Exception):
    """What is wrong with a scenario; the text names every reason."""


class Scenario(Strict):
    name: Name
    title: str = ""
    description: str = ""
    tension_n: Annotated[list[Positive], Field(min_length=1, max_length=60)]  #: before the change, one per span
    speed_m_per_s: NonNegative  #: of the unwinder, before the change
    tension_after_n: list[Positive] = []  #: empty: as before
    speed_after_m_per_s: NonNegative | None = None  #: None: as before
    change_at_s: Positive = 1.0
    duration_s: Annotated[float, Field(gt=0.0, le=3600.0)] = 15.0
    move_s: NonNegative = 0.0  #: of the greatest change, along a minimum-jerk curve; 0: all steps at once

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.tension_after_n and len(self.tension_after_n) != self.n:
            raise ValueError(f"tension_after_n has {len(self.tension_after_n)} entries, tension_n {self.n}")
        if self.change_at_s + self.move_s >= self.duration_s:
            raise ValueError(f"the change is over after {self.change_at_s + self.move_s:g} s, the scenario ends before")
        if not self.changes_tension and self.speed_end_m_per_s == self.speed_m_per_s:
            raise ValueError("nothing changes: tension_after_n or speed_after_m_per_s must differ from before")
        return self

    @property
    def n(self) -> int:
        return len(self.tension_n)

    @property
    def heading(self) -> str:
        """What to call it on a page."""
        return self.title or self.name

    @property
    def tension_end_n(self) -> list[float]:
        return self.tension_after_n or self.tension_n

    @property
    def speed_end_m_per_s(self) -> float:
        return self.speed_m_per_s if self.speed_after_m_per_s is None else self.speed_after_m_per_s

    @property
    def changes_tension(self) -> bool:
        return self.tension_end_n != self.tension_n

    @property
    def tension_step_n(self) -> float:
        """The greatest change of a set-point."""
        return max(abs(after - before) for before, after in zip(self.tension_n, self.tension_end_n, strict=True))

    @property
    def speed_step_m_per_s(self) -> float:
        return abs(self.speed_end_m_per_s - self.speed_m_per_s)

    def commands(self) -> list[SetTension | SetSpeed]:
        """What an operator would say at `change_at_s`."""
        step = self.move_s == 0.0
        pairs = enumerate(zip(self.tension_n, self.tension_end_n, strict=True), start=1)
        said: list[SetTension | SetSpeed] = [
            SetTension(span=span, tension_n=after, step=step) for span, (before, after) in pairs if after != before
        ]
        if self.speed_step_m_per_s:
            said.append(SetSpeed(speed_m_per_s=self.speed_end_m_per_s, step=step))
        return said

    def setpoints_n(self, time_s: FloatArray) -> FloatArray:
        """Set-points (k, n) in N at `time_s` (k,), counted from the start of the scenario."""
        before, step = np.array(self.tension_n), np.subtract(self.tension_end_n, self.tension_n)
        return before + step * self._course(time_s, np.abs(step))

    def speeds_m_per_s(self, time_s: FloatArray) -> FloatArray:
        """Set-points (k,) of the unwinder's speed."""
        step = np.array([self.speed_end_m_per_s - self.speed_m_per_s])
        return self.speed_m_per_s + (step * self._course(time_s, np.abs(step)))[:, 0]

    def _course(self, time_s: FloatArray, size: FloatArray) -> FloatArray:
        """The share (k, m) that changes of `size` (m,) have behind them. The greatest takes `move_s`."""
        since = time_s[:, None] - self.change_at_s
        if self.move_s == 0.0 or not size.any():
            return (since >= 0.0).astype(np.float64) * np.ones_like(size)
        takes = np.maximum(self.move_s * size / size.max(), SHORTEST_MOVE_S)
        s: FloatArray = np.clip(since / takes, 0.0, 1.0)
        return s**3 * (10.0 + s * (6.0 * s - 15.0))

    def moved_over(self, move_s: float) -> "Scenario":
        """The same, along a minimum-jerk curve of so many seconds."""
        return self.model_copy(update={"move_s": move_s})

    def reasons_against(self, n: int, limits: Limits) -> list[str]:
        """Why a line of `n` spans with these limits cannot run it; empty where it can."""
        found: list[str] = []
        if self.n != n:
            found.append(f"{self.name} is for {self.n} spans, the line has {n}")
        least, most = limits.tension_min_n + limits.tension_margin_n, limits.tension_max_n - limits.tension_margin_n
        wrong = [t for t in (*self.tension_n, *self.tension_end_n) if not least <= t <= most]
        if wrong:
            named = ", ".join(f"{t:g}" for t in wrong)
            found.append(f"{self.name} has tensions of {named} N; allowed: {least:g} to {most:g} N")
        fastest = max(self.speed_m_per_s, self.speed_end_m_per_s)
        if fastest > limits.speed_max_m_per_s:
            found.append(f"{self.name} runs at {fastest:g} m/s; allowed: up to {limits.speed_max_m_per_s:g} m/s")
        if self.move_s == 0.0 and self.tension_step_n > limits.tension_step_max_n + 1e-9:
            found.append(
                f"{self.name} steps by {self.tension_step_n:g} N; allowed at once: limits.tension_step_max_n, "
                f"{limits.tension_step_max_n:g} N"
            )
        together_n = sum(abs(b - a) for a, b in zip(self.tension_n, self.tension_end_n, strict=True))
        if self.move_s == 0.0 and together_n > limits.steps_together * limits.tension_step_max_n + 1e-9:
            found.append(
                f"{self.name} steps by {together_n:g} N in all spans together; allowed at once: limits.steps_together "
                f"times limits.tension_step_max_n, {limits.steps_together * limits.tension_step_max_n:g} N"
            )
        if self.move_s == 0.0 and self.speed_step_m_per_s > limits.speed_step_max_m_per_s + 1e-9:
            found.append(
                f"{self.name} steps by {self.speed_step_m_per_s:g} m/s; allowed at once: "
                f"limits.speed_step_max_m_per_s, {limits.speed_step_max_m_per_s:g} m/s"
            )
        return found


TENSION = Scenario(
    name="tension",
    title="Tension case",
    description="Six spans at 28/36/20/40/24/32 N and 0.01 m/s; span 3 steps from 20 to 44 N at 1 s.",
    tension_n=[28.0, 36.0, 20.0, 40.0, 24.0, 32.0],
    speed_m_per_s=0.01,
    tension_after_n=[28.0, 36.0, 44.0, 40.0, 24.0, 32.0],
)
VELOCITY = Scenario(
    name="velocity",
    title="Velocity case",
    description="All spans at 30 N; the unwinder steps from 0.01 to 0.10 m/s at 1 s.",
    tension_n=[30.0] * 6,
    speed_m_per_s=0.01,
    speed_after_m_per_s=0.10,
)
PAPER = (TENSION, VELOCITY)  #: sections 4.2 and 4.3


def scenario_of(document: dict[str, object]) -> Scenario:
    """The scenario of a parsed file. Raises ScenarioRefused with every reason."""
    try:
        return Scenario.model_validate(document)
    except ValidationError as error:
        reasons = (
            f"{'.'.join(map(str, e['loc']))}: {e['msg']}" if e["loc"] else e["msg"].removeprefix("Value error, ")
            for e in error.errors()
        )
        raise ScenarioRefused("; ".join(reasons)) from error
