"""How drives and load cells are mounted, in one place for every wire: direction, gear and sign of the line's file.

Links carry what devices say: torque and speed as the motor turns, tension as the amplifier shows it. The loop, and all
that is behind it, knows rollers and webs, positive in the direction of transport. A line on which everything is mounted
forwards pays nothing for it.
"""

import numpy as np

from gateway.core.line import Line
from gateway.core.signals import Channel, FloatArray, Inputs, Outputs


class Mounting:
    """`raw` is what links fill in."""

    def __init__(self, line: Line, inputs: Inputs) -> None:
        direction, gear, sign = np.ones(line.n), np.ones(line.n), np.ones(line.n)
        for drive in line.drives:
            direction[drive.roller - 1] = -1.0 if drive.direction == "reversed" else 1.0
            gear[drive.roller - 1] = drive.gear
        for cell in line.load_cells:
            sign[cell.span - 1] = -1.0 if cell.sign == "inverted" else 1.0
        self._direction, self._sign = direction, sign
        self._torque: FloatArray = direction * gear  #: at the roller, per motor's
        self._plain = bool((self._torque == 1.0).all() and (sign == 1.0).all())
        self._inputs = inputs
        self.raw = inputs if self._plain else Inputs(line.n)
        self._outputs = Outputs(line.n)

    def take(self) -> None:
        """What links have filled in, as the loop knows it."""
        if self._plain:
            return
        raw, inputs = self.raw, self._inputs
        _copy(raw.tension, inputs.tension, self._sign)
        _copy(raw.speed, inputs.speed, self._direction)
        _copy(raw.torque, inputs.torque, self._torque)
        _copy(raw.unwind_speed, inputs.unwind_speed, np.ones(1))
        inputs.drive_state[:], inputs.drive_condition[:] = raw.drive_state, raw.drive_condition
        inputs.drive_mode[:], inputs.drive_warning[:] = raw.drive_mode, raw.drive_warning
        inputs.power_barred[:] = raw.power_barred
        inputs.plc = raw.plc

    def given(self, outputs: Outputs) -> Outputs:
        """`outputs` as links are handed them."""
        if self._plain:
            return outputs
        given = self._outputs
        given.torque_nm = outputs.torque_nm / self._torque
        given.drive_request[:] = outputs.drive_request
        given.speed_request_m_per_s = outputs.speed_request_m_per_s
        given.run, given.warning = outputs.run, outputs.warning
        return given


def _copy(raw: Channel, channel: Channel, factor: FloatArray) -> None:
    np.multiply(raw.value, factor, out=channel.value)
    channel.time_s[:], channel.quality[:] = raw.time_s, raw.quality
