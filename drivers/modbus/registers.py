"""Registers of a Modbus device to numbers and back, as its map says. No I/O.

A block is read or written in one request. Each register goes high byte first; of a number in two registers the
high word comes first or last, as the map says. Addresses in a map count from its `address_base`, on the wire from 0.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

from drivers.map_rules import BYTES
from drivers.modbus.maps import MAX_READ_REGISTERS, ModbusMap
from gateway.core.line_problem import printable

_CODE = {"u16": "H", "i16": "h", "u32": "I", "i32": "i", "f32": "f"}

Field = tuple[int, str]  #: address (from 0, as on the wire) and type


@dataclass(frozen=True, slots=True)
class SerialNumber:
    """Registers that hold a serial number; `printed` is where by the manual, `address` where on the wire."""

    printed: int
    address: int
    count: int
    is_text: bool
    word_order: str

    @classmethod
    def of(cls, device: ModbusMap) -> "SerialNumber | None":
        """None: the map names none."""
        if (entry := device.serial) is None:
            return None
        address, is_text = entry.address - device.address_base, entry.type == "text"
        return cls(entry.address, address, entry.count, is_text, device.word_order)

    def decode(self, registers: Sequence[int]) -> str:
        """As a nameplate prints it; empty: none. Raises ValueError for a wrong count."""
        if len(registers) != self.count:
            raise ValueError(f"{len(registers)} registers, asked for {self.count}")
        swapped = self.word_order == "low-first" and not self.is_text
        data = struct.pack(f">{self.count}H", *(reversed(registers) if swapped else registers))
        if self.is_text:
            return printable(data.decode("ascii", "backslashreplace").strip("\0 "))
        return str(int.from_bytes(data)) if any(data) else ""


class RegisterBlock:
    """Numbers at fixed addresses, decoded and encoded together. Fields must not overlap; gaps are read, not used."""

    def __init__(self, fields: Sequence[Field], word_order: str) -> None:
        order = sorted(range(len(fields)), key=lambda k: fields[k][0])
        self.fields = fields
        self.word_order = word_order
        self.address = fields[order[0]][0]
        code = ">"
        at = self.address
        swapped: list[int] = []
        for k in order:
            address, kind = fields[k]
            code += "xx" * (address - at) + _CODE[kind]
            at = address + BYTES[kind] // 2
            if BYTES[kind] == 4 and word_order == "low-first":
                swapped.append(address - self.address)
        self.count = at - self.address
        self._fields = struct.Struct(code)
        self._registers = struct.Struct(f">{self.count}H")
        self._swapped = swapped
        self._position = [order.index(k) for k in range(len(fields))]  #: of field k, in order of address
        self._has_floats = any(kind == "f32" for _, kind in fields)  #: only they take what is not finite
        self._in_address_order = self._position == list(range(len(fields)))

    def decode(self, registers: Sequence[int]) -> list[float]:
        """The numbers, in the order in which the fields were given. Raises ValueError for a wrong count."""
        if len(registers) != self.count:
            raise ValueError(f"{len(registers)} registers, asked for {self.count}")
        try:
            return self.decode_bytes(self._registers.pack(*registers), 0)
        except struct.error as error:
            raise ValueError(f"no registers: {error}") from error

    def decode_bytes(self, data: bytes, at: int) -> list[float]:
        """The same from registers as they come on the wire, of which the block's own begin at byte `at`."""
        if self._swapped:
            registers = self._in_order(self._registers.unpack_from(data, at))
            data, at = self._registers.pack(*registers), 0
        numbers = self._fields.unpack_from(data, at)
        return list(numbers) if self._in_address_order else [numbers[position] for position in self._position]

    def encode(self, numbers: Sequence[float]) -> list[int]:
        """The registers of numbers in the order of the fields.

        Raises ValueError for a number that is not finite or does not fit its type.
        """
        if self._has_floats and not all(isfinite(number) for number in numbers):
            raise ValueError(f"{list(numbers)}: not finite")
        try:
            packed = self._fields.pack(*(numbers if self._in_address_order else self._by_address(numbers)))
        except (struct.error, OverflowError) as error:
            raise ValueError(f"{list(numbers)}: {error}") from error
        return list(self._in_order(self._registers.unpack(packed)))

    def _by_address(self, numbers: Sequence[float]) -> list[float]:
        ordered: list[float] = [0.0] * len(numbers)
        for number, position in zip(numbers, self._position, strict=True):
            ordered[position] = number
        return ordered

    def _in_order(self, registers: Sequence[int]) -> Sequence[int]:
        if not self._swapped:
            return registers
        words = list(registers)
        for at in self._swapped:
            words[at], words[at + 1] = words[at + 1], words[at]
        return words


def spans(fields: Sequence[Field]) -> list[list[int]]:
    """The fields, by their place in `fields`, that fit into one read each; the fewest reads in order of address."""
    groups: list[list[int]] = []
    start = 0
    for k in sorted(range(len(fields)), key=lambda k: fields[k][0]):
        address, kind = fields[k]
        if not groups or address + BYTES[kind] // 2 - start > MAX_READ_REGISTERS:
            groups.append([])
            start = address
        groups[-1].append(k)
    return groups
