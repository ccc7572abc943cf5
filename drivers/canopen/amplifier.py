"""A load-cell amplifier as a node of the bus: which of its numbers may be believed.

With every SYNC it sends its channels in one PDO or several. While the link is silent there is no SYNC, so it is asked
by SDO then: an operator sees tensions before anything is armed.
"""

from dataclasses import dataclass, field

from drivers.canopen.configure import cell_expected, cell_steps
from drivers.canopen.counts import end_values, n_per_count
from drivers.canopen.map_cell import COB_ID_STEP, LoadCellMap
from drivers.canopen.pdo import MalformedPdo, PdoLayout
from drivers.canopen.prepare import check_fixed, check_identity
from drivers.canopen.sdo import SdoBus
from drivers.canopen.station import Station
from drivers.canopen.transaction import Step, read_number
from gateway.core.finding import Finding, finding
from gateway.core.line import LoadCell
from gateway.core.signals import Inputs, Outputs
from gateway.wording.catalogue import sentence


@dataclass(slots=True)
class _Cell:
    """One load cell, and what came of it since the last cycle."""

    item: LoadCell
    pdo: int  #: which of the amplifier's PDOs carries it, counted from 0
    tension_at: int  #: in that PDO
    status_at: int | None
    n_per_count: float | None = None  #: None: the amplifier has not said yet
    fresh: tuple[float, int | None] | None = None  #: counts and status; None: nothing new


@dataclass(slots=True)
class _Answer:
    """One PDO of the amplifier, or a reading by SDO, as one measurement."""

    cells: list[_Cell] = field(default_factory=list[_Cell])
    came: bool = False  #: with the present SYNC
    counter: int | None = None  #: the sample counter last seen in it
    frozen: bool = False  #: it came, with the counter of the time before


class AmplifierNode:
    """The load cells of one node."""

    def __init__(self, device: LoadCellMap, cells: list[LoadCell]) -> None:
        node = cells[0].address
        self.identity = device.identity
        self.watchdog, self.defies, self.shows_torque = None, None, False  # it is not commanded
        self._device = device
        self._ends = end_values(device.objects.tension.type)
        pdos, each = device.transmit_pdos, device.transmit_pdos.channels_each
        tensions = [k for k, name in enumerate(pdos.objects) if name == "tension"]
        statuses = [k for k, name in enumerate(pdos.objects) if name == "status"]
        self._counter_at = pdos.objects.index("sample_counter")
        self._cells: list[_Cell] = []
        self._answers: dict[int, _Answer] = {}
        self._layouts: dict[int, PdoLayout] = {}
        self._pdos: list[int] = []  #: the PDOs that are needed, counted from 0
        for item in cells:
            pdo, at = divmod(item.channel - 1, each)
            cell = _Cell(item, pdo, tensions[at], statuses[at] if statuses else None)
            cob_id = pdos.cob_id + COB_ID_STEP * pdo + node
            if cob_id not in self._answers:
                self._pdos.append(pdo)
                self._layouts[cob_id] = PdoLayout(device.objects_of(pdo))
            self._answers.setdefault(cob_id, _Answer()).cells.append(cell)
            self._cells.append(cell)
        self.answers = tuple(self._answers)
        names = ", ".join(item.name for item in cells)
        frames = len(self.answers)
        self.station = Station(names, node, device.heartbeat, frames=frames, classes=device.emergency)
        self._silent = _Answer(self._cells)
        self._read_s = 0.0  #: when the last reading by SDO was asked for
        self._boot_ups = -1  #: of the station, when it was last found to be what its map says

    # the cycle

    def begin_sync(self) -> None:
        self.station.begin_sync()
        for answer in self._answers.values():
            answer.came = False
        for cell in self._cells:
            cell.fresh = None

    def on_answer(self, cob_id: int, data: bytes | bytearray) -> None:
        """A TPDO of the present SYNC. Raises MalformedPdo for a second one or a wrong length."""
        answer = self._answers[cob_id]
        if answer.came:
            raise MalformedPdo("a second answer to one SYNC")
        numbers = self._layouts[cob_id].decode(data)
        answer.came = True
        self.station.on_frame()
        counter = int(numbers[self._counter_at])
        answer.frozen, answer.counter = counter == answer.counter, counter
        for cell in answer.cells:
            status = None if cell.status_at is None else int(numbers[cell.status_at])
            cell.fresh = (numbers[cell.tension_at], status)

    def check_answer(self, cob_id: int, data: bytes | bytearray) -> None:
        """Raises MalformedPdo."""
        self._layouts[cob_id].decode(data)

    def absent(self, now_s: float) -> bool:
        return self.station.absent(now_s, self.station.supervised)

    def trouble(self, now_s: float) -> Finding | None:
        return self.station.trouble(now_s, self.station.supervised)

    def fill(self, inputs: Inputs, now_s: float, *, active: bool) -> list[str]:
        """The tensions: missed without an answer, rejected where the amplifier says so or they cannot be."""
        troubles: list[str] = []
        refused = self.station.emergency or self.station.distrust
        frozen = False
        for answer in self._answers.values() if active else [self._silent]:
            for cell in answer.cells:
                index = cell.item.span - 1
                if cell.fresh is None or answer.frozen or self.station.heartbeat_lost(now_s, active):
                    frozen |= cell.fresh is not None and answer.frozen
                    inputs.tension.miss(index)
                elif refused:
                    inputs.tension.reject(index)
                elif trouble := self._fill_cell(inputs, cell, now_s if active else self._read_s):
                    troubles.append(trouble)
        if refused:
            troubles.append(sentence(refused))
        if not active:  # a reading counts once; an answer to SYNC is used up by the next SYNC
            for cell in self._cells:
                cell.fresh = None
        return [*troubles, f"{self.station.name}: the sample counter stands still"] if frozen else troubles

    def _fill_cell(self, inputs: Inputs, cell: _Cell, time_s: float) -> str:
        assert cell.fresh is not None
        counts, code = cell.fresh
        item, status = cell.item, self._device.objects.status
        if status is not None and code is not None and code != status.ok:
            inputs.tension.reject(item.span - 1)
            return f"{item.name}: {status.texts.get(str(code), f'channel status {code}')}"
        if counts in self._ends:
            inputs.tension.reject(item.span - 1)
            return f"{item.name}: {counts:g}, the end of what its object can say: saturated"
        tension_n = float("nan") if cell.n_per_count is None else counts * cell.n_per_count
        if not -item.capacity_n <= tension_n <= item.capacity_n:  # NaN and infinity, too
            inputs.tension.reject(item.span - 1)
            return f"{item.name}: {tension_n:g} N is beyond its capacity of {item.capacity_n:g} N"
        inputs.tension.put(item.span - 1, tension_n, time_s)
        return ""

    def command(self, outputs: Outputs, now_s: float) -> None:
        """It is not commanded."""
        return None

    # by SDO

    def reading_due(self, now_s: float, *, active: bool) -> bool:
        return not active

    async def read(self, sdo: SdoBus, now_s: float) -> list[Finding]:
        """Tensions and states while there is no SYNC. Raises SdoFailed."""
        node, objects = self.station.node, self._device.objects
        if self._boot_ups != self.station.boot_ups and (
            reasons := await check_identity(sdo, self.station, self.identity) or await self._learn(sdo)
        ):
            return reasons
        counter = int(await read_number(sdo, node, objects.sample_counter))
        readings: list[tuple[float, int | None]] = []
        for cell in self._cells:
            channel = cell.item.channel
            counts = await read_number(sdo, node, objects.tension.of_channel(channel))
            code = None if objects.status is None else objects.status.of_channel(channel)
            readings.append((counts, None if code is None else int(await read_number(sdo, node, code))))
        for cell, reading in zip(self._cells, readings, strict=True):
            cell.fresh = reading
        self._silent.frozen, self._silent.counter = counter == self._silent.counter, counter
        self._read_s = now_s
        return []

    async def check(self, sdo: SdoBus) -> list[Finding]:
        """Its channels, and that they are healthy. Raises SdoFailed."""
        if reasons := await self._learn(sdo):
            return reasons
        healthy = self._device.objects.healthy
        reasons = await check_fixed(sdo, self.station, cell_expected(self._device, self.station.node, self._pdos))
        if healthy is not None and not healthy.is_set(int(await read_number(sdo, self.station.node, healthy))):
            reasons.append(finding("amplifier-not-healthy", device=self.station.name))
        return reasons

    async def _learn(self, sdo: SdoBus) -> list[Finding]:
        """That it has these channels, and what a count of each is worth. Raises SdoFailed."""
        self._boot_ups = -1
        boot_ups, node, objects = self.station.boot_ups, self.station.node, self._device.objects
        count = int(await read_number(sdo, node, objects.channel_count))
        reasons = [
            finding("channel-missing", device=cell.item.name, channel=cell.item.channel, channels=count)
            for cell in self._cells
            if cell.item.channel > count
        ]
        for cell in [] if reasons else self._cells:
            reasons += await self._learn_unit(sdo, cell)
        if not reasons:
            self._boot_ups = boot_ups
        return reasons

    async def _learn_unit(self, sdo: SdoBus, cell: _Cell) -> list[Finding]:
        tension, unit = self._device.objects.tension, self._device.objects.physical_unit
        digits = 0
        if unit is not None:
            found = int(await read_number(sdo, self.station.node, unit.of_channel(cell.item.channel)))
            if found != unit.value:
                return [finding("cell-unit-differs", cell=cell.item.name, found=found, wanted=unit.value)]
        if tension.digits is not None:
            digits = int(await read_number(sdo, self.station.node, tension.digits.of_channel(cell.item.channel)))
        worth = n_per_count(self._device, cell.item, digits)
        if isinstance(worth, Finding):
            return [worth]
        cell.n_per_count = worth
        return []

    def steps(self) -> list[Step]:
        return cell_steps(self._device, self.station.node, self._pdos)

    def release_steps(self) -> list[Step]:
        return []

    async def confirm_stopped(self, sdo: SdoBus) -> bool:
        """It moves nothing."""
        return True

    def forget(self) -> None:
        """The counters stay: what is measured is true whether the line is commanded or not."""
        self.station.forget()
        for cell in self._cells:
            cell.fresh = None
