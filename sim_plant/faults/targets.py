"""What a line must offer so that faults can be done to it. Whoever runs a line hands over what it has (`FaultyLine`).

Times are world time in s. Spans, rollers and channels count from 1.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from sim_plant.faults.parse import FaultRefused, Target
from sim_plant.faults.table import NUMBERED, Kind
from sim_plant.faults.wire_faults import WireFaults


class FaultyDrive(Protocol):
    """As `devices.drive.Drive`."""

    def fault(self, code: int, now_s: float) -> None: ...
    def set_sto(self, active: bool, now_s: float) -> None: ...
    def jump_speed(self, delta_m_per_s: float) -> None: ...
    def freeze_speed(self) -> None: ...
    def heal_speed(self) -> None: ...
    def turn_encoder(self) -> None: ...
    def reverse(self, reverse: bool) -> None: ...
    def give_share(self, share: float) -> None: ...
    def lose_mode(self, mode: int, now_s: float, *, says_follows: bool) -> None: ...
    def regain_mode(self) -> None: ...
    def set_powered(self, powered: bool, now_s: float) -> None: ...


class FaultyAmplifier(Protocol):
    """As `devices.amplifier.Amplifier`."""

    def swap(self, channel: int, other: int) -> None: ...
    def scale(self, channel: int, factor: float) -> None: ...
    def nan(self, channel: int) -> None: ...
    def stick(self, channel: int) -> None: ...
    def show_n(self, channel: int, tension_n: float) -> None: ...
    def offset_n(self, channel: int, rate_n_per_s: float, start_n: float = 0.0) -> None: ...
    def spike(self, channel: int, height_n: float) -> None: ...
    def heal(self, channel: int) -> None: ...


class FaultyPlc(Protocol):
    """As `devices.line_plc.LinePlc`."""

    @property
    def permissive(self) -> bool: ...
    @permissive.setter
    def permissive(self, value: bool) -> None: ...
    @property
    def emergency_stop(self) -> bool: ...
    @emergency_stop.setter
    def emergency_stop(self, value: bool) -> None: ...
    @property
    def local(self) -> bool: ...
    @local.setter
    def local(self, value: bool) -> None: ...


class FaultyWeb(Protocol):
    """As `world.World`."""

    def compile_full_line(self) -> None: ...
    def break_web(self, span: int) -> None: ...
    def splice_web(self, span: int) -> None: ...
    def slacken_web(self, span: int, length_m: float) -> None: ...
    def set_friction_factor(self, roller: int, factor: float) -> None: ...
    def set_slip(self, roller: int, mu_factor: float) -> None: ...


@runtime_checkable
class Warns(Protocol):
    """A drive that can warn of something: one on a wire."""

    def warn(self, code: int, register: int) -> None: ...


@runtime_checkable
class HasWatchdog(Protocol):
    """A drive or PLC whose communication watchdog can be dead (takes its setting, never acts on it) or only warn."""

    watchdog_is_dead: bool

    def only_warn(self, only: bool) -> None: ...


@runtime_checkable
class Freezable(Protocol):
    """A PLC whose program can stand still: it is told things and does nothing, and shows what it showed last."""

    def freeze(self, now_s: float) -> None: ...
    def thaw(self, now_s: float) -> None: ...


@dataclass(frozen=True, slots=True)
class Place:
    """Where a device is met: its address on a wire."""

    wire: str
    address: int | None  #: None where the wire has no addresses


@dataclass(frozen=True)
class FaultyLine:
    """The parts of a line. What is not there refuses its faults by name.

    `places` and `restarts` go by ("drive", 3), ("load-cell", 2) and ("plc", 0).
    """

    spans: int
    drives: Sequence[FaultyDrive] = ()
    amplifier: FaultyAmplifier | None = None
    plc: FaultyPlc | None = None
    web: FaultyWeb | None = None
    wires: Mapping[str, WireFaults[Any]] = field(default_factory=dict[str, WireFaults[Any]])
    places: Mapping[tuple[str, int], Place] = field(default_factory=dict[tuple[str, int], Place])
    restarts: Mapping[tuple[str, int], Callable[[float], None]] = field(
        default_factory=dict[tuple[str, int], Callable[[float], None]]
    )

    def check(self, target: Target) -> None:
        """Raises FaultRefused for a roller or span that this line does not have."""
        if target.kind is not Kind.WIRE and target.number is not None and target.number > self.spans:
            raise FaultRefused(f"{target}: this line has no such {NUMBERED[target.kind]}; allowed: 1 to {self.spans}")

    def wire_of(self, target: Target) -> tuple[WireFaults[Any], int | None]:
        """The faults of the wire that a target is met on, and its address there (None: all). Raises FaultRefused."""
        if target.kind is Kind.WIRE:
            wire, address = target.wire, target.number
            self._check_address(wire, address)
        else:
            place = self.places.get(key_of(target))
            if place is None:
                raise FaultRefused(f"{target} is on no wire of this line; only its own faults can be had")
            wire, address = place.wire, place.address
        if wire not in self.wires:
            there = ", ".join(self.wires) or "none"
            raise FaultRefused(f"this line has no wire {wire}; allowed: {there}")
        return self.wires[wire], address

    def _check_address(self, wire: str, address: int | None) -> None:
        """Raises FaultRefused for an address on this wire that nobody has."""
        there: dict[int, list[str]] = {}
        for (kind, number), place in self.places.items():
            if place.wire == wire and place.address is not None:
                there.setdefault(place.address, []).append(f"{kind} {number}" if number else kind)
        if address is None or wire not in self.wires or address in there:
            return
        # Several devices at one address are channels of one amplifier, or in one rack.
        listed = ", ".join(f"{a} ({d[0] if len(d) == 1 else f'{d[0]} to {d[-1]}'})" for a, d in sorted(there.items()))
        raise FaultRefused(f"{wire} {address}: nobody has this address; there are {listed or 'none'}")


def key_of(target: Target) -> tuple[str, int]:
    return target.kind.value, target.number or 0
