"""What an inspection found out about the devices of a line: facts, the same for every protocol, and no judgement.

An inspection reads and listens; it never writes, commands or synchronises. Numbers are SI.
"""

import asyncio
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import NamedTuple

from drivers.cia402 import PowerState
from drivers.map_fields import Bit

SAMPLE_PAUSE_S = 0.05  #: between two readings of a load cell
LEAST_SAMPLES = 3

Progress = Callable[[str], None]  #: told what is done now, for a person who waits


class Number(NamedTuple):
    """A number that a device was asked for, or why there is none."""

    value: float | None
    trouble: str = ""

    def scaled(self, factor: float) -> "Number":
        return self if self.value is None else Number(factor * self.value)


class Identity(NamedTuple):
    found: str
    wanted: str  #: as the map has it
    fits: bool


class WatchdogFacts(NamedTuple):
    """`now_s` is 0 while it is off, as it is at rest: arming sets it."""

    now_s: Number
    low_s: float
    high_s: float


class DriveFacts(NamedTuple):
    statusword: Number
    power: PowerState | None
    safe_torque_off: bool | None  #: None: it does not say
    error: str  #: its own word for a fault
    rated_torque_nm: Number | None  #: None: the map knows no such object
    max_torque_nm: Number | None  #: None: the line sets it, or the map knows none
    supplied: bool | None = None  #: its power stage, as its statusword says; None: its map does not know where
    mode: Number | None = None  #: of operation, as it displays it; None: it does not
    mode_wanted: int | None = None  #: that arming sets; None: it has but one mode
    max_torque_step_nm: float = 0.0  #: that its greatest torque moves by at least; 0: by any number


class CellFacts(NamedTuple):
    """`counter_moves` is None where the amplifier counts no samples."""

    samples_n: tuple[float, ...]
    trouble: str  #: why the last sample that must not be used must not be used
    counter_moves: bool | None


class PlcFacts(NamedTuple):
    trouble: str  #: why its status is not known
    permissive: bool = False
    emergency_stop: bool = False  #: the circuit is open
    running: bool = False
    watchdog_tripped: bool = False
    local: bool = False
    speed_m_per_s: Number = Number(None, "not read")


@dataclass(frozen=True, slots=True)
class DeviceFacts:
    """One drive, load cell or PLC of the line. While `silent` says why it does not answer, nothing else is known."""

    name: str
    place: str  #: on its bus: node 3, unit 1 channel 2
    silent: str = ""
    identity: Identity | None = None  #: None: its map says nothing that tells it from others
    firmware: str = ""  #: name and versions in its own words, where the protocol has them
    standing: str = ""  #: on its bus, in words: "operational"
    differences: tuple[str, ...] = ()  #: what is otherwise than the map says it is fixed
    watchdog: WatchdogFacts | None = None
    drive: DriveFacts | None = None
    cell: CellFacts | None = None
    plc: PlcFacts | None = None

    @property
    def believed(self) -> bool:
        """It answers, and is what its map is for: what it says means what the map says."""
        return not self.silent and (self.identity is None or self.identity.fits)


@dataclass(frozen=True, slots=True)
class BusFacts:
    """A bus and its devices. While `trouble` says why it cannot be used, there are none."""

    name: str
    where: str
    trouble: str = ""
    devices: tuple[DeviceFacts, ...] = ()
    not_asked: str = ""  #: why the devices were left alone
    notes: tuple[str, ...] = ()  #: what was heard of errors
    load: float | None = None  #: of the wire while listening, as a fraction; None where it cannot be measured
    foreign_load: float | None = None  #: the part of it that is nobody's of this line


class CellSample(NamedTuple):
    tension_n: Number
    counter: float | None  #: of samples; None where the amplifier has none


ReadCell = Callable[[], Awaitable[CellSample]]


async def sample_cells(cells: Mapping[str, ReadCell], sample_s: float) -> dict[str, CellFacts]:
    """Read every cell again and again for `sample_s` seconds; by its name. Raises whatever a reader raises."""
    taken: dict[str, list[CellSample]] = {name: [] for name in cells}
    now_s = asyncio.get_running_loop().time
    end_s, rounds = now_s() + sample_s, 0
    while cells and (rounds < LEAST_SAMPLES or now_s() < end_s):
        for name, read in cells.items():
            taken[name].append(await read())
        rounds += 1
        await asyncio.sleep(SAMPLE_PAUSE_S)
    return {name: _cell_facts(samples) for name, samples in taken.items()}


def _cell_facts(samples: Sequence[CellSample]) -> CellFacts:
    good = [sample.tension_n.value for sample in samples if sample.tension_n.value is not None]
    troubles = [sample.tension_n.trouble for sample in samples if sample.tension_n.trouble]
    troubles += ["a number that is not finite" for value in good if not isfinite(value)]
    counters = {sample.counter for sample in samples}
    moves = None if None in counters else len(counters) > 1
    return CellFacts(tuple(value for value in good if isfinite(value)), troubles[-1] if troubles else "", moves)


def is_supplied(voltage_enabled: Bit | None, statusword: Number) -> bool | None:
    """Whether the power stage is supplied, as the statusword says; None where that is not known."""
    if voltage_enabled is None or statusword.value is None:
        return None
    return voltage_enabled.is_set(int(statusword.value))
