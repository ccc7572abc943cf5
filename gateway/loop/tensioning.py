"""The stage between enabling and production: slack is taken up slowly, then the law brings the web to its tensions.

No law is engaged on a web that hangs: it would ask for whatever its tension error makes of it, and remember that. While
a span shows no tension its roller turns at a small speed instead; once it does, the roller keeps the upstream one's
speed and brings the span to a share of its set-point. When every span carries that and nothing moves, the law takes
over, without a jump. From the first period to the last, what is sent keeps the stage's own limits
(`safety.tensioning`).
"""

from collections.abc import Callable
from math import inf

import numpy as np

from gateway.core.line import Line, Moves
from gateway.core.line_scales import line_scales
from gateway.core.signals import BoolArray, CountArray, FloatArray, Inputs
from gateway.core.states import Phase
from gateway.core.tension_estimate import balance_of
from gateway.core.theta import expected_noise
from safety.actions import Finding
from safety.tensioning import (
    AIM_SHARE,
    CARRIES,
    TensioningState,
    begin_tensioning,
    delay_s,
    lag_s,
    limit_tensioning_torque,
    note_sent,
    taken_up_m,
    taking_up_s,
    tensioning_limits,
    watch_spans,
)

TIGHT = 0.5  #: of the tension to which slack is taken up: a span that shows it is not slack
SETTLED_MOMENTS = 5.0  #: for so long no span has been slack when the law takes over
WAITS = 0.95  #: of the speed aimed at
STALLED = 0.4  #: of the speed aimed at: a roller that is pulled and is slower is held by its web
STALLED_LAGS = 8.0  #: for so long, in time constants of the roller's speed: twice what its torque takes to come
STALLED_SWINGS = 3.0  #: and in sqrt(m/k): at least what the gentle pull takes to move a heavy roller
WEB_LAGS = 2.0  #: time constant of a span's tension, in time constants of the roller's speed
STIFF = 0.7  #: resonance times delay, in rad, from which on a tight web takes a roller a smaller gain
RATE_SHARE = 0.9  #: of the speed aimed at, that ramps of all set-points together ask of the last roller
DRAW_RATE_SHARE = 0.45  #: the same where draws are trimmed, which takes the other half

_STAGE = (Phase.TENSIONING, Phase.SLOWING)


class TensioningStage:
    """`taking_up`: the law is not engaged yet."""

    def __init__(self, line: Line, speed_steps_m_per_s: FloatArray) -> None:
        """`speed_steps_m_per_s` (n,) is what a count of each drive's speed is worth."""
        self.limits = limits = tensioning_limits(line)
        self.taking_up = False
        self._on = False
        self._state = TensioningState()
        self._aim_m_per_s = AIM_SHARE * limits.speed_m_per_s
        self._speed: FloatArray = np.zeros(line.n)  #: of the rollers, without the noise of their encoders
        shown_m_per_s = max(expected_noise(line).speed_m_per_s, float(speed_steps_m_per_s.max()))
        self._shakes = shown_m_per_s > (1.0 - WAITS) * self._aim_m_per_s
        self._speed_share = min(1.0, line.control.period_s / lag_s(line)) if self._shakes else 1.0
        self._settled = 0
        self._settled_periods = line_scales(line).periods(SETTLED_MOMENTS)
        #: Periods in a row in which a roller of a span without a load cell was pulled, and stood.
        self._held: CountArray = np.zeros(line.n, np.int64)
        self._stalled: BoolArray = np.zeros(line.n, np.bool_)  #: of spans without a load cell: the web holds the roller
        stiffness, tolerance = line.web.stiffness_n.value, line.web.stiffness_n.tolerance
        lengths = np.array([span.length_m.value for span in line.spans])
        shortest = np.array([span.length_m.value * (1.0 - span.length_m.tolerance) for span in line.spans])
        #: Speed per missing tension, at which a span's tension comes with its time constant or slower.
        self._closing: FloatArray = shortest / (stiffness * (1.0 + tolerance) * WEB_LAGS * lag_s(line))
        period_s = line.control.period_s
        mass = np.array([r.inertia_kg_m2.value / r.radius_m.value**2 for r in line.rollers])
        phase = np.sqrt(stiffness / lengths / mass) * delay_s(line) / STIFF
        swing_s = float(np.sqrt(mass * lengths / stiffness).max())
        self._stalled_periods = max(1, round(max(STALLED_LAGS * lag_s(line), STALLED_SWINGS * swing_s) / period_s))
        self._gain_tight: FloatArray = limits.speed_gain / np.maximum(1.0, phase**2)
        self._speed_per_rate: FloatArray = lengths / stiffness  #: of a roller, as its span's set-point moves
        self._rate_share = DRAW_RATE_SHARE if balance_of(line).estimated.any() else RATE_SHARE
        self._moving, self._moves = b"", line.moves  #: spans whose set-points move, and how fast they do then

    def applies(self, phase: Phase) -> bool:
        """Whether what is sent keeps the stage's limits now: from its beginning until the line runs, or torque is off.

        A stop on the way changes nothing in that.
        """
        self._on = phase in _STAGE and (self._on or phase is Phase.TENSIONING)
        return self._on

    def begin(self, inputs: Inputs) -> None:
        """The drives have taken over."""
        begin_tensioning(self._state, inputs)
        self.taking_up = True
        self._speed = inputs.speed.value.copy()
        self._settled = 0
        self._held[:] = 0
        self._stalled[:] = False

    def moves(self, moves: Moves, setpoint_n: FloatArray, target_n: FloatArray) -> Moves:
        """How set-points move while the web is being tensioned: no faster than its rollers may turn.

        The last roller turns by what all spans that still move take together.
        """
        moving = setpoint_n != target_n
        key = moving.tobytes()
        if key != self._moving or self._moves.shape != moves.shape:
            speed_per_rate = float(self._speed_per_rate[moving].sum())
            most = self._rate_share * self._aim_m_per_s / speed_per_rate if speed_per_rate > 0.0 else inf
            rate = min(moves.tension_rate_n_per_s, most)
            self._moving, self._moves = key, moves.model_copy(update={"tension_rate_n_per_s": rate})
        return self._moves

    def watch(self, inputs: Inputs, target_n: FloatArray) -> list[Finding]:
        """Once a period: the spans that do not answer. `target_n` (n,) is what tensioning leads to."""
        self._speed += self._speed_share * (inputs.speed.value - self._speed)
        return watch_spans(self.limits, self._state, inputs, target_n) if self._state.way_m.size else []

    def taking_up_s(self) -> float:
        """What the web that has been taken up so far may have taken, at half of the greatest speed."""
        return taking_up_s(self.limits, taken_up_m(self._state)) if self._state.way_m.size else 0.0

    def take_up(
        self,
        inputs: Inputs,
        target_n: FloatArray,
        least_n: FloatArray,
        hold: Callable[[FloatArray], FloatArray],
        *,
        stopping: bool,
    ) -> FloatArray:
        """The torque (n,) that takes slack up. Ends the taking up when every span carries tension and nothing moves.

        `least_n` (n,) is what tensions are for certain, of spans without a load cell as torques and speeds have it.
        `hold` keeps what is asked of drives that may not follow: nothing winds up, and the stage limits that, too.
        """
        limits, state = self.limits, self._state
        carried_n, tension_n, speed = CARRIES * target_n, inputs.tension.value, inputs.speed.value
        # Noise of what is kept between 0 and the speed aimed at would be a speed of its own.
        upstream = np.concatenate((inputs.unwind_speed.value, (self._speed if self._shakes else speed)[:-1]))
        tight = np.where(limits.measured, tension_n >= TIGHT * carried_n, self._stalled)
        self._note_settled(inputs, carried_n)
        # A roller that draws a span without a load cell has taken its slack up when it is pulled and stands.
        held = ~limits.measured & (state.sent_nm > 0.0) & (np.abs(self._speed) <= STALLED * self._aim_m_per_s)
        self._held = np.where(held, self._held + 1, 0)
        self._stalled |= self._held >= self._stalled_periods
        aim = self._aim_m_per_s
        missing_n = np.where(limits.measured, carried_n - tension_n, 0.0)
        # Never back: what one roller gives back the next one would answer to, more and more down the line.
        wanted = np.where(tight, np.minimum(np.maximum(upstream + self._closing * missing_n, 0.0), aim), aim)
        if stopping:
            wanted = np.zeros_like(wanted)
        gain = np.where(tight, self._gain_tight, limits.speed_gain)
        asked_nm = state.sent_nm + gain * (wanted - speed)
        if not limits.measured.all():
            asked_nm = np.minimum(asked_nm, self._gentle_nm(carried_n, least_n, speed))
        return self.limit(hold(asked_nm), inputs, carried_n)

    def _gentle_nm(self, carried_n: FloatArray, least_n: FloatArray, speed: FloatArray) -> FloatArray:
        """The most (n,) that a roller pulls with that no load cell would stop: nothing for a friction that holds it.

        What the span behind it carries already pulls for it.
        """
        limits = self.limits
        behind_n = np.append(least_n[1:], limits.tension_after_n)
        behind_n = np.where(behind_n > 0.0, behind_n, 0.0)  # of NaN, too
        pull_n = np.maximum(carried_n - behind_n, 0.0)
        pull_nm = limits.radius_m * pull_n + limits.share_m * carried_n + limits.friction_most * np.abs(speed)
        return np.where(limits.measured, np.inf, pull_nm)

    def _note_settled(self, inputs: Inputs, carried_n: FloatArray) -> None:
        limits = self.limits
        carried = limits.measured & (inputs.tension.value >= TIGHT * carried_n)
        settled = bool((carried | self._stalled).all())
        self._settled = self._settled + 1 if settled else 0
        # A web that is tight from the beginning needs no taking up.
        self.taking_up = self._settled < (self._settled_periods if self._state.sent_nm.any() else 1)

    def limit(self, asked_nm: FloatArray, inputs: Inputs, setpoint_n: FloatArray) -> FloatArray:
        """What of `asked_nm` (n,) the stage lets be sent, for tensions `setpoint_n` (n,) that are asked for."""
        return limit_tensioning_torque(self.limits, self._state, asked_nm, inputs, setpoint_n)

    def waits(self) -> bool:
        """Whether set-points wait: a roller turns as fast as it may, and they must not run away from the web."""
        return bool(np.count_nonzero(np.abs(self._speed) >= WAITS * self._aim_m_per_s))

    def mean_nm(self) -> FloatArray | None:
        """What was sent, without what the noise of encoders made of it; None: they are quiet."""
        return self._state.sent_nm if self._shakes else None

    def sent(self, torque_nm: FloatArray) -> None:
        """The torque (n,) of this period."""
        if self._on:
            note_sent(self.limits, self._state, torque_nm)
