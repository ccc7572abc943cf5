"""A load-cell amplifier on Modbus: what is read of it each cycle, and which of its numbers may be believed. No I/O."""

from collections.abc import Sequence

from drivers.modbus.device import Check, Proofs, Standing, identity_check, register_block
from drivers.modbus.maps import LoadCellMap
from drivers.modbus.plan import Wish
from drivers.modbus.registers import Field, SerialNumber
from drivers.scaling import si_per_count
from gateway.core.finding import Finding, finding
from gateway.core.line import LoadCell
from gateway.core.signals import Inputs, Outputs


class Amplifier:
    """The load cells of one amplifier."""

    gives_torque = disobeys = False

    def __init__(self, device: LoadCellMap, cells: list[LoadCell]) -> None:
        self.name = ", ".join(cell.name for cell in cells)
        self._device = device
        self._cells = cells
        channels, base = device.channels, device.address_base
        self._scale = si_per_count(channels.tension.unit, channels.tension.scale)
        heads = [entry for entry in (device.status, device.sample_counter) if entry is not None]
        fields: list[Field] = [(entry.address - base, entry.type) for entry in heads]
        mask = channels.status.mask if channels.status is not None else None
        self._status_mask = mask if mask is not None else -1
        self._cells_at = len(fields)
        self._counter_at = len(fields) - 1 if device.sample_counter is not None else -1
        for cell in cells:
            start = channels.first - base + channels.stride * (cell.channel - 1)
            fields.append((start + channels.tension.offset, channels.tension.type))
            if channels.status is not None:
                fields.append((start + channels.status.offset, channels.status.type))
        self._per_cell = (len(fields) - self._cells_at) // len(cells)
        self.wish = Wish(self.name, fields, device.word_order)
        identity: list[Check] = []
        if device.device_id is not None:
            identity.append(identity_check(self.name, device.device_id, device))
        if device.channel_count is not None:
            identity.append(Check(register_block([device.channel_count], device), self._against_channel_count))
        self.proofs = Proofs(identity, serial=SerialNumber.of(device))
        self._counter: float | None = None

    def fill(self, inputs: Inputs, numbers: Sequence[float] | None, standing: Standing, time_s: float) -> list[str]:
        """The tensions into `inputs`; returns what was wrong with them. Without an answer they are missed."""
        if numbers is None:
            (self._reject if standing.doubt else self._miss)(inputs)
            return []
        if self._counter_at >= 0:
            counter, self._counter = self._counter, numbers[self._counter_at]
            if counter == self._counter:
                self._miss(inputs)
                return [f"{self.name}: the sample counter stands still"]
        if (entry := self._device.status) is not None and not entry.healthy.is_set(int(numbers[0])):
            self._reject(inputs)
            return [f"{self.name}: the amplifier is not healthy (status {int(numbers[0]):04X}h)"]
        troubles: list[str] = []
        at = self._cells_at
        for cell in self._cells:
            if trouble := self._fill_cell(inputs, time_s, cell, numbers, at):
                troubles.append(trouble)
            at += self._per_cell
        return troubles

    def _fill_cell(self, inputs: Inputs, time_s: float, cell: LoadCell, numbers: Sequence[float], at: int) -> str:
        status = self._device.channels.status
        if status is not None and (code := int(numbers[at + 1]) & self._status_mask) != status.ok:
            inputs.tension.reject(cell.span - 1)
            return f"{cell.name}: {status.texts.get(str(code), f'channel status {code}')}"
        tension_n = numbers[at] * self._scale
        if not -cell.capacity_n <= tension_n <= cell.capacity_n:  # NaN and infinity, too
            inputs.tension.reject(cell.span - 1)
            return f"{cell.name}: {tension_n:g} N is beyond its capacity of {cell.capacity_n:g} N"
        inputs.tension.put(cell.span - 1, tension_n, time_s)
        return ""

    def command(self, outputs: Outputs) -> list[int]:
        """It is read only."""
        return []

    def rest(self) -> list[int]:
        return []

    def forget(self) -> None:
        """What it measures is true whether it is commanded or not."""

    def _miss(self, inputs: Inputs) -> None:
        for cell in self._cells:
            inputs.tension.miss(cell.span - 1)

    def _reject(self, inputs: Inputs) -> None:
        for cell in self._cells:
            inputs.tension.reject(cell.span - 1)

    def _against_channel_count(self, found: float) -> list[Finding]:
        return [
            finding("channel-missing", device=cell.name, channel=cell.channel, channels=int(found))
            for cell in self._cells
            if cell.channel > found
        ]
