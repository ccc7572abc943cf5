"""One drive pulls at standstill, as long as it takes to see what answers; then it gives way, without a fling.

The torque comes on a cosine. Which way the drive's own speed counts for a torque is not known at first: from when its
roller has moved by more than noise explains, its speed is limited, and damped, by that; before, nothing feeds back.
"""

from dataclasses import dataclass, replace
from enum import Enum
from math import cos, inf, pi

import numpy as np

from gateway.core.signals import BoolArray, FloatArray
from safety.proving import ENOUGH, ZERO_S, Noise, ProvingLimits, Pull, factor_of

FILTER_SHARE = 0.25  #: by which a filtered value follows a sample
SWING_SHARE = 0.15  #: of a ramp: time constant with which what load cells show at the end is taken, whatever swings
FELT_AT = 1.0 / 3.0  #: of a ramp, a quarter of the torque: no more before anything has been felt of it
FELT_NOISE = 5.0  #: times a load cell's noise: it has felt something
NOISE_LEFT = 0.38  #: of an encoder's noise, behind the filter
LIMIT_NOISE = 0.2  #: of w, that noise may make of the speed that is limited
LIMIT_S = 0.5  #: the slowest filter for it
LIMIT_CLEAR = 4.0  #: times what is left of the noise: no lower limit can be told
BLIND_SHARE = 0.5  #: of the torque, where an encoder's noise hides the speed that a web may be caught at
BLIND_RAMPS = 4.0  #: and there times as long
QUIET_SHARE = 0.1  #: of the torque, that an encoder's noise may make of it
CLEAR = 3.0  #: times what its way was at rest: it has moved
PULLS_SHARE = 0.2  #: of the torque: from there on the way says which sign its speed has
AIM_SHARE = 0.8  #: of the speed limit
STANDS_SHARE = 0.1  #: of the speed that its torque could drive it at, or of w: held
WINDOWS, WINDOWS_A_RAMP, WINDOWS_SLACK = 24, 8, 6  #: kept at most, in a ramp, and of a web that is slack
SLOWER = 0.6  #: of the greatest speed: a roller that the web begins to hold
HOLDS = 3.0  #: times as long as a hold, until a pull has shown what it can
SLOW_SHARE = 0.2  #: of w: slower, a roller on its way is not waited for
PASSES_SHARE = 0.5  #: of what counts as an answer: what falls below was none
CELL_NOISE = 8.0  #: times its noise: a load cell that shows so much has answered
TOLD = 0.6  #: of the spread with which a factor is told: it is not waited for any longer
FULL_N_SHARE = 0.3  #: of the tension that the torque explains: below, a factor is not looked at


def quiet_gain(limits: ProvingLimits, noise: Noise, i: int, gain: FloatArray, left: float = NOISE_LEFT) -> float:
    """Of a speed's feedback, as far as the encoder of drive `i` (from 0) lets it; `left` of its noise comes through."""
    noise_m_per_s = left * float(noise.speed_m_per_s[i])
    most_nm = QUIET_SHARE * float(limits.torque_nm[i])
    return float(gain[i]) if noise_m_per_s * gain[i] <= most_nm else most_nm / noise_m_per_s


def noise_left(share: float) -> float:
    """Of white noise, behind a filter that follows a sample by `share`."""
    return (share / (2.0 - share)) ** 0.5


def limit_share(limits: ProvingLimits, noise: Noise, i: int) -> float:
    """By which the speed that is limited follows a sample: slowly where the encoder of drive `i` (from 0) shakes."""
    wanted = LIMIT_NOISE * limits.speed_m_per_s / max(float(noise.speed_m_per_s[i]), 1e-12)
    return min(FILTER_SHARE, max(limits.period_s / LIMIT_S, 2.0 * wanted**2 / (1.0 + wanted**2)))


def is_blind(limits: ProvingLimits, noise: Noise) -> BoolArray:
    """Where the noise of an encoder hides the speed that a web may be caught at, (n,)."""
    blind: BoolArray = 2.0 * NOISE_LEFT * noise.speed_m_per_s > limits.speed_m_per_s
    return blind


def slowed_where_blind(limits: ProvingLimits, noise: Noise) -> ProvingLimits:
    """There nothing damps a web: what moves it has to move it so slowly that it does not swing."""
    return replace(limits, ramp_s=np.where(is_blind(limits, noise), BLIND_RAMPS, 1.0) * limits.ramp_s)


def longest_pull_s(limits: ProvingLimits, i: int, reach_m: float) -> float:
    """What a pull of drive `i` (from 0) over so much way may take, from where the one before may have gone."""
    way_s = 2.0 * reach_m / (SLOW_SHARE * limits.speed_m_per_s)
    return float(limits.ramp_s[i] + HOLDS * limits.hold_s[i]) + way_s


class End(Enum):
    """How a pull ended."""

    ANSWERED = "load cells have shown it"
    HELD = "the roller stands under full torque, and no load cell shows it"
    STUCK = "the roller does not move"
    AWAY = "it has gone as far as it may"


@dataclass(slots=True)
class Ways:
    """Of one roller. Of a way as its drive shows it."""

    way_m: float = 0.0
    speed_m_per_s: float = 0.0  #: filtered
    sign: int = 0  #: of the speed that is shown, for a torque above 0


class PullRun:
    """Of drive `i` (from 0), in `direction` of its torque command. Tensions are less the zeros."""

    def __init__(
        self, limits: ProvingLimits, noise: Noise, i: int, direction: int, reach_m: float, before: Ways,
        longest_s: float = inf,
    ) -> None:  # fmt: skip
        """`before`: what earlier pulls of this drive have shown; its way goes on from there."""
        self.i, self.direction, self.reach_m, self.ways = i, direction, reach_m, before
        self._longest_s = min(longest_s, longest_pull_s(limits, i, reach_m))
        self.end: End | None = None
        self.start_n: FloatArray | None = None
        self.end_n: FloatArray = np.zeros(len(limits.torque_nm))
        self._most_nm = 0.0
        self.torque_nm = 0.0  #: in `direction`
        self._shown_n = self.end_n
        self._end_share = min(FILTER_SHARE, limits.period_s / (SWING_SHARE * float(limits.ramp_s[i])))
        self._limits, self._noise = limits, noise
        noise_n = noise.tension_n[limits.measured]
        self._answers_n = np.maximum(limits.tension_n[i] / 5.0, CELL_NOISE * noise_n)
        self._felt, self._feels_n = False, np.maximum(limits.tension_n[i] / 20.0, FELT_NOISE * noise_n)
        self._feeling_s = 0.0
        self._progress = self._integral = self._time_s = 0.0
        self._tight_s: float | None = None
        self._below_s = 0.0  #: for which load cells have shown less than an answer
        self._over = self._late_m_per_s = self._fastest_m_per_s = 0.0
        self._anchor = (0.0, 0.0)  #: time and way, from which on it may have stood
        self._windows: list[FloatArray] = []
        self._window_s = max(3.0 * limits.period_s, float(limits.ramp_s[i]) / WINDOWS_A_RAMP)
        self._sums = np.zeros(5 + len(limits.torque_nm))
        self._window_speed = self._drift_m_per_s = before.speed_m_per_s
        self._begin_m = before.way_m
        stands = AIM_SHARE * limits.speed_m_per_s
        self._limit_share = limit_share(limits, noise, i)
        self._limited_m_per_s = before.speed_m_per_s  #: as shown, as slowly as its noise asks for
        left, filter_s = noise_left(self._limit_share), limits.period_s / self._limit_share
        # With the lag of the drives J/(R t) and T/(4 t) for t; where the filter is slower, with twice the filter's.
        slower = max(1.0, 2.0 * filter_s / limits.lag_s) if self._limit_share < FILTER_SHARE else 1.0
        self._reset_share = limits.reset_share / slower
        # No more of an encoder's noise comes into the torque than it stands.
        self._gain = quiet_gain(limits, noise, i, limits.speed_gain / slower, left)
        self._damping = quiet_gain(limits, noise, i, limits.damping)
        self._share = BLIND_SHARE if is_blind(limits, noise)[i] else 1.0
        self._speed_m_per_s = max(limits.speed_m_per_s, LIMIT_CLEAR * left * float(noise.speed_m_per_s[i]))
        self._slow_m_per_s = STANDS_SHARE * min(stands, float(limits.torque_nm[i] / limits.prior[i, 1]))
        self._moves_m_per_s = 3.0 * NOISE_LEFT * float(noise.speed_m_per_s[i]) + 1e-12

    @property
    def forward_m_per_s(self) -> float:
        """Speed in the direction of the torque, as far as that is known."""
        return self.ways.sign * self.direction * self.ways.speed_m_per_s

    @property
    def forward_m(self) -> float:
        return self.ways.sign * self.direction * self.ways.way_m

    def risen_n(self) -> FloatArray:
        """By how much more each load cell (n,) shows, either way, than when it began."""
        return np.abs(self.end_n) - np.abs(self.end_n if self.start_n is None else self.start_n)

    def step(self, tension_n: FloatArray, speed_m_per_s: float) -> float:
        """The torque command (Nm) of a period; `end` tells when it is over."""
        limits = self._limits
        if self.start_n is None:
            self.start_n, self.end_n, self._shown_n = tension_n.copy(), tension_n.copy(), tension_n.copy()
        self._time_s += limits.period_s
        self.end_n += self._end_share * (tension_n - self.end_n)
        self._shown_n += FILTER_SHARE * (tension_n - self._shown_n)
        self._note(tension_n, speed_m_per_s)
        self._learn_sign()
        self.torque_nm = self._torque()
        self._look(tension_n)
        self._most_nm = max(self._most_nm, self.torque_nm)
        self._integral += self._reset_share * (self.torque_nm - self._integral)
        return self.direction * self.torque_nm

    def _learn_sign(self) -> None:
        """From the way since this pull began; as long as it goes on, for noise may have been the first to be clear."""
        # A web that gives way after the pull before may move it still: that says nothing.
        drift_m = self._drift_m_per_s * self._time_s
        moved_m = self.ways.way_m - self._begin_m - drift_m
        clear_m = CLEAR * float(self._noise.way_m[self.i]) * max(1.0, self._time_s / ZERO_S) ** 0.5 + abs(drift_m)
        pulls = self.torque_nm >= PULLS_SHARE * float(self._limits.torque_nm[self.i])
        if abs(moved_m) > clear_m and pulls:
            self.ways.sign = self.direction if moved_m > 0.0 else -self.direction

    def _torque(self) -> float:
        limits, i = self._limits, self.i
        most = float(limits.torque_nm[i]) * self._share
        ramp = most * 0.5 * (1.0 - cos(pi * self._progress))
        asked = ramp - self._damping * self.forward_m_per_s
        reach = AIM_SHARE * self._speed_m_per_s - self.ways.sign * self.direction * self._limited_m_per_s
        limited = min(asked, self._integral + self._gain * reach) if self.ways.sign else asked
        if self._feels():
            self._feeling_s += limits.period_s
        elif self._over == 0.0 and (limited >= 0.9 * asked or self.ways.sign == 0):
            self._progress = min(1.0, self._progress + limits.period_s / float(limits.ramp_s[i]))
        return min(max(limited, -most), most)

    def _feels(self) -> bool:
        """Whether it waits, under a little torque, for a load cell to answer or its roller to move."""
        nothing = not self._felt and self.ways.sign == 0 and self._progress >= FELT_AT
        return nothing and self._feeling_s < float(self._limits.hold_s[self.i])

    def _note(self, tension_n: FloatArray, speed_m_per_s: float) -> None:
        period_s, sums, ways = self._limits.period_s, self._sums, self.ways
        ways.way_m += period_s * speed_m_per_s
        ways.speed_m_per_s += FILTER_SHARE * (speed_m_per_s - ways.speed_m_per_s)
        self._limited_m_per_s += self._limit_share * (speed_m_per_s - self._limited_m_per_s)
        sums[0] += period_s * self.torque_nm  # that of the period before: it acted until now
        sums[1] += period_s
        sums[2] += period_s * speed_m_per_s
        sums[4] += period_s * min(max(self.ways.speed_m_per_s / self._moves_m_per_s, -1.0), 1.0)
        sums[5:] += period_s * tension_n
        if sums[1] >= self._window_s:
            sums[3] = self.ways.speed_m_per_s - self._window_speed
            self._window_speed = self.ways.speed_m_per_s
            self._windows.append(sums.copy())
            sums.fill(0.0)
            self._keep_few()

    def give_way(self, tension_n: FloatArray, speed_m_per_s: float, torque_nm: float) -> None:
        """A period after its end, until the web is slack again; `torque_nm` is what is commanded from now on."""
        self._note(tension_n, speed_m_per_s)
        self.torque_nm = self.direction * torque_nm

    def _keep_few(self) -> None:
        """Of a web that is slack the latest windows; of one that is tight all, and they become longer."""
        windows = self._windows
        if self._tight_s is None:
            del windows[:-WINDOWS_SLACK]
        elif len(windows) >= WINDOWS:
            self._windows = [one + other for one, other in zip(windows[::2], windows[1::2], strict=False)]
            self._window_s *= 2.0

    def _look(self, tension_n: FloatArray) -> None:
        """Whether it has shown what it can."""
        limits = self._limits
        shown = np.where(limits.measured, np.abs(tension_n), 0.0)
        self._over = self._over + 1.0 if (shown >= limits.tension_max_n).any() else 0.0
        begun_n = np.abs(self._shown_n if self.start_n is None else self.start_n)
        risen = (np.abs(self._shown_n) - begun_n)[limits.measured]
        self._felt = self._felt or bool((risen >= self._feels_n).any())
        if self._tight_s is None and (risen >= self._answers_n).any():
            self._tight_s = self._time_s
        below = (risen < PASSES_SHARE * self._answers_n).all()
        self._below_s = self._below_s + limits.period_s if below else 0.0
        if self._below_s >= float(limits.ramp_s[self.i]):  # longer than a web swings
            self._tight_s = None  # slack that ended with a jerk, in a web that goes along
        self._late_m_per_s += self._end_share * (self.ways.speed_m_per_s - self._late_m_per_s)
        self._fastest_m_per_s = max(self._fastest_m_per_s, abs(self._late_m_per_s))
        stands = self._stands()
        pulls = self._most_nm >= PULLS_SHARE * float(limits.torque_nm[self.i])
        if self._over >= 2.0 and pulls:  # else it is what the pull before has left, which goes
            self.end = End.ANSWERED
        elif self.ways.sign and self.forward_m >= self.reach_m:
            self.end = End.AWAY
        elif self._tight_s is not None and (self._is_told() or self._is_held(self._time_s - self._tight_s)):
            self.end = End.ANSWERED
        elif self._tight_s is None and stands:
            self.end = End.HELD if self.ways.sign else End.STUCK
        elif self._time_s >= self._longest_s:
            answered = End.ANSWERED if self._tight_s is not None else End.STUCK
            self.end = End.AWAY if self.ways.sign else answered

    def _stands(self) -> bool:
        """Whether full torque has not moved it for as long as a pull is held."""
        since_s, from_m = self._anchor
        elapsed_s, hold_s = self._time_s - since_s, float(self._limits.hold_s[self.i])
        if self._progress < 1.0:
            self._anchor = (self._time_s, self.ways.way_m)
            return False
        if elapsed_s < hold_s:
            return False
        noise_m = 3.0 * float(self._noise.speed_m_per_s[self.i]) * (self._limits.period_s * elapsed_s) ** 0.5
        stands = abs(self.ways.way_m - from_m) <= max(self._slow_m_per_s * elapsed_s, noise_m)
        self._anchor = (self._time_s, self.ways.way_m)
        return stands

    def _is_held(self, tight_s: float) -> bool:
        """Whether the web has had its time, and slows the roller: what only drags others along goes on as before."""
        slower = abs(self._late_m_per_s) <= SLOWER * self._fastest_m_per_s
        return slower and tight_s >= HOLDS * float(self._limits.hold_s[self.i])

    def _is_told(self) -> bool:
        """Whether the span's own load cell has told its factor."""
        limits, i = self._limits, self.i
        enough = self.risen_n()[i] >= FULL_N_SHARE * limits.tension_n[i]
        if not (limits.measured[i] and enough and self.ways.sign and self._progress >= 1.0 and self._sums[1] == 0.0):
            return False
        behind = i + 1 if i + 1 < len(self.end_n) and limits.measured[i + 1] else None
        told = factor_of(
            limits,
            self._noise,
            self.result(),
            i,
            self._shows(i),
            None if behind is None else (behind, self._shows(behind)),
        )
        return told.spread <= TOLD * ENOUGH

    def _shows(self, cell: int) -> int:
        return 1 if self.end_n[cell] > 0.0 else -1

    def result(self) -> Pull:
        """As it is now."""
        rows = np.array(self._windows) if self._windows else np.zeros((0, 5 + len(self.end_n)))
        start = self.end_n if self.start_n is None else self.start_n
        return Pull(
            drive=self.i,
            direction=self.direction if self.end in (None, End.ANSWERED, End.HELD) else 0,
            speed_sign=self.ways.sign,
            moved=self.ways.sign != 0,
            held=self.end is End.HELD,
            torque_nm=self.direction * self._most_nm,
            way_m=self.ways.way_m,
            start_n=start.copy(),
            end_n=self.end_n.copy(),
            windows=rows,
        )


class Release:
    """After a pull: its torque goes on a cosine, and its roller is damped until it stands."""

    def __init__(self, limits: ProvingLimits, noise: Noise, run: PullRun) -> None:
        self.over = False
        self._limits, self._i, self._run = limits, run.i, run
        self._from_nm = run.direction * run.torque_nm
        self._ramp_s = float(limits.ramp_s[run.i])
        noise_m_per_s = 2.0 * NOISE_LEFT * float(noise.speed_m_per_s[run.i])
        self._stands_m_per_s = max(STANDS_SHARE * limits.speed_m_per_s, noise_m_per_s)
        self._longest_s = self._ramp_s + float(limits.hold_s[run.i])
        # A web that is tight is damped best by what does not hold it; a roller that spins is to stand.
        gain = limits.speed_gain if run.end is End.AWAY else limits.damping
        self._gain = quiet_gain(limits, noise, run.i, gain)
        self._time_s = self._still_s = 0.0

    def step(self, tension_n: FloatArray, speed_m_per_s: float) -> float:
        """The torque command (Nm) of a period."""
        torque_nm = self._torque_nm()
        self._run.give_way(tension_n, speed_m_per_s, torque_nm)
        return torque_nm

    def _torque_nm(self) -> float:
        limits, ways = self._limits, self._run.ways
        self._time_s += limits.period_s
        share = min(1.0, self._time_s / self._ramp_s)
        still = abs(ways.speed_m_per_s) <= self._stands_m_per_s and share >= 1.0
        self._still_s = self._still_s + limits.period_s if still else 0.0
        if self._still_s >= 10.0 * limits.period_s or self._time_s >= self._longest_s:
            self.over = True
            return 0.0
        most = float(limits.torque_nm[self._i])
        torque = self._from_nm * 0.5 * (1.0 + cos(pi * share)) - self._gain * ways.sign * ways.speed_m_per_s
        return min(max(torque, -most), most)
