"""When the kernel took what came in on a socket: a process that is late to read it does not change that.

What lies on a TCP connection together has one stamp: the kernel joins what comes before it is read. A client that
waits for its answer before it asks again is not concerned.
"""

import socket
import struct
from asyncio import trsock
from dataclasses import dataclass

_TIMESTAMP_NS = 35  #: SO_TIMESTAMPNS and its SCM_TIMESTAMPNS on Linux; `socket` does not name them
_TIMESPEC = struct.Struct("@ll")
STAMP_SPACE = socket.CMSG_SPACE(_TIMESPEC.size)  #: bytes of ancillary data that hold a stamp


@dataclass(frozen=True, slots=True)
class Stamp:
    """When something came in."""

    timestamp: float  #: wall clock, s; named as that of a CAN frame


def stamp_of(ancillary: list[tuple[int, int, bytes]]) -> Stamp | None:
    """The stamp in what `recvmsg` gives beside the data, where the socket has been told to stamp (SO_TIMESTAMPNS)."""
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, _TIMESTAMP_NS):
            seconds, nanoseconds = _TIMESPEC.unpack(data[: _TIMESPEC.size])
            return Stamp(seconds + nanoseconds * 1e-9)
    return None


class ArrivalStamps:
    """The stamps of one connection, on the wall clock. Holds a second descriptor of it until `close`."""

    def __init__(self, connection: trsock.TransportSocket) -> None:
        self._socket = connection.dup()
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, _TIMESTAMP_NS, 1)

    def next(self) -> Stamp | None:
        """When the byte that will be read next came in; None when the kernel has no stamp of it."""
        try:
            _, stamps, _, _ = self._socket.recvmsg(1, STAMP_SPACE, socket.MSG_PEEK)
        except OSError:  # nothing there, or the connection is broken: whoever reads it will be told
            return None
        return stamp_of(stamps)

    def close(self) -> None:
        self._socket.close()
