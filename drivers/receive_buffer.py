"""What arrives on a stream, by way of one buffer that stays."""

import asyncio
from typing import Protocol


class Receiver(Protocol):
    """What a transport calls in an `asyncio.Protocol`, as far as a client's is concerned."""

    def data_received(self, data: bytes, /) -> None: ...
    def eof_received(self) -> bool | None: ...
    def connection_lost(self, exc: Exception | None, /) -> None: ...


class ReceiveBuffer(asyncio.BufferedProtocol):
    """Give `receiver` what its transport receives, at most `size` bytes at a time. Hand it to `transport.set_protocol`.

    asyncio asks for 256 KiB for each piece that it reads and gives back all but the few bytes that came. Whatever is
    allocated meanwhile and lives a little longer lies in the middle of that room, the next piece needs room elsewhere,
    and the heap grows though nothing is in use. See docs/kinds/memory.md.
    """

    def __init__(self, receiver: Receiver, size: int) -> None:
        self._receiver = receiver
        self._view = memoryview(bytearray(size))

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._view

    def buffer_updated(self, nbytes: int) -> None:
        self._receiver.data_received(bytes(self._view[:nbytes]))

    def eof_received(self) -> bool | None:
        return self._receiver.eof_received()

    def connection_lost(self, exc: Exception | None) -> None:
        self._receiver.connection_lost(exc)
