"""A load-cell amplifier on Modbus: what is asked of it each cycle, and which of its answers may be believed."""

from drivers.modbus.client import ModbusConnection, ModbusFailed, ModbusTimeout
from drivers.modbus.maps import LoadCellMap
from drivers.modbus.proof import Proof
from drivers.modbus.registers import Field, RegisterBlock, spans
from drivers.scaling import si_per_count
from gateway.core.line import LoadCell
from gateway.core.signals import Inputs


class Amplifier:
    """The load cells of one unit. All their channels are read in one request, or in as few as a request can span."""

    def __init__(self, device: LoadCellMap, cells: list[LoadCell]) -> None:
        self.name = ", ".join(cell.name for cell in cells)
        self.unit = cells[0].address
        self.missed = 0  #: cycles in a row without an answer
        self.unanswered = 0  #: requests in a row that ended without one
        self._device = device
        self._cells = cells
        self._function = device.read_function
        channels, base = device.channels, device.address_base
        self._scale = si_per_count(channels.tension.unit, channels.tension.scale)
        fields: list[Field] = [
            (device.status.address - base, device.status.type),
            (device.sample_counter.address - base, device.sample_counter.type),
        ]
        for cell in cells:
            start = channels.first - base + channels.stride * (cell.channel - 1)
            fields.append((start + channels.tension.offset, channels.tension.type))
            if channels.status is not None:
                fields.append((start + channels.status.offset, channels.status.type))
        self._reads = [(group, RegisterBlock([fields[k] for k in group], device.word_order)) for group in spans(fields)]
        self._fields = len(fields)
        self._per_cell = (self._fields - 2) // len(cells)
        identity = RegisterBlock([(device.device_id.address - base, device.device_id.type)], device.word_order)
        channel_count = RegisterBlock(
            [(device.channel_count.address - base, device.channel_count.type)], device.word_order
        )
        checks = [(identity, self._against_identity), (channel_count, self._against_channel_count)]
        self._proof = Proof(self.name, self.unit, self._function, checks)
        self._proof.confirm()  # `prepare` will prove it before there is torque; nobody would after a reconnection
        self.answer: list[float] | None = None  #: of this cycle
        self._counter: float | None = None

    async def exchange(self, connection: ModbusConnection, deadline_s: float) -> list[float]:
        """Ask. Raises ModbusFailed or ValueError when there is no answer that fits, or it is another device."""
        if reasons := await self._proof.go_on(connection, deadline_s):
            raise ModbusFailed("not proven: " + "; ".join(reasons))
        numbers = [0.0] * self._fields
        for group, block in self._reads:
            registers = await connection.read(self._function, self.unit, block.address, block.count, deadline_s)
            for k, number in zip(group, block.decode(registers), strict=True):
                numbers[k] = number
        return numbers

    def fill(self, inputs: Inputs, time_s: float) -> list[str]:
        """The tensions into `inputs`; returns what was wrong with them. Without an answer they are missed."""
        answer = self.answer
        if answer is None:
            self.missed += 1
            (self._miss if self._proof.complete else self._reject)(inputs)
            return []
        self.missed = 0
        counter, self._counter = self._counter, answer[1]
        if counter == answer[1]:
            self._miss(inputs)
            return [f"{self.name}: the sample counter stands still"]
        healthy = self._device.status.healthy
        if bool(int(answer[0]) >> healthy.bit & 1) == healthy.inverted:
            self._reject(inputs)
            return [f"{self.name}: the amplifier is not healthy (status {int(answer[0]):04X}h)"]
        troubles = (self._fill_cell(inputs, time_s, k, cell) for k, cell in enumerate(self._cells))
        return [trouble for trouble in troubles if trouble]

    def _fill_cell(self, inputs: Inputs, time_s: float, k: int, cell: LoadCell) -> str:
        assert self.answer is not None
        at = 2 + k * self._per_cell
        status = self._device.channels.status
        if status is not None and (code := int(self.answer[at + 1])) != status.ok:
            inputs.tension.reject(cell.span - 1)
            return f"{cell.name}: {status.texts.get(str(code), f'channel status {code}')}"
        tension_n = self.answer[at] * self._scale
        if not -cell.capacity_n <= tension_n <= cell.capacity_n:  # NaN and infinity, too
            inputs.tension.reject(cell.span - 1)
            return f"{cell.name}: {tension_n:g} N is beyond its capacity of {cell.capacity_n:g} N"
        inputs.tension.put(cell.span - 1, tension_n, time_s)
        return ""

    def _miss(self, inputs: Inputs) -> None:
        for cell in self._cells:
            inputs.tension.miss(cell.span - 1)

    def _reject(self, inputs: Inputs) -> None:
        for cell in self._cells:
            inputs.tension.reject(cell.span - 1)

    def connection_lost(self) -> None:
        """Whatever answers on the next connection has to prove itself; until then nothing of it is believed."""
        self._proof.void()

    async def prepare(self, connection: ModbusConnection, deadline_s: float) -> list[str]:
        """What speaks against the unit: another device, too few channels. Reads only."""
        self._proof.void()
        try:
            return await self._proof.go_on(connection, deadline_s)
        except ModbusTimeout as error:
            return [f"{self.name}: unit {self.unit} at {connection.where}: {error}"]

    def _against_identity(self, found: float) -> list[str]:
        wanted = self._device.device_id.value
        return [] if found == wanted else [f"{self.name}: device id {int(found):#x}, the map says {wanted:#x}"]

    def _against_channel_count(self, found: float) -> list[str]:
        return [
            f"{cell.name}: channel {cell.channel}, the amplifier has {int(found)}"
            for cell in self._cells
            if cell.channel > found
        ]
