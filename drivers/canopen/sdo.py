"""Service data on one CAN bus: the canopen library's SDO client, fed from our own reader.

The library waits in a worker thread, so a transfer never costs the loop time; the threads are the bus's own, so that
nodes that do not answer hold up nothing else. It is given SDO frames only: if it saw PDOs it would keep their last
values, and on interfaces that echo, its own commands.
"""

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import canopen
from canopen.sdo.client import SdoClient

SDO_TIMEOUT_S = 0.2
THREADS = 8  #: nodes that are asked at the same time

# A failed transfer is reported by whoever asked for it; the library need not print it as well.
logging.getLogger("canopen").addHandler(logging.NullHandler())

_REQUEST = 0x600  #: COB-ID of node 0, client to server
_RESPONSE = 0x580


class SdoFailed(Exception):
    """A transfer that did not take place: no answer, or an abort. The text names object and cause."""


class SdoSilent(SdoFailed):
    """No answer."""


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
        self._network = _Network(send)
        self._clients: dict[int, SdoClient] = {}
        self._one_at_a_time: dict[int, asyncio.Lock] = {}
        self._threads: ThreadPoolExecutor | None = None  #: from the first transfer to `close`
        self._under_way: set[asyncio.Future[bytes | None]] = set()
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
        if len(data) == 8:
            self._network.notify(cob_id, bytearray(data), now_s)

    async def upload(self, node: int, index: int, sub: int, size: int) -> bytes:
        """The `size` bytes of an object, or as many as came. Raises SdoFailed.

        A server that does not state the size (CiA 301, 7.2.4.3.6: s = 0) sends four bytes: surplus zeros are no data.
        """
        data = await self._run(node, index, sub, lambda client: client.upload(index, sub))
        return data if any(data[size:]) else data[:size]

    async def download(self, node: int, index: int, sub: int, data: bytes) -> None:
        """Write an object. Raises SdoFailed."""
        await self._run(node, index, sub, lambda client: client.download(index, sub, data))

    async def _run(self, node: int, index: int, sub: int, transfer: Callable[[SdoClient], bytes | None]) -> bytes:
        lock = self._one_at_a_time[node]
        await lock.acquire()
        self._threads = self._threads or ThreadPoolExecutor(THREADS, thread_name_prefix="sdo")
        loop = asyncio.get_running_loop()
        work: asyncio.Future[bytes | None] = loop.run_in_executor(self._threads, transfer, self._clients[node])
        self._under_way.add(work)

        def over(done: asyncio.Future[bytes | None]) -> None:
            lock.release()
            self._under_way.discard(done)
            if not done.cancelled():
                done.exception()  # whoever asked may have gone; that is no error of the loop's

        # A transfer in its thread cannot be taken back. The next one on this node waits for its end, or would get its
        # answer; whoever is cancelled does not.
        work.add_done_callback(over)
        try:
            return await asyncio.shield(work) or b""
        except canopen.SdoAbortedError as error:
            raise SdoFailed(f"object {index:04X}h sub {sub}: the device aborted: {error}") from error
        except canopen.SdoCommunicationError as error:
            raise SdoSilent(f"object {index:04X}h sub {sub}: {error}") from error

    async def close(self) -> None:
        """End the threads, after what is under way: a timeout at most where nothing is received more. Idempotent."""
        while self._under_way:
            await asyncio.wait(self._under_way)
        threads, self._threads = self._threads, None
        if threads is not None:
            threads.shutdown()
