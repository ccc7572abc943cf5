"""A load-cell amplifier on OPC UA: what is asked of it each cycle, and which of its answers may be believed. No I/O."""

from drivers.opcua.maps import LoadCellMap
from drivers.opcua.nodes import DeviceNodes, NodeTable, Reading
from drivers.opcua.proof import ANSWERS_ALLOWED, Proof, not_read
from drivers.opcua.source_time import STANDS_STILL, SourceTime
from drivers.scaling import si_per_count
from gateway.core.finding import Finding, finding
from gateway.core.line import LoadCell
from gateway.core.signals import Inputs, Outputs
from gateway.wording.catalogue import sentence

_SHARED = 2  #: readings ahead of those of the channels: health and sample counter


class Amplifier:
    """The load cells of one amplifier. Nothing is written to it."""

    def __init__(self, device: LoadCellMap, cells: list[LoadCell], table: NodeTable) -> None:
        self.name = ", ".join(cell.name for cell in cells)
        self.watchdog = None
        self.missed = ANSWERS_ALLOWED  #: cycles in a row without an answer; nothing was heard yet
        self.active = False
        self._device = device
        self._cells = cells
        nodes = DeviceNodes(table, device.namespace, cells[0].address)
        self.proof = Proof(self.name, device.identity, None, nodes)
        self.serial = nodes.serial(device.serial)  #: its node
        tension, status = device.channels.tension, device.channels.status
        self._n_per_count = si_per_count(tension.unit, tension.scale)
        entries = [tension] if status is None else [tension, status]
        self._per_cell = len(entries)
        shared = (device.healthy, device.sample_counter)
        self.reads = (  #: each cycle
            *(nodes.place(entry, entry.type) for entry in shared),
            *(nodes.place(entry, entry.type, cell.channel) for cell in cells for entry in entries),
        )
        self.prepare_reads = (*self.proof.nodes, nodes.place(device.channel_count, device.channel_count.type))
        self._counter: float | None = None
        self._sampled = {cell.name: SourceTime(device.source_time) for cell in cells}  #: tensions

    def command(self, outputs: Outputs) -> None:
        """There is nothing to say to it."""

    def take_writes(self) -> list[tuple[int, float]]:
        return []

    def on_written(self, statuses: tuple[int, ...]) -> str:
        return ""

    def activate(self) -> None:
        """`prepare` has proven it."""
        self.active = True
        self.missed = 0
        self.proof.confirm()

    def forget(self) -> None:
        self.active = False

    def connection_lost(self) -> None:
        """Whatever answers on the next connection has to prove itself; until then nothing of it is believed."""
        self.proof.void()

    def against(self, readings: tuple[Reading, ...]) -> list[Finding]:
        """What `prepare_reads` say against it: another device, too few channels."""
        identity, count = readings
        if reasons := self.proof.against_identity(identity):
            return reasons
        if not count.good:
            return [not_read(self.name, "channel_count", count)]
        return [
            finding("channel-missing", device=cell.name, channel=cell.channel, channels=int(count.value))
            for cell in self._cells
            if cell.channel > count.value
        ]

    def fill(self, inputs: Inputs, time_s: float, readings: tuple[Reading, ...] | None) -> list[str]:
        """The tensions into `inputs`; returns what was wrong with them. Without an answer they are missed."""
        if readings is None:
            self.missed += 1
            self._miss(inputs)
            return []
        self.missed = 0
        if not self.proof.known:
            self._reject(inputs)
            return [sentence(doubt) for doubt in self.proof.doubts]
        healthy, count = readings[:_SHARED]
        if not (healthy.good and count.good):
            self._reject(inputs)
            return [f"{self.name}: health and sample counter: {healthy.trouble or count.trouble}"]
        before, self._counter = self._counter, count.value
        if before == count.value:
            self._miss(inputs)
            return [f"{self.name}: the sample counter stands still"]
        if not self._device.healthy.is_set(healthy.value):
            self._reject(inputs)
            return [f"{self.name}: the amplifier is not healthy"]
        troubles = (
            self._fill_cell(inputs, time_s, cell, readings[_SHARED + k * self._per_cell :])
            for k, cell in enumerate(self._cells)
        )
        return [trouble for trouble in troubles if trouble]

    def _fill_cell(self, inputs: Inputs, time_s: float, cell: LoadCell, readings: tuple[Reading, ...]) -> str:
        tension_n = readings[0].value * self._n_per_count
        if self._sampled[cell.name].stands_still(readings[0].source_us):
            inputs.tension.miss(cell.span - 1)
            return f"{cell.name}: {STANDS_STILL}"
        trouble = self._against_status(readings) or readings[0].trouble
        if not trouble and not -cell.capacity_n <= tension_n <= cell.capacity_n:  # NaN and infinity, too
            trouble = f"{tension_n:g} N is beyond its capacity of {cell.capacity_n:g} N"
        if trouble:
            inputs.tension.reject(cell.span - 1)
            return f"{cell.name}: {trouble}"
        inputs.tension.put(cell.span - 1, tension_n, time_s)
        return ""

    def _against_status(self, readings: tuple[Reading, ...]) -> str:
        status = self._device.channels.status
        if status is None:
            return ""
        found = readings[1]
        if not found.good:
            return f"channel status: {found.trouble}"
        code = int(found.value)
        return "" if code == status.ok else status.texts.get(str(code), f"channel status {code}")

    def _miss(self, inputs: Inputs) -> None:
        for cell in self._cells:
            inputs.tension.miss(cell.span - 1)

    def _reject(self, inputs: Inputs) -> None:
        for cell in self._cells:
            inputs.tension.reject(cell.span - 1)
