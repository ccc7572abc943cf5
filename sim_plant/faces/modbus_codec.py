"""Modbus TCP from the server's side, without I/O: bytes in, requests out; a request in, an answer out.

After the Modbus application protocol V1.1b3 and the messaging guide on TCP/IP V1.0b: functions 3, 4, 6, 16
and 23, the exception codes, and the rule that 23 writes before it reads.
"""

import struct
from dataclasses import dataclass
from typing import Protocol

READ_HOLDING = 3
READ_INPUT = 4
WRITE_ONE = 6
WRITE_MANY = 16
READ_WRITE = 23

ILLEGAL_FUNCTION = 1
ILLEGAL_ADDRESS = 2
ILLEGAL_VALUE = 3
DEVICE_FAILURE = 4
TARGET_SILENT = 11

MAX_READ = 125  #: registers in one answer
MAX_WRITE = 123  #: registers in one function 16
MAX_WRITE_OF_READ_WRITE = 121  #: registers written by one function 23

_MBAP = struct.Struct(">HHHB")
_TWO_WORDS = struct.Struct(">HH")
_MANY_HEAD = struct.Struct(">HHB")
_READ_WRITE_HEAD = struct.Struct(">HHHHB")
#: The length field counts the unit and the PDU: a unit and a function code at the least, 1 + 253 at the most.
_LENGTHS = range(2, 255)


class NotModbus(Exception):
    """The stream cannot be Modbus TCP; there is no way to find the next request in it."""


class Refused(Exception):
    """A request that is answered with a Modbus exception. `code` is the exception code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"Modbus exception {code}")
        self.code = code


@dataclass(frozen=True, slots=True)
class Frame:
    """One request or answer on the wire: `pdu` is the function code and what follows it."""

    transaction: int
    unit: int
    pdu: bytes


@dataclass(frozen=True, slots=True)
class Request:
    """What a PDU asks: first `values` are written, then `read_count` registers are read."""

    read_address: int = 0
    read_count: int = 0
    write_address: int = 0
    values: tuple[int, ...] = ()


class Registers(Protocol):
    """The 16-bit registers of one unit. Addresses are those of the protocol, from 0."""

    @property
    def functions(self) -> frozenset[int]:
        """The function codes that the unit knows."""
        ...

    def check_read(self, address: int, count: int) -> None:
        """Raises Refused when the range cannot be read."""
        ...

    def read(self, address: int, count: int, now_s: float) -> bytes:
        """`count` registers, high byte first. Raises Refused when the range cannot be read."""
        ...

    def write(self, address: int, values: tuple[int, ...], now_s: float) -> None:
        """Take all the values or none. Raises Refused, and nothing has changed then."""
        ...


def take_frames(buffer: bytearray) -> list[Frame]:
    """Take every complete frame off the front of `buffer`; what is left is the beginning of the next one.

    Raises NotModbus on a protocol identifier other than 0 or a length that no PDU has. `buffer` is of no use
    after that.
    """
    frames: list[Frame] = []
    start = 0
    while len(buffer) - start >= _MBAP.size:
        transaction, protocol, length, unit = _MBAP.unpack_from(buffer, start)
        if protocol != 0:
            raise NotModbus(f"protocol identifier {protocol}, expected 0")
        if length not in _LENGTHS:
            raise NotModbus(f"length {length}, expected {_LENGTHS.start} to {_LENGTHS.stop - 1}")
        end = start + _MBAP.size - 1 + length
        if end > len(buffer):
            break
        frames.append(Frame(transaction, unit, bytes(buffer[start + _MBAP.size : end])))
        start = end
    del buffer[:start]
    return frames


def encode_frame(frame: Frame) -> bytes:
    """The bytes of a frame on the wire."""
    return _MBAP.pack(frame.transaction, 0, len(frame.pdu) + 1, frame.unit) + frame.pdu


def parse_request(pdu: bytes) -> Request:
    """What a request's PDU asks. Raises Refused with code 1, 2 or 3."""
    parse = _PARSERS.get(pdu[0])
    if parse is None:
        raise Refused(ILLEGAL_FUNCTION)
    try:
        request = parse(pdu[1:])
    except struct.error:
        raise Refused(ILLEGAL_VALUE) from None
    if max(request.read_address + request.read_count, request.write_address + len(request.values)) > 0x10000:
        raise Refused(ILLEGAL_ADDRESS)
    return request


def answer(pdu: bytes, registers: Registers, now_s: float) -> bytes:
    """The answer's PDU to a request's PDU: never empty, an exception answer where the request is refused."""
    try:
        if pdu[0] not in registers.functions:
            raise Refused(ILLEGAL_FUNCTION)
        request = parse_request(pdu)
        if request.read_count:
            registers.check_read(request.read_address, request.read_count)
        if request.values:
            registers.write(request.write_address, request.values, now_s)
        if not request.read_count:
            # 6 answers address and value, 16 address and count: the first four bytes of the request for both.
            return pdu[:5]
        data = registers.read(request.read_address, request.read_count, now_s)
        return bytes((pdu[0], len(data))) + data
    except Refused as refusal:
        return exception_answer(pdu[0], refusal.code)


def exception_answer(function: int, code: int) -> bytes:
    """The PDU of an exception answer."""
    return bytes((function | 0x80, code))


def _parse_read(body: bytes) -> Request:
    address, count = _TWO_WORDS.unpack(body)
    return Request(read_address=address, read_count=_checked(count, MAX_READ))


def _parse_write_one(body: bytes) -> Request:
    address, value = _TWO_WORDS.unpack(body)
    return Request(write_address=address, values=(value,))


def _parse_write_many(body: bytes) -> Request:
    address, count, size = _MANY_HEAD.unpack_from(body)
    values = _values(body[_MANY_HEAD.size :], _checked(count, MAX_WRITE), size)
    return Request(write_address=address, values=values)


def _parse_read_write(body: bytes) -> Request:
    read_address, read_count, write_address, write_count, size = _READ_WRITE_HEAD.unpack_from(body)
    _checked(read_count, MAX_READ)
    values = _values(body[_READ_WRITE_HEAD.size :], _checked(write_count, MAX_WRITE_OF_READ_WRITE), size)
    return Request(read_address, read_count, write_address, values)


def _checked(count: int, highest: int) -> int:
    if not 1 <= count <= highest:
        raise Refused(ILLEGAL_VALUE)
    return count


def _values(data: bytes, count: int, size: int) -> tuple[int, ...]:
    if size != 2 * count:
        raise Refused(ILLEGAL_VALUE)
    return struct.unpack(f">{count}H", data)


_PARSERS = {
    READ_HOLDING: _parse_read,
    READ_INPUT: _parse_read,
    WRITE_ONE: _parse_write_one,
    WRITE_MANY: _parse_write_many,
    READ_WRITE: _parse_read_write,
}
