"""The one file that knows pymodbus: a TCP connection on which answers are believed only when they fit the question.

pymodbus takes answers of a wrong function, with too few or too many registers, without an error; here they are
refused. It is not asked to repeat anything or to reconnect by itself: a late answer would pass for a fresh one, and
when to reconnect is the link's decision.

The request of a cycle (`begin`) is sent and answered on the same connection without pymodbus's objects, futures and
timeouts, which would take as long as the control cycle has. It has pymodbus's transaction numbers.
"""

import asyncio
import logging
import socket
import struct
from collections.abc import Awaitable, Callable
from typing import NamedTuple

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusException
from pymodbus.pdu import ModbusPDU

from drivers.receive_buffer import ReceiveBuffer

CONNECT_TIMEOUT_S = 0.5
RECEIVE_BYTES = 2048  #: at a time; a frame has 260 at most, and pymodbus keeps 516

_HEAD = struct.Struct(">HHHB")  #: of a frame: transaction, protocol (0), bytes from the unit on, unit
_EXCEPTION = 0x80  #: in a function code

# What goes wrong is counted and named in the link's health; it does not belong on the terminal as well.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())


class ModbusFailed(Exception):
    """No usable answer; the text says why. `exception_code` is what the device refused it with, where it did."""

    def __init__(self, text: str, exception_code: int | None = None) -> None:
        super().__init__(text)
        self.exception_code = exception_code


class ModbusTimeout(ModbusFailed):
    """No answer in time, or no connection."""


OnEnd = Callable[[bytes | ModbusFailed], None]  #: given the registers of an answer, or why there are none


class _Begun(NamedTuple):
    """A request of a cycle that is under way."""

    transaction: int
    unit: int
    function: int
    registers: int  #: that are asked for
    on_end: OnEnd
    timer: asyncio.TimerHandle


class ModbusConnection:
    """One TCP connection. Requests are answered in turn; `deadline_s` is on the event loop's clock."""

    def __init__(self, host: str, port: int) -> None:
        self.where = f"{host}:{port}"
        self.answers = 0  #: on this connection, of whatever content
        self.number = 0  #: of this connection; every attempt to make one counts
        self._host, self._port = host, port
        self._client: AsyncModbusTcpClient | None = None
        self._begun: _Begun | None = None
        self._waiting = 0  #: requests that are under way in pymodbus, or wait for one of a cycle to end
        self._free = asyncio.Event()  #: none of a cycle is under way
        self._free.set()

    @property
    def connected(self) -> bool:
        return self._client is not None and self._client.connected

    @property
    def under_way(self) -> bool:
        """Whether a request of a cycle is."""
        return self._begun is not None

    async def connect(self) -> bool:
        """Try once, afresh: nothing of an earlier connection is left that could be mistaken for an answer."""
        self.close()
        self.answers = 0
        self.number += 1
        self._client = AsyncModbusTcpClient(
            self._host, port=self._port, timeout=CONNECT_TIMEOUT_S, retries=0, reconnect_delay=0
        )
        self._receive_with(self._client)
        if not await self._client.connect():
            return False
        transport = self._client.ctx.transport
        if isinstance(transport, asyncio.Transport):
            transport.set_protocol(ReceiveBuffer(self._client.ctx, RECEIVE_BYTES))
        return True

    def close(self) -> None:
        """Drop the connection at once, and with it what the other side has not taken yet. Idempotent."""
        self._end_begun()
        client, self._client = self._client, None
        if client is None:
            return
        transport = client.ctx.transport
        if isinstance(transport, asyncio.Transport):
            # Requests that wait for a peer that has stopped must not come to life when it goes on.
            tcp = transport.get_extra_info("socket")
            tcp.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            transport.abort()
        client.close()

    async def read(self, function: int, unit: int, address: int, count: int, deadline_s: float) -> list[int]:
        """Function 3 or 4: `count` registers. Raises ModbusFailed."""

        def ask(client: AsyncModbusTcpClient) -> Awaitable[ModbusPDU]:
            read = client.read_input_registers if function == 4 else client.read_holding_registers
            return read(address, count=count, device_id=unit)

        return _registers(await self._answer(ask, function, deadline_s), count)

    async def write(self, unit: int, address: int, registers: list[int], deadline_s: float) -> None:
        """Function 16. Raises ModbusFailed."""
        answer = await self._answer(
            lambda client: client.write_registers(address, registers, device_id=unit), 16, deadline_s
        )
        if (answer.address, answer.count) != (address, len(registers)):
            raise ModbusFailed(f"{len(registers)} registers written at {address}, {answer.count} confirmed")

    async def read_write(
        self, unit: int, address: int, count: int, write_address: int, registers: list[int], deadline_s: float
    ) -> list[int]:
        """Function 23: writes, then reads `count` registers, in one transaction. Raises ModbusFailed."""

        def ask(client: AsyncModbusTcpClient) -> Awaitable[ModbusPDU]:
            return client.readwrite_registers(
                read_address=address, read_count=count, write_address=write_address, values=registers, device_id=unit
            )

        return _registers(await self._answer(ask, 23, deadline_s), count)

    def _connection(self) -> AsyncModbusTcpClient:
        if self._client is None or not self._client.connected:
            raise ModbusTimeout("not connected")
        # pymodbus forgets what came unasked. After whole frames (an answer came twice) the stream is as it was;
        # the rest of half a frame would be taken for the beginning of the next. What comes for a request of a cycle
        # was asked for, also while half of it is there.
        if self._begun is None and not _whole_frames(self._client.ctx.recv_buffer):
            self.close()
            raise ModbusTimeout("connection dropped: half a frame came unasked")
        return self._client

    async def _in_turn(self, ask: Callable[[AsyncModbusTcpClient], Awaitable[ModbusPDU]]) -> ModbusPDU:
        self._connection()
        number = self.number
        self._waiting += 1
        try:
            await self._free.wait()
            if number != self.number:
                raise ModbusTimeout("connection lost")
            return await ask(self._connection())
        finally:
            self._waiting -= 1

    async def _answer(
        self, ask: Callable[[AsyncModbusTcpClient], Awaitable[ModbusPDU]], function: int, deadline_s: float
    ) -> ModbusPDU:
        try:
            async with asyncio.timeout_at(deadline_s):
                answer = await self._in_turn(ask)
        except TimeoutError as error:
            self._drop_half_a_frame()
            raise ModbusTimeout("no answer in time") from error
        except ConnectionException as error:
            self.close()
            raise ModbusTimeout("connection lost") from error
        except (ModbusException, OSError) as error:
            self.close()
            raise ModbusFailed(str(error)) from error
        self.answers += 1
        if self._client is not None and answer.transaction_id != self._client.ctx.request_transaction_id:
            raise ModbusFailed(f"answer to transaction {answer.transaction_id}")  # pymodbus takes a 0 for any
        if answer.isError():
            code = answer.exception_code
            raise ModbusFailed(f"exception {code} to function {function}", code)
        if answer.function_code != function:
            raise ModbusFailed(f"answer of function {answer.function_code} to function {function}")
        return answer

    # the request of a cycle

    def begin(self, unit: int, request: bytes, registers: int, deadline_s: float, on_end: OnEnd) -> bool:
        """Send a request (function code and data) that is answered with `registers` registers.

        `on_end` is called once, later, when it ends, unless the connection is closed before. False, and nothing is
        sent, when another request is under way, or when the connection cannot be used.
        """
        if self._begun is not None or self._waiting or self._client is None or not self._client.connected:
            return False
        context = self._client.ctx
        if not _whole_frames(context.recv_buffer):
            return False
        transaction = context.getNextTID()
        # What pymodbus compares answers with: one that comes late must not fit its next request.
        context.request_transaction_id, context.request_dev_id = transaction, unit
        timer = asyncio.get_running_loop().call_at(deadline_s, self._no_answer)
        self._begun = _Begun(transaction, unit, request[0], registers, on_end, timer)
        self._free.clear()
        context.send(_HEAD.pack(transaction, 0, len(request) + 1, unit) + request)
        return True

    async def until_free(self) -> None:
        """Wait for the end of a request of a cycle."""
        await self._free.wait()

    def _receive_with(self, client: AsyncModbusTcpClient) -> None:
        """Have what comes for a request of a cycle read here, and by pymodbus what comes for its own."""
        of_pymodbus = client.ctx.callback_data

        def callback_data(data: bytes, addr: tuple[str, int] | None = None) -> int:
            """The number of bytes that were used, as pymodbus wants it."""
            return of_pymodbus(data, addr) if self._begun is None else self._read_answer(self._begun, data)

        client.ctx.callback_data = callback_data

    def _read_answer(self, begun: _Begun, data: bytes) -> int:
        used = 0
        while len(data) - used > _HEAD.size:
            transaction, protocol, length, unit = _HEAD.unpack_from(data, used)
            end = used + _HEAD.size - 1 + length
            if protocol or length < 2 or end > len(data):
                break  # no frame, or half a frame: told when no more has come in time
            frame = data[used + _HEAD.size : end]
            used = end
            if unit == begun.unit and transaction in (begun.transaction, 0):
                self.answers += 1
                self._end_begun()
                begun.on_end(_judged(begun, transaction, frame))
                break
        return used

    def _no_answer(self) -> None:
        begun = self._begun
        if begun is not None:
            self._end_begun()
            self._drop_half_a_frame()
            begun.on_end(ModbusTimeout("no answer in time"))

    def _end_begun(self) -> None:
        if self._begun is not None:
            self._begun.timer.cancel()
            self._begun = None
            self._free.set()

    def _drop_half_a_frame(self) -> None:
        """After half an answer the stream cannot be trusted any more; a merely late one is told by its number.

        While a request of a cycle is under way it may be half of its answer, which has until that request's deadline.
        """
        if self._begun is None and self._client is not None and self._client.ctx.recv_buffer:
            self.close()


def _whole_frames(data: bytes) -> bool:
    """Whether `data` is any number of Modbus TCP frames, the last one complete."""
    while data:
        if len(data) < 8 or data[2:4] != b"\0\0":
            return False
        end = 6 + int.from_bytes(data[4:6], "big")
        if not 8 <= end <= len(data):
            return False
        data = data[end:]
    return True


def _judged(begun: _Begun, transaction: int, frame: bytes) -> bytes | ModbusFailed:
    """The registers in the answer to `begun` (function code and data), or what is wrong with it."""
    if transaction != begun.transaction:
        return ModbusFailed(f"answer to transaction {transaction}")
    if frame[0] == begun.function | _EXCEPTION and len(frame) == 2:
        return ModbusFailed(f"exception {frame[1]} to function {begun.function}", frame[1])
    if frame[0] != begun.function:
        return ModbusFailed(f"answer of function {frame[0]} to function {begun.function}")
    size = 2 * begun.registers
    if len(frame) != 2 + size or frame[1] != size:
        return ModbusFailed(f"{len(frame) - 2} bytes of registers, asked for {size}")
    return frame[2:]


def _registers(answer: ModbusPDU, count: int) -> list[int]:
    if len(answer.registers) != count:
        raise ModbusFailed(f"{len(answer.registers)} registers, asked for {count}")
    return list(answer.registers)
