"""Service data on one CAN bus: questions to the nodes, without a thread where four bytes are enough.

An expedited transfer (CiA 301, 7.2.4.3) is one frame there and one back, which the loop can wait for as for any other.
A thread that waits would take the interpreter from the control cycle whenever it wakes. What is longer is left to the
canopen library's SDO client, which waits in a thread; nothing that is asked in production is. Those threads are the
bus's own, so that nodes that do not answer hold up nothing else. The library is given SDO frames only: if it saw PDOs
it would keep their last values, and on interfaces that echo, its own commands.
"""

import asyncio
import logging
import struct
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import canopen
from canopen.sdo.client import SdoClient

SDO_TIMEOUT_S = 0.2
THREADS = 8  #: nodes that are asked at the same time

# A failed transfer is reported by whoever asked for it; the library need not print it as well.
logging.getLogger("canopen").addHandler(logging.NullHandler())

_REQUEST = 0x600  #: COB-ID of node 0, client to server
_RESPONSE = 0x580

_EXPEDITED_BYTES = 4
_TRANSFER = struct.Struct("<BHB4s")  #: command, index, sub-index, data
_UPLOAD, _UPLOAD_ANSWER = 0x40, 0x40  #: commands without the bits that say how much data there is
_DOWNLOAD, _DOWNLOAD_ANSWER = 0x20, 0x60
_ABORT = 0x80
_COMMAND, _EXPEDITED, _SIZED = 0xE0, 0x02, 0x01
_TIMED_OUT, _NO_SEGMENTS = (code.to_bytes(4, "little") for code in (0x05040000, 0x08000000))

_NO_OBJECT = (0x06020000, 0x06090011)  #: abort codes: no such object, no such sub-index


class SdoFailed(Exception):
    """A transfer that did not take place: no answer, or an abort. The text names object and cause."""


class SdoNoObject(SdoFailed):
    """The device says that it has no such object."""


class SdoSilent(SdoFailed):
    """No answer, or none to what was asked."""


class _Client(SdoClient):
    RESPONSE_TIMEOUT = SDO_TIMEOUT_S


class _Network(canopen.Network):
    """The library's network without its bus and its threads."""

    def __init__(self, send: Callable[[int, bytes], bool]) -> None:
        super().__init__()
        self._send = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._send(can_id, bytes(data))


class SdoBus:
    """Raw uploads and downloads, one at a time per node: a node that does not answer costs the others nothing."""

    def __init__(self, send: Callable[[int, bytes], bool], nodes: list[int]) -> None:
        self._send = send
        self._network = _Network(send)
        self._clients: dict[int, SdoClient] = {}
        self._one_at_a_time: dict[int, asyncio.Lock] = {}
        self._waiting: dict[int, asyncio.Future[bytes]] = {}  #: by node, for the answer to an expedited transfer
        self._long: set[int] = set()  #: nodes to which the library talks
        self._threads: ThreadPoolExecutor | None = None  #: from the first long transfer to `close`
        self._under_way: set[asyncio.Future[Any]] = set()
        for node in nodes:
            client = _Client(_REQUEST + node, _RESPONSE + node, canopen.ObjectDictionary())
            client.network = self._network
            self._network.subscribe(_RESPONSE + node, client.on_response)
            self._clients[node] = client
            self._one_at_a_time[node] = asyncio.Lock()

    def response_cob_ids(self) -> list[int]:
        return [_RESPONSE + node for node in self._clients]

    def on_frame(self, cob_id: int, data: bytes | bytearray, now_s: float) -> None:
        """An SDO response. One that is not 8 bytes long is no SDO frame and is not passed on."""
        if len(data) != _TRANSFER.size:
            return
        node = cob_id - _RESPONSE
        if node in self._long:
            self._network.notify(cob_id, bytearray(data), now_s)
        elif (waiting := self._waiting.get(node)) is not None and not waiting.done():
            waiting.set_result(bytes(data))
            if data[0] & (_COMMAND | _EXPEDITED) == _UPLOAD_ANSWER:
                # In segments, for which nobody will ask. Now: the next request goes out when this has returned.
                self._send(_REQUEST + node, bytes((_ABORT,)) + data[1:4] + _NO_SEGMENTS)

    async def upload(self, node: int, index: int, sub: int, size: int) -> bytes:
        """The `size` bytes of an object, or as many as came. Raises SdoFailed.

        A server that does not state the size (CiA 301, 7.2.4.3.6: s = 0) sends four bytes: surplus zeros are no data.
        """
        data = await self._upload_expedited(node, index, sub) if size <= _EXPEDITED_BYTES else None
        if data is None:
            data = await self._in_thread(node, index, sub, lambda client: client.upload(index, sub)) or b""
        return data if any(data[size:]) else data[:size]

    async def download(self, node: int, index: int, sub: int, data: bytes) -> None:
        """Write an object. Raises SdoFailed."""
        if not 0 < len(data) <= _EXPEDITED_BYTES:
            await self._in_thread(node, index, sub, lambda client: client.download(index, sub, data))
            return
        command = _DOWNLOAD | (_EXPEDITED_BYTES - len(data)) << 2 | _EXPEDITED | _SIZED
        answered, _ = await self._exchange(node, index, sub, command, data)
        if answered & _COMMAND != _DOWNLOAD_ANSWER:
            raise SdoSilent(f"object {index:04X}h sub {sub}: Unexpected response 0x{answered:02X}")

    async def _upload_expedited(self, node: int, index: int, sub: int) -> bytes | None:
        """None when the node wants to send it in segments. Raises SdoFailed."""
        answered, data = await self._exchange(node, index, sub, _UPLOAD, b"")
        if answered & _COMMAND != _UPLOAD_ANSWER:
            raise SdoSilent(f"object {index:04X}h sub {sub}: Unexpected response 0x{answered:02X}")
        if not answered & _EXPEDITED:
            return None
        return data[: _EXPEDITED_BYTES - (answered >> 2 & 3)] if answered & _SIZED else data

    async def _exchange(self, node: int, index: int, sub: int, command: int, data: bytes) -> tuple[int, bytes]:
        """Command and data of the answer to an expedited request. Raises SdoFailed."""
        await self._one_at_a_time[node].acquire()
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[bytes] = loop.create_future()

        def give_up() -> None:
            if not answer.done():
                self._send(_REQUEST + node, _TRANSFER.pack(_ABORT, index, sub, _TIMED_OUT))
                answer.set_exception(SdoSilent(f"object {index:04X}h sub {sub}: No SDO response received"))

        def over(_: asyncio.Future[bytes]) -> None:
            timer.cancel()
            del self._waiting[node]

        timer = loop.call_later(SDO_TIMEOUT_S, give_up)
        answer.add_done_callback(over)
        self._waiting[node] = answer
        self._keep(node, answer)
        try:
            self._send(_REQUEST + node, _TRANSFER.pack(command, index, sub, data))
        except BaseException:
            answer.cancel()
            raise
        answered, of_index, of_sub, found = _TRANSFER.unpack(await asyncio.shield(answer))
        if answered == _ABORT:
            (code,) = struct.unpack("<I", found)
            raise _aborted(index, sub, canopen.SdoAbortedError(code))
        if (of_index, of_sub) != (index, sub):
            raise SdoSilent(f"object {index:04X}h sub {sub}: answered was object {of_index:04X}h sub {of_sub}")
        return answered, found

    async def _in_thread(
        self, node: int, index: int, sub: int, transfer: Callable[[SdoClient], bytes | None]
    ) -> bytes | None:
        """By the library. Raises SdoFailed."""
        await self._one_at_a_time[node].acquire()
        self._threads = self._threads or ThreadPoolExecutor(THREADS, thread_name_prefix="sdo")
        self._long.add(node)
        loop = asyncio.get_running_loop()
        work: asyncio.Future[bytes | None] = loop.run_in_executor(self._threads, transfer, self._clients[node])
        work.add_done_callback(lambda _: self._long.discard(node))
        self._keep(node, work)
        try:
            return await asyncio.shield(work)
        except canopen.SdoAbortedError as error:
            raise _aborted(index, sub, error) from error
        except canopen.SdoCommunicationError as error:
            raise SdoSilent(f"object {index:04X}h sub {sub}: {error}") from error

    def _keep(self, node: int, transfer: asyncio.Future[Any]) -> None:
        """Until its end, whoever asked: a transfer cannot be taken back.

        The next one on this node waits for its end, or would get its answer; whoever is cancelled does not.
        """
        self._under_way.add(transfer)

        def over(done: asyncio.Future[Any]) -> None:
            self._one_at_a_time[node].release()
            self._under_way.discard(done)
            if not done.cancelled():
                done.exception()  # whoever asked may have gone; that is no error of the loop's

        transfer.add_done_callback(over)

    async def close(self) -> None:
        """End the threads, after what is under way: a timeout at most where nothing is received more. Idempotent."""
        while self._under_way:
            await asyncio.wait(self._under_way)
        threads, self._threads = self._threads, None
        if threads is not None:
            threads.shutdown()


def _aborted(index: int, sub: int, error: canopen.SdoAbortedError) -> SdoFailed:
    kind = SdoNoObject if error.code in _NO_OBJECT else SdoFailed
    return kind(f"object {index:04X}h sub {sub}: the device aborted: {error}")
