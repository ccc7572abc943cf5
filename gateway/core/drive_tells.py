"""What the maps of a line's drives know of their answers, as the loop needs it to judge them."""

from dataclasses import dataclass

import numpy as np

from gateway.core.signals import CountArray, FloatArray

CYCLIC_SYNCHRONOUS_TORQUE = 10  #: mode of operation (CiA 402, 6060h)
SERVO_ACCURACY = 0.01  #: of a servo drive, of its rated torque: zero and linearity of its current measurement
INVERTER_ACCURACY = 0.03  #: the same of a drive of which nothing is known: an inverter computes its torque
TORQUE_FILTER_S = 0.1
VOLTAGE_ENABLED = 4  #: bit of the statusword (CiA 402, 6041h)


@dataclass(frozen=True, slots=True)
class DriveTells:
    """Arrays (n,), element k of the drive of roller k+1."""

    torque_step_nm: FloatArray  #: what a count of the torque that it reports, or that it is asked for, is worth at most
    mode: CountArray  #: the mode of operation that it is told
    power_bit: CountArray  #: of its statusword, that says that its power stage is supplied
    torque_accuracy: FloatArray  #: of its rated torque: what it gives may be off by so much, and what it reports
    torque_filter_s: FloatArray  #: time constant by which what it reports is behind what it is asked, at most


def profile_tells(n: int) -> DriveTells:
    """Of drives that keep to the profile and report torques without steps."""
    return DriveTells(
        np.zeros(n),
        np.full(n, CYCLIC_SYNCHRONOUS_TORQUE),
        np.full(n, VOLTAGE_ENABLED),
        np.full(n, SERVO_ACCURACY),
        np.full(n, TORQUE_FILTER_S),
    )
