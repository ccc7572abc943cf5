"""The one file that knows pymodbus: a TCP connection on which answers are believed only when they fit the question.

pymodbus takes answers of a wrong function, with too few or too many registers, without an error; here they are
refused. It is not asked to repeat anything or to reconnect by itself: a late answer would pass for a fresh one, and
when to reconnect is the link's decision.
"""

import asyncio
import logging
import socket
import struct
from collections.abc import Awaitable

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusException
from pymodbus.pdu import ModbusPDU

CONNECT_TIMEOUT_S = 0.5

# What goes wrong is counted and named in the link's health; it does not belong on the terminal as well.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())


class ModbusFailed(Exception):
    """No usable answer; the text says why. `exception_code` is what the device refused it with, where it did."""

    def __init__(self, text: str, exception_code: int | None = None) -> None:
        super().__init__(text)
        self.exception_code = exception_code


class ModbusTimeout(ModbusFailed):
    """No answer in time, or no connection."""


class ModbusConnection:
    """One TCP connection. Requests are answered in turn; `deadline_s` is on the event loop's clock."""

    def __init__(self, host: str, port: int) -> None:
        self.where = f"{host}:{port}"
        self.answers = 0  #: on this connection, of whatever content
        self.number = 0  #: of this connection; every attempt to make one counts
        self._host, self._port = host, port
        self._client: AsyncModbusTcpClient | None = None

    @property
    def connected(self) -> bool:
        return self._client is not None and self._client.connected

    async def connect(self) -> bool:
        """Try once, afresh: nothing of an earlier connection is left that could be mistaken for an answer."""
        self.close()
        self.answers = 0
        self.number += 1
        self._client = AsyncModbusTcpClient(
            self._host, port=self._port, timeout=CONNECT_TIMEOUT_S, retries=0, reconnect_delay=0
        )
        return await self._client.connect()

    def close(self) -> None:
        """Drop the connection at once, and with it what the other side has not taken yet. Idempotent."""
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
        client = self._connection()
        ask = client.read_input_registers if function == 4 else client.read_holding_registers
        answer = await self._answer(ask(address, count=count, device_id=unit), function, deadline_s)
        return _registers(answer, count)

    async def write(self, unit: int, address: int, registers: list[int], deadline_s: float) -> None:
        """Function 16. Raises ModbusFailed."""
        request = self._connection().write_registers(address, registers, device_id=unit)
        answer = await self._answer(request, 16, deadline_s)
        if (answer.address, answer.count) != (address, len(registers)):
            raise ModbusFailed(f"{len(registers)} registers written at {address}, {answer.count} confirmed")

    async def read_write(
        self, unit: int, address: int, count: int, write_address: int, registers: list[int], deadline_s: float
    ) -> list[int]:
        """Function 23: writes, then reads `count` registers, in one transaction. Raises ModbusFailed."""
        request = self._connection().readwrite_registers(
            read_address=address, read_count=count, write_address=write_address, values=registers, device_id=unit
        )
        return _registers(await self._answer(request, 23, deadline_s), count)

    def _connection(self) -> AsyncModbusTcpClient:
        if self._client is None or not self._client.connected:
            raise ModbusTimeout("not connected")
        # pymodbus forgets what came unasked. After whole frames (an answer came twice) the stream is as it was;
        # the rest of half a frame would be taken for the beginning of the next.
        if not _whole_frames(self._client.ctx.recv_buffer):
            self.close()
            raise ModbusTimeout("connection dropped: half a frame came unasked")
        return self._client

    async def _answer(self, request: Awaitable[ModbusPDU], function: int, deadline_s: float) -> ModbusPDU:
        try:
            async with asyncio.timeout_at(deadline_s):
                answer = await request
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

    def _drop_half_a_frame(self) -> None:
        """After half an answer the stream cannot be trusted any more; a merely late one is told by its number."""
        if self._client is not None and self._client.ctx.recv_buffer:
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


def _registers(answer: ModbusPDU, count: int) -> list[int]:
    if len(answer.registers) != count:
        raise ModbusFailed(f"{len(answer.registers)} registers, asked for {count}")
    return list(answer.registers)
