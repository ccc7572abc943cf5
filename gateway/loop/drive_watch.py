"""What the loop watches of the drives: that they do what they are asked, and what they say of themselves."""

import numpy as np

from gateway.core.drive_tells import DriveTells, profile_tells
from gateway.core.finding import Finding as Coded
from gateway.core.line import Line
from gateway.core.signals import BoolArray, DriveCondition, DriveState, FloatArray, Inputs
from safety.actions import Finding
from safety.drive_feedback import FeedbackState, feedback_limits, find_unlike, found_before_torque
from safety.drive_warnings import WarningState, find_warnings, warning_limits
from safety.uncompared import UncomparedState, find_uncompared

HALF = 0.5  #: of what is asked: a drive that gives as much still brakes, and its speed says how much more it takes
_NO_TORQUE = int(DriveCondition.WRONG_MODE) | int(DriveCondition.NO_POWER)


class DriveWatch:
    """`standing` is what kept drives from being relied on when that was looked at last."""

    def __init__(self, line: Line, tells: DriveTells | None) -> None:
        self.standing: list[Finding] = []
        self._feedback_limits = feedback_limits(line, tells or profile_tells(line.n))
        self._feedback = FeedbackState(line.n)
        self._uncompared, self._compares = UncomparedState(line.n), False
        self._lost: BoolArray = np.zeros(line.n, np.bool_)
        self._warning_limits, self._warnings = warning_limits(line), WarningState(line.n)

    @property
    def blamed(self) -> BoolArray:
        """Drives (n,) that are given no torque any more, until somebody arms."""
        return self._feedback.blamed

    def powerless(self, inputs: Inputs) -> BoolArray:
        """The drives (n,) among those blamed that give less than half of what they are asked, or not by their mode.

        What is braked asks this: a drive that gives three times its torque still slows its roller down, which would
        pull the web against the others, or they against it, if it were let go.
        """
        if not any(self.blamed.tobytes()):
            return self.blamed
        asked_nm, given_nm = self._feedback.filtered_nm
        least_nm = HALF * np.abs(asked_nm) - self._feedback_limits.least_nm
        gives = given_nm * np.sign(asked_nm) >= least_nm
        return self.blamed & ~(gives & (inputs.drive_condition & _NO_TORQUE == 0))

    @property
    def suspected(self) -> BoolArray:
        """Drives (n,) whose torque command stays at `held_nm`."""
        return self._feedback.suspected

    @property
    def held_nm(self) -> FloatArray:
        """The torque (n,) of the drives that are suspected."""
        return self._feedback.held_nm

    def compare(self, inputs: Inputs, asked_nm: FloatArray, lost: BoolArray) -> list[Finding]:
        """What the drives that are not lost (n,) do otherwise than they were asked, (n,); it stops the line."""
        self._compares, self._lost = True, lost
        return find_unlike(self._feedback_limits, self._feedback, inputs, asked_nm, lost)

    def rest(self) -> None:
        """Nothing is asked of the drives that could be compared."""
        self._compares = False
        self._feedback.restart()

    @property
    def uncompared(self) -> BoolArray:
        """Drives (n,) of whose torque nothing has been heard for too long."""
        return self._uncompared.uncompared

    def any_uncompared(self) -> bool:
        """Whether what is asked of a drive is compared with nothing."""
        return any(self._uncompared.uncompared.tobytes())

    def names_of(self, which: BoolArray) -> list[str]:
        """The drives among (n,) by name, roller 1 first."""
        return [self._feedback_limits.names[i] for i in np.flatnonzero(which).tolist()]

    def find_told(self, inputs: Inputs) -> list[Finding]:
        """Warnings and limits of the drives, and whose torque is not heard; they stop nothing."""
        findings = find_warnings(self._warning_limits, self._warnings, inputs)
        if self._compares:
            findings += find_uncompared(self._feedback_limits, self._uncompared, inputs, self._lost)
        return findings

    def against(self, inputs: Inputs, wanted: DriveState) -> str:
        """Which drives are not `wanted`, or are in another mode or without power though they are; empty: all are fit.

        "drive-3 STO, drive-5 FAULT".
        """
        self.standing = []
        names, said = self._feedback_limits.names, list[str]()
        for i, state in enumerate(inputs.drive_state.tolist()):
            finding = found_before_torque(self._feedback_limits, inputs, i)
            if finding is not None and state in (DriveState.READY, DriveState.ENABLED, DriveState.OFF):
                self.standing.append(finding)
                said.append(finding.text)
            elif state != wanted:
                said.append(f"{names[i]} {DriveState(state).name}")
        return ", ".join(said)

    def standing_as_data(self) -> list[Coded]:
        """`standing`, for a reply."""
        return [finding.as_data() for finding in self.standing]

    def armed(self) -> None:
        """A person arms: everything begins anew."""
        self._feedback.forgive()
        self._uncompared.begin_anew()
        self._warnings.begin_anew()
