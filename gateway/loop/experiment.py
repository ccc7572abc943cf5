"""An experiment under way: which set-points come next, how far it is, and what ends it before its time. Pure.

It lies over the operator's set-points and changes none of them: once it is gone, for whatever reason, the line moves
back to them as to any other target.
"""

from collections import deque
from collections.abc import Callable

import numpy as np

from gateway.core.experiment import Experiment, course, experiment_hash, reasons_against
from gateway.core.experiment_torques import Turns, at_limit, lasting_periods
from gateway.core.line import Line
from gateway.core.signals import FloatArray, Inputs
from gateway.loop.setpoints import Setpoints
from safety.limits import EnvelopeLimits

Tell = Callable[..., None]  #: kind, text, and what goes with it by name
TOLD = 10  #: times on the way that its progress is told

NOT_JUDGED = (
    "on a line that is not simulated an experiment is judged and approved first: "
    "`r2rgate propose EXPERIMENT.json --reason TEXT`"
)


class Share:
    """How many of the last so many periods had something."""

    def __init__(self, periods: int) -> None:
        self._ring = bytearray(periods)
        self._at = 0
        self._count = 0

    def after(self, had: bool) -> float:
        """The share with this period; before there have been enough, the others count as without."""
        self._count += had - self._ring[self._at]
        self._ring[self._at] = had
        self._at = (self._at + 1) % len(self._ring)
        return self._count / len(self._ring)


class ExperimentRun:
    """An experiment from these set-points on."""

    def __init__(self, experiment: Experiment, setpoints: Setpoints, limits: EnvelopeLimits) -> None:
        period_s, base_n = limits.period_s, setpoints.tension_n.copy()
        window = max(1, round(experiment.abort.window_s / period_s))
        self.experiment = experiment
        self.hash = experiment_hash(experiment)
        self.periods = experiment.periods(period_s)
        self.done = 0  #: periods in which its set-points have been followed
        self.begin_s: float | None = None  #: when its first period was due, as that period's frame has it
        self._base_n = base_n
        self._course = course(experiment, base_n, setpoints.speed_target_m_per_s, period_s)
        self._limits = limits
        lasting = lasting_periods(period_s)
        self._reach_nm = lasting * limits.torque_rate_nm_per_s * period_s
        self._torque_nm: deque[FloatArray] = deque(maxlen=lasting)  #: of the periods before
        self._turns: Turns | None = None
        self._saturated, self._reversed = Share(window), Share(window)
        self._tell_at = [-(-self.periods * part // TOLD) for part in range(1, TOLD)]

    def advance(self, setpoints: Setpoints) -> float:
        """Put the tension set-points of this period in place. Returns the speed in m/s that the line goes to."""
        tension_n, speed_m_per_s = next(self._course)
        setpoints.excite(tension_n)
        self.done += 1
        return speed_m_per_s

    def against(self, inputs: Inputs, torque_nm: FloatArray, held: int) -> str:
        """Why it must not go on after this period; empty: it may. `torque_nm` (n,) is what was applied in it."""
        abort = self.experiment.abort
        if held > abort.held_periods:
            return f"{held} periods without a usable signal, allowed: {abort.held_periods}"
        if held:
            return ""
        away_n = np.abs(inputs.tension.value - self._base_n)
        beyond = ~(away_n <= abort.deviation_n)  # where it is no number, too
        if np.count_nonzero(beyond):  # a span without a load cell never told anything: it is not missed
            beyond &= (self._limits.measured > 0.0) | ~np.isnan(away_n)
        if np.count_nonzero(beyond):
            i = int(np.argmax(np.where(beyond, away_n, -np.inf)))  # what is no number goes first
            return (
                f"the tension of span {i + 1} is {away_n[i]:.1f} N away from {self._base_n[i]:g} N, "
                f"allowed: {abort.deviation_n:g} N"
            )
        saturated, turned = self._seen(torque_nm)
        if self._saturated.after(saturated) > abort.saturated_share:
            return _share_text("a torque was at a limit", abort.saturated_share, abort.window_s)
        if self._reversed.after(turned) > abort.reversal_share:
            return _share_text(f"a torque reversed by {abort.reversal_nm:g} Nm", abort.reversal_share, abort.window_s)
        return ""

    def progress(self) -> str:
        """What to tell after this period; mostly nothing."""
        if not self._tell_at or self.done < self._tell_at[0]:
            return ""
        self._tell_at.pop(0)
        return f"experiment {self.experiment.name}: {100 * self.done // self.periods} %"

    def _seen(self, torque_nm: FloatArray) -> tuple[bool, bool]:
        """Whether a torque is at a limit, and whether one has turned round in this period."""
        if self._turns is None:
            self._turns = Turns(torque_nm, self.experiment.abort.reversal_nm)
            self._torque_nm.append(torque_nm)
            return False, False
        # Before there are enough, the first stands for those that were not seen.
        saturated = at_limit(torque_nm, self._torque_nm[0], self._limits.torque_nm, self._reach_nm)
        self._torque_nm.append(torque_nm)
        return any(saturated.tobytes()), any(self._turns.after(torque_nm).tobytes())


class Experiments:
    """Of a loop: at most one at a time."""

    def __init__(
        self,
        setpoints: Setpoints,
        limits: EnvelopeLimits,
        clock: Callable[[], float],
        tell: Tell | None,
        *,
        simulated: bool,
    ) -> None:
        self.run: ExperimentRun | None = None
        self._setpoints = setpoints
        self._limits = limits
        self._clock = clock
        self._tell = tell
        self._simulated = simulated  #: the line is, for certain

    def why_not(self, experiment: Experiment, line: Line, *, judged: bool) -> list[str]:
        """What speaks against running it now, on a line that runs. `judged`: it was, and a person has approved it."""
        if not judged and not self._simulated:
            return [NOT_JUDGED]
        if not self._setpoints.at_rest():
            return ["set-points are still on their way: wait until they stand"]
        return reasons_against(experiment, line, self._setpoints.tension_n, self._setpoints.speed_target_m_per_s)

    def begin(self, experiment: Experiment) -> None:
        """With the next period. Between two periods only, in RUN, on set-points that stand."""
        run = self.run = ExperimentRun(experiment, self._setpoints, self._limits)
        text = f"experiment {experiment.name} begins: {experiment.duration_s:g} s"
        self._say("experiment", text, run, experiment=experiment.model_dump(mode="json"))

    def end(self, reason: str = "") -> None:
        """Set-points go back to their targets. `reason`: why before its time; empty: it is complete."""
        run, self.run = self.run, None
        if run is None:
            return
        now_s = self._clock()
        self._setpoints.settle(now_s)
        how = f"aborted: {reason}" if reason else "complete"
        text = f"experiment {run.experiment.name} {how}; set-points go back to where they stood"
        kind = "experiment-abort" if reason else "experiment-end"
        self._say(kind, text, run, begin_s=run.begin_s, end_s=now_s, reason=reason)

    def look(self, inputs: Inputs, torque_nm: FloatArray, held: int, due_s: float) -> None:
        """After a period: an experiment that is under way goes on, is complete, or must end."""
        run = self.run
        if run is None:
            return
        if run.begin_s is None:
            run.begin_s = due_s
        if reason := run.against(inputs, torque_nm, held):
            self.end(reason)
        elif run.done == run.periods:
            self.end()
        elif text := run.progress():
            self._say("experiment-progress", text, run)

    def _say(self, kind: str, text: str, run: ExperimentRun, **data: object) -> None:
        if self._tell is not None:
            self._tell(kind, text, hash=run.hash, done=run.done, periods=run.periods, **data)


def _share_text(what: str, share: float, window_s: float) -> str:
    return f"{what} in more than {share:.0%} of the periods of {window_s:g} s"
