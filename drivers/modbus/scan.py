"""Who answers at a Modbus TCP address, and what a register holds in every way of reading it. Functions 3 and 4 only.

A unit that answers with an exception is there; one whose gateway says that nobody is behind it (10, 11) is not.
"""

import asyncio
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import NamedTuple

from drivers.inspection import Progress
from drivers.modbus.client import ModbusConnection, ModbusFailed, ModbusTimeout
from drivers.modbus.inspect import bits_of, read_number
from drivers.modbus.maps import DriveMap, LoadCellMap, ModbusMap, PlcMap

REQUEST_TIMEOUT_S = 0.3
FUNCTIONS = (3, 4)
MOST_REGISTERS = 60  #: of one look; with the base before and a second half behind they fit one request
_ILLEGAL_FUNCTION = 1
_NOBODY_BEHIND = (10, 11)  #: gateway path unavailable; target failed to respond
_USUAL_FLOATS = (1e-4, 1e7)  #: sizes that a measured value in a float usually has


@dataclass(frozen=True, slots=True)
class UnitFound:
    """`functions` says of 3 and 4 what came: "yes", "exception 2 ...", "no", "no answer"."""

    unit: int
    functions: Mapping[int, str]
    maps: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ModbusScan:
    where: str
    connected: bool
    units: tuple[UnitFound, ...]


class Row(NamedTuple):
    """A register in one way of reading; `one` and `zero` are its values when addresses count from 1, from 0.

    None where the register does not exist, so that it cannot be told.
    """

    register: int
    reading: str
    zero: int | float | None
    one: int | float | None


async def scan(
    host: str, port: int, units: Sequence[int], maps: Mapping[str, ModbusMap], progress: Progress
) -> ModbusScan:
    """Ask every unit in turn."""
    connection = ModbusConnection(host, port)
    found: list[UnitFound] = []
    try:
        connected = await connection.connect()
        for k, unit in enumerate(units if connected else ()):
            progress(f"unit {unit} ({k + 1} of {len(units)})")
            if not connection.connected:
                await connection.connect()  # some devices hang up when they are asked for another unit
            functions = {function: await _ask(connection, unit, function) for function in FUNCTIONS}
            if any(text != "no answer" for text in functions.values()):
                found.append(UnitFound(unit, functions, await _fitting(connection, unit, maps)))
    finally:
        connection.close()
    return ModbusScan(f"{host}:{port}", connected, tuple(found))


async def _ask(connection: ModbusConnection, unit: int, function: int) -> str:
    try:
        await connection.read(function, unit, 0, 1, _deadline_s())
    except ModbusTimeout:
        return "no answer"
    except ModbusFailed as error:
        if error.exception_code in _NOBODY_BEHIND:
            return "no answer"
        return "no" if error.exception_code == _ILLEGAL_FUNCTION else str(error)
    return "yes"


async def _fitting(connection: ModbusConnection, unit: int, maps: Mapping[str, ModbusMap]) -> tuple[str, ...]:
    """The maps whose device id the unit has. A map without one fits everything, and is not named."""
    names: list[str] = []
    for name, device in maps.items():
        check = device.device_id if isinstance(device, LoadCellMap | DriveMap | PlcMap) else None
        if check is None:
            continue
        try:
            found = await read_number(connection, device, unit, (check.address - device.address_base, check.type))
        except ModbusTimeout:
            continue
        if found.value is not None and bits_of(check, found.value) == check.value:
            names.append(name)
    return tuple(names)


async def registers(
    host: str, port: int, unit: int, register: int, count: int, functions: Sequence[int] = FUNCTIONS
) -> tuple[int, list[Row]]:
    """`count` registers from `register`, as a manual numbers them, in every way of reading, and the function that
    they were read with: the first of `functions` that gives any.

    Raises ModbusFailed with what every function said.
    """
    connection = ModbusConnection(host, port)
    addresses = range(max(0, register - 1), min(register + count + 1, 65536))
    said: list[ModbusFailed] = []
    try:
        if not await connection.connect():
            raise ModbusTimeout(f"no connection to {host}:{port}")
        for function in functions:
            words, troubles = await _read_words(connection, function, unit, addresses)
            said += troubles
            if words:
                return function, [row for k in range(register, register + count) for row in _rows(k, words)]
    finally:
        connection.close()
    codes = {error.exception_code for error in said}
    raise ModbusFailed("; ".join(dict.fromkeys(map(str, said))), codes.pop() if len(codes) == 1 else None)


async def _read_words(
    connection: ModbusConnection, function: int, unit: int, addresses: range
) -> tuple[dict[int, int], list[ModbusFailed]]:
    """What could be read, by address on the wire, and what was said where nothing could.

    Together where the device lets it, so that the halves of a number belong to one instant; otherwise one by one.
    """
    words: dict[int, int] = {}
    said: list[ModbusFailed] = []
    for part in [addresses, *([address] for address in addresses)]:
        try:
            numbers = await connection.read(function, unit, part[0], len(part), _deadline_s())
        except ModbusTimeout as error:
            said.append(ModbusTimeout(f"function {function}: {error}"))
            break
        except ModbusFailed as error:
            said.append(error)
            continue
        words |= zip(part, numbers, strict=True)
        if len(part) > 1:
            break
    return words, said


def _rows(register: int, words: Mapping[int, int]) -> Iterator[Row]:
    for reading, size, code, low_first, swapped in _READINGS:
        zero, one = (_number(words, address, size, code, low_first, swapped) for address in (register, register - 1))
        yield Row(register, reading, zero, one)


#: Name, registers, struct code, low word first, bytes of a register swapped.
_READINGS = [
    ("u16", 1, ">H", False, False),
    ("i16", 1, ">h", False, False),
    *(
        (
            f"{kind} {'low' if low_first else 'high'}-first{', bytes swapped' if swapped else ''}",
            2,
            code,
            low_first,
            swapped,
        )
        for swapped in (False, True)
        for low_first in (False, True)
        for kind, code in (("u32", ">I"), ("i32", ">i"), ("f32", ">f"))
    ),
]


def _number(
    words: Mapping[int, int], address: int, size: int, code: str, low_first: bool, swapped: bool
) -> int | float | None:
    """None where a register that is needed was not read."""
    taken = [words.get(address + k) for k in range(size)]
    known = [word for word in taken if word is not None]
    if len(known) < size:
        return None
    if low_first:
        known.reverse()
    return struct.unpack(code, struct.pack(f"{'<' if swapped else '>'}{size}H", *known))[0]


def usual_float(row: Row, value: int | float | None) -> bool:
    """Whether a reading as f32 has a size that measured values usually have. Nothing of the kind can be said of whole
    numbers, nor of 0."""
    low, high = _USUAL_FLOATS
    return isinstance(value, float) and row.reading.startswith("f32") and isfinite(value) and low <= abs(value) <= high


def _deadline_s() -> float:
    return asyncio.get_running_loop().time() + REQUEST_TIMEOUT_S
