"""From the samples of a period to the torque that is applied: engage, ask, limit; unloading at the end of a stop."""

from collections.abc import Callable
from typing import Any

import numpy as np

from gateway.control.law import Law, Measured
from gateway.core.line import Line
from gateway.core.signals import BoolArray, FloatArray
from gateway.loop.setpoints import Setpoints
from safety.actions import Action, Finding, found
from safety.envelope import check_torque, limit_torque
from safety.limits import EnvelopeLimits

Limit = Callable[[FloatArray], FloatArray]


class LawFailed(Exception):
    """The control law gave what must not be applied."""

    def __init__(self, finding: Finding) -> None:
        super().__init__(finding.text)
        self.finding = finding


class TorquePath:
    """A law, its state, and the drives that it has lost."""

    def __init__(self, law: Law[Any], limits: EnvelopeLimits, line: Line) -> None:
        self.law = law
        self.lost: BoolArray = np.zeros(law.n, dtype=np.bool_)  #: drives that left by themselves: off until armed
        self.held: BoolArray = np.zeros(law.n, dtype=np.bool_)  #: drives that may not follow: they get `held_nm`
        self.held_nm: FloatArray = np.zeros(law.n)
        #: Tensions (n,) in N that spans without a load cell are taken to have when control takes over: none, as if
        #: at rest. Whoever begins with a line that runs says what they are.
        self.unmeasured_n: FloatArray = np.zeros(law.n)
        #: By the law in the last period that it controlled, before any limit.
        self.asked_nm: FloatArray = np.zeros(law.n)
        self.fallback = ""  #: why the law asked for something else than its own solution in this period
        self._limits = limits
        self._moves = line.moves
        self._speed_lag_s = line.control.period_s if line.plc.speed_lag_s is None else line.plc.speed_lag_s
        self._state: Any = None  #: None while the law is not engaged
        self._taking_over = False  #: from another law, while it is

    def any_lost(self) -> bool:
        """Whether a drive is lost."""
        return any(self.lost.tobytes())

    def take_over(self, law: Law[Any]) -> None:
        """`law` goes on from the next `control` on, without a jump; set-points stay where they are."""
        self.law = law
        self._taking_over = self._state is not None

    @property
    def state(self) -> Any:
        """What the law remembers; None while it is not engaged."""
        return self._state

    def disengage(self) -> None:
        """The next `control` engages anew, from what is measured then."""
        self._state = None
        self._taking_over = False
        self.unmeasured_n.fill(0.0)

    def control(
        self,
        measured: Measured,
        setpoints: Setpoints,
        applied_nm: FloatArray,
        interval_s: float,
        limit: Limit | None = None,
        mean_nm: FloatArray | None = None,
    ) -> tuple[FloatArray, bool]:
        """The torque (n,) to apply, and whether a limit cut it. Raises LawFailed, whatever the law has raised.

        `limit` is what a stage lets through of what the law asks for, and of what is held; it is no limit of the
        drive's. A law that is engaged anew begins at `mean_nm` (n,), without the noise of what was sent last; None: at
        that. `applied_nm` (n,) is that of the period before. A drive that was lost gives nothing, one that is held
        gets `held_nm`, and the law is told so: nothing winds up.
        """
        try:
            return self._control(measured, setpoints, applied_nm, interval_s, limit, mean_nm)
        except LawFailed:
            raise
        except Exception as error:
            said = f"{type(error).__name__}: {error}"
            raise LawFailed(found("law-failed", Action.TORQUE_OFF, error=said)) from error

    def _control(
        self,
        measured: Measured,
        setpoints: Setpoints,
        applied_nm: FloatArray,
        interval_s: float,
        limit: Limit | None,
        mean_nm: FloatArray | None,
    ) -> tuple[FloatArray, bool]:
        if self.any_lost():
            applied_nm = np.where(self.lost, 0.0, applied_nm)
        if self._state is None:
            setpoints.begin_at(np.where(self._limits.measured > 0, measured.tension_n, self.unmeasured_n))
        if self._state is None or self._taking_over:
            self._taking_over = False
            begun_nm = applied_nm if mean_nm is None or self._state is not None else np.where(self.lost, 0.0, mean_nm)
            self._state = self.law.engage(measured, setpoints.reference(self._speed_lag_s), begun_nm)
        decision = self.law.ask(self._state, measured, setpoints.reference(self._speed_lag_s))
        self.fallback = decision.fallback
        for finding in check_torque(decision.torque_nm):
            raise LawFailed(finding)
        self.asked_nm = decision.torque_nm
        asked_nm = self.hold(decision.torque_nm)
        if limit is not None:
            asked_nm = limit(asked_nm)
        torque_nm = limit_torque(self._limits, asked_nm, applied_nm, interval_s)
        torque_nm[self.lost] = 0.0
        self._state = self.law.commit(self._state, decision, torque_nm)
        return torque_nm, bool(np.count_nonzero(torque_nm != asked_nm))

    def hold(self, asked_nm: FloatArray) -> FloatArray:
        """`asked_nm` (n,), but of drives that may not follow what is held. Limits come after it."""
        return np.where(self.held, self.held_nm, asked_nm) if any(self.held.tobytes()) else asked_nm

    def braked(self, asked_nm: FloatArray, released: BoolArray, applied_nm: FloatArray) -> FloatArray:
        """A period's way from `applied_nm` (n,) to a braking torque; to zero for what is `released` (n,)."""
        torque_nm = limit_torque(self._limits, asked_nm, applied_nm, self._limits.period_s)
        return np.where(released | self.lost, self.unload(applied_nm), torque_nm)

    def unload(self, applied_nm: FloatArray) -> FloatArray:
        """A period's way from `applied_nm` (n,) to zero."""
        reach = self._moves.torque_off_rate_nm_per_s * self._limits.period_s
        torque_nm = np.sign(applied_nm) * np.maximum(np.abs(applied_nm) - reach, 0.0)
        torque_nm[self.lost] = 0.0
        return torque_nm
