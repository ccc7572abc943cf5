"""What a device in a Modbus unit is to its link: what it reads, writes and has proven, and what it makes of it. No I/O.

`Amplifier`, `Axis` and `Plc` are devices. Each knows its registers and judges its numbers; who asks, when, and in how
many requests is no business of theirs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from drivers.modbus.maps import ModbusMap, Register, RegisterCheck
from drivers.modbus.plan import Wish
from drivers.modbus.registers import RegisterBlock, SerialNumber
from gateway.core.finding import Finding, finding
from gateway.core.signals import Inputs, Outputs

ANSWERS_ALLOWED = 3  #: cycles in a row without an answer until a device counts as absent

Judge = Callable[[float], list[Finding]]  #: what speaks against a number that was read


@dataclass(frozen=True, slots=True)
class Check:
    """A number of the device that is read and judged before it is believed or trusted."""

    register: RegisterBlock
    judge: Judge


@dataclass(frozen=True, slots=True)
class Setting:
    """A number that `prepare` writes and reads back. `name` is its key in the map of `device`."""

    device: str
    name: str
    register: RegisterBlock
    counts: float
    off: float | None = None  #: of a watchdog: the value with which it waits for nobody

    @property
    def wish(self) -> Wish:
        """To read it with a transaction."""
        return Wish(f"{self.device}: {self.name}", self.register.fields, self.register.word_order)

    @property
    def kept(self) -> Check:
        """That it still is what it was set to."""
        return Check(self.register, self.against)

    def against(self, found: float) -> list[Finding]:
        if found == self.counts:
            return []
        return [finding("setting-changed", **self.named, set_counts=self.counts, found_counts=found)]

    @property
    def named(self) -> dict[str, str]:
        """What every finding of it says."""
        return {"device": self.device, "setting": self.name}


@dataclass(slots=True)
class Standing:
    """How the unit of a device stands with the gateway."""

    active: bool = False  #: it is commanded, not only read
    wrote: bool = False  #: the transaction of this cycle carried a command
    missed: int = 0  #: cycles in a row without an answer
    doubt: Sequence[Finding] = ()  #: why nothing of it is believed
    distrust: Sequence[Finding] = ()  #: why it is not commanded although it is active; stays until that is mended
    refused: str = ""  #: the same for what it was commanded in this cycle

    @property
    def absent(self) -> bool:
        return self.missed >= ANSWERS_ALLOWED


@dataclass(frozen=True, slots=True)
class Proofs:
    """What must hold of a device."""

    identity: list[Check]  #: before anything of it is believed: on every connection
    trust: list[Check] = field(default_factory=list[Check])  #: before there may be torque: in `prepare`
    settings: list[Setting] = field(default_factory=list[Setting])  #: before it is written to: on every connection
    serial: SerialNumber | None = None  #: read in `prepare`


class Device(Protocol):
    """One device, or the channels of one, in a unit."""

    name: str
    gives_torque: bool  #: once it was lost its unit is not written to before the next `prepare`

    @property
    def wish(self) -> Wish: ...

    @property
    def proofs(self) -> Proofs: ...

    def fill(self, inputs: Inputs, numbers: Sequence[float] | None, standing: Standing, time_s: float) -> list[str]:
        """What was read in this cycle into `inputs`; returns what was wrong. None: no answer that can be used."""
        ...

    def command(self, outputs: Outputs) -> list[int]:
        """The registers of its `wish.write` for these outputs. Raises ValueError for what cannot be commanded."""
        ...

    def rest(self) -> list[int]:
        """The same for a device that is left: no torque, no transport."""
        ...

    @property
    def disobeys(self) -> bool:
        """Whether it was told to take torque off, and has not: it is fed no longer."""
        ...

    def forget(self) -> None:
        """The link is silent: what it was told and what it said of its state counts no more."""
        ...


WATCHDOG_OFF = 0  #: counts


def identity_check(name: str, device_id: RegisterCheck, device: ModbusMap) -> Check:
    """That the device is of the type of its map, or set up as the map needs it."""
    wanted, mask = device_id.value, device_id.mask if device_id.mask is not None else -1

    def judge(found: float) -> list[Finding]:
        bits = int(found) & mask
        return [] if bits == wanted else [finding("device-id-differs", device=name, found=bits, wanted=wanted)]

    return Check(register_block([device_id], device), judge)


def register_block(entries: Sequence[Register], device: ModbusMap, offset: int = 0) -> RegisterBlock:
    """The registers of a map as they are on the wire, `offset` further on."""
    offset -= device.address_base
    return RegisterBlock([(entry.address + offset, entry.type) for entry in entries], device.word_order)
