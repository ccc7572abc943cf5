"""The one request of a unit's cycle, as bytes: from cycle to cycle only what is written changes. No I/O."""

import struct
from collections.abc import Sequence

from drivers.modbus.plan import Request


class CyclicRequest:
    """A request that reads, and may write in the same transaction (function 23)."""

    def __init__(self, request: Request, read_function: int) -> None:
        assert request.read is not None
        self.registers_read = request.read[1]
        if request.write is None:
            self._head = struct.pack(">BHH", read_function, *request.read)
            self._written = struct.Struct("")
        else:
            count = request.write[1]
            self._head = struct.pack(">BHHHHB", 23, *request.read, *request.write, 2 * count)
            self._written = struct.Struct(f">{count}H")

    def encode(self, registers: Sequence[int]) -> bytes:
        """Function code and data; `registers` are what is written, none for one that only reads."""
        return self._head + self._written.pack(*registers)


def only(requests: Sequence[Request], read_function: int) -> CyclicRequest | None:
    """None where a transaction takes another request than one that reads."""
    if len(requests) != 1 or requests[0].read is None:
        return None
    return CyclicRequest(requests[0], read_function)
