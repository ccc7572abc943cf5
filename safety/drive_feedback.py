"""What a drive gives, compared with what it was asked for; and what it says of its mode, its power, its limits. Pure.

Torque. What was asked and what is reported go through the same filter, so that noise does not count. A drive lags
behind: what it gives lies between the least and the greatest torque that it was asked for lately, of which the older
counts less and less (a first-order lag of up to what its map says stays inside). What lies outside by
more than a share of what was asked, and by more than the drive's numbers can tell, is counted. So is a drive that
answers the ups and downs of its command by more than it is asked for: one that gives three times as much makes its
controller restless, and in the mean of that nothing can be seen. A drive is *suspected* after a few periods: its
command is held at the mean of what was asked when doubt began, so that nothing winds up against a drive that does not
answer, nor hits the web when it answers again. It is not led to what is given: with a drive that gives a tenth, that
leads to zero, where the two agree. After `DOUBTED_S` it is *blamed*: nobody knows what it would make of its next
command, so it counts as a drive that has left by itself. Periods that agree take back half as much as those that do
not have added, so that a drive that comes and goes is found, too. While every drive gives what it was asked for last,
nothing of this is computed.

The times are those of drives and their buses. Everything else is of the line's file, the drive's map or the drive's
own noise, or has no dimension.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import exp

import numpy as np

from gateway.core.drive_tells import DriveTells
from gateway.core.line import Line
from gateway.core.signals import BoolArray, CountArray, DriveCondition, FloatArray, Inputs, Quality
from safety.actions import Action, Finding, found

FILTER_S = 0.05  #: time constant for asked and reported torque
SUSPECTED_S = 0.03  #: outside, until the command is held
DOUBTED_S = 0.3  #: the same until the drive is blamed; with filter and lag in less than a second
ASKED_SHARE = 0.3  #: of what is asked: a drive whose torque constant is off by less is a matter of tuning
DELAYS = 3  #: periods behind its command, from none on, at which a drive's answer is looked for
STEPS = 3.0  #: counts of the drive's torque
NOISE_SHARE = 3.0  #: of the noise that is left behind the filter

_WRONG_MODE, _UNCONFIRMED = int(DriveCondition.WRONG_MODE), int(DriveCondition.MODE_UNCONFIRMED)
_NO_POWER, _GOOD = int(DriveCondition.NO_POWER), int(Quality.GOOD)
_TINY = np.finfo(np.float64).tiny
_SIGNS = np.array([[1.0], [-1.0]])


@dataclass(frozen=True, slots=True)
class FeedbackLimits:
    """Arrays (n,). Shares are those of a period, of what a filter has still to go."""

    names: Sequence[str]  #: of the drives, roller 1 first
    least_nm: FloatArray  #: a difference below it cannot be told
    mode: CountArray
    power_bit: CountArray
    filter_share: float
    lag_share: FloatArray
    noise_left: float  #: of the noise of a sample, behind the filter
    lag_noise_left: FloatArray  #: the same behind the lag
    settled: int  #: periods of agreement until a drive that differed is as any other
    suspected: int  #: counts, two of a period
    doubted: int
    unheard: int  #: the same of periods without a torque that counts
    power_periods: int


def feedback_limits(line: Line, tells: DriveTells) -> FeedbackLimits:
    """What the drives of `line` may differ by."""
    period_s = line.control.period_s
    drives = sorted(line.drives, key=lambda drive: drive.roller)
    rated_nm = np.array([drive.roller_torque_nm for drive in drives])
    filter_share, lag_share = 1.0 - exp(-period_s / FILTER_S), 1.0 - np.exp(-period_s / tells.torque_filter_s)

    def periods(time_s: float) -> int:
        return max(1, round(time_s / period_s))

    return FeedbackLimits(
        names=[drive.name for drive in drives],
        least_nm=tells.torque_accuracy * rated_nm + STEPS * tells.torque_step_nm,
        mode=tells.mode,
        power_bit=tells.power_bit,
        filter_share=filter_share,
        lag_share=lag_share,
        noise_left=(filter_share / (2.0 - filter_share)) ** 0.5,
        lag_noise_left=(lag_share / (2.0 - lag_share)) ** 0.5,
        settled=periods(2.0 * float(tells.torque_filter_s.max())),
        suspected=2 * periods(SUSPECTED_S),
        doubted=2 * periods(DOUBTED_S),
        unheard=2 * line.limits.hold_periods,
        power_periods=line.limits.hold_periods,
    )


@dataclass(slots=True)
class FeedbackState:
    """Of the drives of a line with `n` rollers. Arrays (n,) unless said otherwise."""

    n: int
    differing: bool = False  #: some drive gives something else than it was asked for last: what follows is kept
    counting: bool = False  #: and some drive is doubted
    agreed: int = 0  #: periods in a row in which none differed
    asked: tuple[FloatArray, ...] = ()  #: (n,) each, in the periods before, the last one first
    delay: int = 0  #: periods behind its command, at which what is reported was found to agree last
    filtered_nm: FloatArray = field(init=False)  #: (2, n), asked and reported
    reach_nm: FloatArray = field(init=False)  #: (2, n), the greatest asked for lately, and the negative of the least
    reported_nm: FloatArray = field(init=False)  #: the last samples
    noise_nm: FloatArray = field(init=False)  #: from one sample that is reported to the next, mean absolute
    answer_nm2: FloatArray = field(init=False)  #: (DELAYS, n), mean product of what is reported and what was asked
    lately_nm: FloatArray = field(init=False)  #: (DELAYS, n), asked, the newest first
    power_nm2: FloatArray = field(init=False)  #: (DELAYS, n), mean squares of it
    given_nm2: FloatArray = field(init=False)  #: mean square of what is reported
    held_nm: FloatArray = field(init=False)  #: asked for in the mean when doubt began: commands stay there
    doubted: CountArray = field(init=False)  #: up by two in a period outside, down by one in one inside
    unpowered: CountArray = field(init=False)  #: periods in a row
    suspected: BoolArray = field(init=False)  #: their commands stay where they are
    blamed: BoolArray = field(init=False)  #: they get no torque until somebody arms

    def __post_init__(self) -> None:
        n = self.n
        self.filtered_nm, self.reach_nm = np.zeros((2, n)), np.zeros((2, n))
        self.reported_nm, self.noise_nm = np.zeros(n), np.zeros(n)
        self.answer_nm2, self.lately_nm, self.power_nm2 = np.zeros((3, DELAYS, n))
        self.held_nm, self.given_nm2 = np.zeros(n), np.zeros(n)
        self.doubted, self.unpowered = np.zeros(n, np.int64), np.zeros(n, np.int64)
        self.suspected, self.blamed = np.zeros(n, np.bool_), np.zeros(n, np.bool_)

    def begin(self, asked_nm: FloatArray) -> None:
        """Drives begin to differ that gave until now what they were asked for, (n,)."""
        self.differing, self.agreed = True, 0
        self.filtered_nm[:] = asked_nm
        np.multiply(asked_nm, _SIGNS, out=self.reach_nm)
        self.reported_nm = asked_nm
        self.noise_nm.fill(0.0)
        self.lately_nm[:] = asked_nm
        self.given_nm2 = asked_nm * asked_nm
        self.power_nm2[:] = self.answer_nm2[:] = self.given_nm2

    def restart(self) -> None:
        """The drives are not watched now: what was counted is over. Who is blamed stays so."""
        if self.asked:
            self.asked = ()
            self.differing = self.counting = False
            self.doubted.fill(0)
            self.unpowered.fill(0)
            self.suspected = np.zeros(self.n, np.bool_)

    def forgive(self) -> None:
        """A person arms: nobody is blamed any more."""
        self.restart()
        self.blamed = np.zeros(self.n, np.bool_)


def find_unlike(
    limits: FeedbackLimits, state: FeedbackState, inputs: Inputs, asked_nm: FloatArray, lost: BoolArray
) -> list[Finding]:
    """Bring `state` up to date; what stops the line. Drives that are `lost` (n,) are not judged.

    `asked_nm` (n,) is what was commanded last, before the samples in `inputs` were taken.
    """
    unlike = _unlike(limits, state, inputs, asked_nm)
    if unlike is None and not any(inputs.drive_condition.tobytes()):
        return []
    judged = ~(lost | state.blamed)
    powerless = inputs.drive_condition & _NO_POWER != 0
    state.unpowered = np.where(judged & powerless, state.unpowered + 1, 0)
    if unlike is not None:
        state.held_nm = np.where(unlike & (state.doubted == 0), state.filtered_nm[0], state.held_nm)
        counted = np.where(unlike, state.doubted + 2, np.maximum(state.doubted - 1, 0))
        state.doubted = np.where(judged, counted, 0)
    findings = [found for i in np.flatnonzero(judged).tolist() for found in _of_drive(limits, state, inputs, i)]
    state.suspected = (state.doubted >= limits.suspected) & ~state.blamed
    state.counting = bool(state.doubted.any())
    return findings


def _unlike(limits: FeedbackLimits, state: FeedbackState, inputs: Inputs, asked_nm: FloatArray) -> BoolArray | None:
    """The drives (n,) that give something else than they were asked for lately; None where all agree, and did.

    A sample that is missing says nothing.
    """
    heard = inputs.torque.good()
    agree = heard and _agree(limits, state, inputs.torque.value, asked_nm)
    before, state.asked = state.asked, (asked_nm, *state.asked[: DELAYS - 2])
    if not state.differing:
        if agree or not before:
            return None
        state.begin(before[0])
    state.agreed = state.agreed + 1 if agree else 0
    if state.agreed >= limits.settled and not state.counting:
        state.differing = False
        return None
    return _beyond(limits, state, inputs, asked_nm, heard)


def _agree(limits: FeedbackLimits, state: FeedbackState, reported_nm: FloatArray, asked_nm: FloatArray) -> bool:
    """Whether every drive gives what it was asked for, at one delay: the one at which they did last comes first."""
    for delay in (state.delay, *range(DELAYS)):
        if delay <= len(state.asked):
            then_nm = state.asked[delay - 1] if delay else asked_nm
            if not any((np.abs(reported_nm - then_nm) > limits.least_nm).tobytes()):
                state.delay = delay
                return True
    return False


def _beyond(
    limits: FeedbackLimits, state: FeedbackState, inputs: Inputs, asked_nm: FloatArray, heard: bool
) -> BoolArray:
    """The same while some differ: through the filter, against the reach of what was asked."""
    filtered, reach = state.filtered_nm, state.reach_nm
    good = inputs.torque.quality == _GOOD
    reported_nm = inputs.torque.value if heard else np.where(good, inputs.torque.value, state.reported_nm)
    filtered += limits.filter_share * (np.array((asked_nm, reported_nm)) - filtered)
    state.noise_nm += limits.filter_share * (np.abs(reported_nm - state.reported_nm) - state.noise_nm)
    state.reported_nm = reported_nm.copy()
    asked = filtered[0] * _SIGNS
    reach += limits.lag_share * (asked - reach)
    np.maximum(reach, asked, out=reach)
    beyond_nm = (filtered[1] * _SIGNS - reach).max(axis=0)
    least_nm = np.maximum(limits.least_nm, NOISE_SHARE * limits.noise_left * state.noise_nm)
    beyond = beyond_nm > np.maximum(ASKED_SHARE * reach.max(axis=0), least_nm)
    return good & (beyond | _overdone(limits, state, asked_nm, reported_nm))


def _overdone(limits: FeedbackLimits, state: FeedbackState, asked_nm: FloatArray, reported_nm: FloatArray) -> BoolArray:
    """The drives (n,) that answer what they were asked for by more than that, at whatever delay.

    Noise in what is reported has little part in the mean product, and a lag only makes that smaller.
    """
    lately, power, answer = state.lately_nm, state.power_nm2, state.answer_nm2
    lately[1:] = lately[:-1]
    lately[0] = asked_nm
    power += limits.lag_share * (lately * lately - power)
    answer += limits.lag_share * (lately * reported_nm - answer)
    state.given_nm2 += limits.lag_share * (reported_nm * reported_nm - state.given_nm2)
    explained_nm2 = (answer * answer / np.maximum(power, _TINY)).max(axis=0)
    noise_nm = np.sqrt(np.maximum(state.given_nm2 - explained_nm2, 0.0))
    least_nm = limits.least_nm + NOISE_SHARE * limits.lag_noise_left * noise_nm
    most_nm2 = power.max(axis=0)  # of a torque that grows, the newest: no delay explains more
    return np.abs(answer).max(axis=0) - (1.0 + ASKED_SHARE) * most_nm2 > least_nm * np.sqrt(most_nm2)


def _of_drive(limits: FeedbackLimits, state: FeedbackState, inputs: Inputs, i: int) -> list[Finding]:
    """What is held against one drive. The cause goes before what it leads to: without power there is no torque."""
    name = limits.names[i]
    if int(inputs.drive_condition[i]) & _WRONG_MODE:
        state.blamed[i] = True
        return [found_mode(limits, inputs, i)]
    if state.unpowered[i] >= limits.power_periods:
        state.blamed[i] = True
        return [found_no_power(limits, i)]
    if state.doubted[i] < limits.doubted:
        return []
    state.blamed[i] = True
    asked_nm, given_nm = state.filtered_nm[:, i].tolist()
    return [found("torque-not-given", Action.STOP, drive=name, asked_nm=asked_nm, given_nm=given_nm)]


def found_mode(limits: FeedbackLimits, inputs: Inputs, i: int) -> Finding:
    """That a drive is in another mode than it was told."""
    mode, wanted = int(inputs.drive_mode[i]), int(limits.mode[i])
    return found("drive-mode", Action.STOP, drive=limits.names[i], mode=mode, wanted=wanted)


def found_no_power(limits: FeedbackLimits, i: int) -> Finding:
    """That a drive says that its power stage has no supply."""
    return found("drive-no-power", Action.STOP, drive=limits.names[i], bit=int(limits.power_bit[i]))


def found_before_torque(limits: FeedbackLimits, inputs: Inputs, i: int) -> Finding | None:
    """What keeps a drive from being relied on whatever its state is; None where nothing does."""
    condition = int(inputs.drive_condition[i])
    if condition & _WRONG_MODE:
        return found_mode(limits, inputs, i)
    if condition & _NO_POWER:
        return found_no_power(limits, i)
    if condition & _UNCONFIRMED:
        return found("drive-mode-unconfirmed", Action.STOP, drive=limits.names[i], wanted=int(limits.mode[i]))
    return None
