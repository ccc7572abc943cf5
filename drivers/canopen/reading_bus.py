"""A CAN bus that is listened to and asked: SDO uploads are all that can leave through it.

`CanBus` sends whatever it is given. Between it and the SDO client stands `_upload_only`, so that no mistake of an
inspection can command, configure or synchronise a node.
"""

import asyncio

from drivers.canopen.bus import CanBus
from drivers.canopen.listening import Listening
from drivers.canopen.map_parts import CanObject, ObjectType
from drivers.canopen.sdo import SdoBus, SdoFailed, SdoSilent
from drivers.canopen.transaction import read_number
from drivers.inspection import Number
from gateway.core.line import CanopenBus
from gateway.tasks.cleanup import finish

_REQUEST = 0x600  #: COB-ID of node 0
#: What an SDO client may say to upload (CiA 301, 7.2.4.3): begin, next segment with either toggle, abort.
_UPLOAD_COMMANDS = (0x40, 0x60, 0x70, 0x80)
_LONGEST_TEXT = 256  #: bytes


class ReadingBus:
    """`errors` are what the interface said of itself, each once, in the order of their coming."""

    def __init__(self, config: CanopenBus, nodes: list[int]) -> None:
        self.listening = Listening()
        self.errors: dict[str, None] = {}
        self.sdo = SdoBus(self._send, nodes)
        self._answers = set(self.sdo.response_cob_ids())
        self._asking = False
        # All identifiers: who is there is not known yet.
        self._bus = CanBus(config, range(0x800), self._on_frame, self._on_error)

    async def listen(self, listen_s: float) -> None:
        """Open the bus and count what comes for so long. Raises OSError with what to do about it."""
        self._bus.open()
        await asyncio.sleep(listen_s)
        self._bus.drain_all()

    @property
    def gone(self) -> str:
        """Why the interface cannot be used any more; empty while it can."""
        return self._bus.gone

    def ask(self) -> None:
        """From now on uploads are sent; what is heard is counted no more, or it would be our own."""
        self._asking = True

    async def number(self, node: int, entry: CanObject) -> Number:
        """The raw number in an object. Raises SdoSilent when the node does not answer at all."""
        try:
            return Number(await read_number(self.sdo, node, entry))
        except SdoSilent:
            raise
        except SdoFailed as error:
            return Number(None, str(error))

    async def object(self, node: int, index: int, sub: int, kind: ObjectType) -> Number:
        """The same for an object of a profile, which is in no map."""
        return await self.number(node, CanObject(index=index, sub=sub, type=kind))

    async def text(self, node: int, index: int) -> str:
        """A VISIBLE_STRING; empty where the device has none. Raises SdoSilent."""
        try:
            data = await self.sdo.upload(node, index, 0, _LONGEST_TEXT)
        except SdoSilent:
            raise
        except SdoFailed:  # objects 1008h to 100Ah are optional
            return ""
        return data[:_LONGEST_TEXT].split(b"\0")[0].decode("ascii", "replace").strip()

    async def close(self) -> None:
        """Release the interface. Idempotent; no cancellation cuts it."""
        await finish(self._close())

    async def _close(self) -> None:
        try:
            await self._bus.close()
        finally:
            await self.sdo.close()

    def _send(self, cob_id: int, data: bytes) -> bool:
        if not (_upload_only(cob_id, data) and self._asking):
            raise AssertionError(f"an inspection does not send {cob_id:03X}h {data.hex()}")
        return self._bus.send(cob_id, data)

    def _on_frame(self, cob_id: int, data: bytes | bytearray, now_s: float) -> None:
        if not self._asking:
            self.listening.on_frame(cob_id, data, now_s)
        elif cob_id in self._answers:
            self.sdo.on_frame(cob_id, data, now_s)

    def _on_error(self, text: str) -> None:
        self.errors.setdefault(text)


def _upload_only(cob_id: int, data: bytes) -> bool:
    return cob_id & ~0x7F == _REQUEST and cob_id != _REQUEST and len(data) == 8 and data[0] in _UPLOAD_COMMANDS
