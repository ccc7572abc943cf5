"""The object dictionary of one node and the SDO server over it: canopen's transfers, our objects."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

from canopen import Network
from canopen.objectdictionary import NUMBER_TYPES, ObjectDictionary, ODVariable
from canopen.objectdictionary.eds import import_eds
from canopen.sdo.constants import NO_MORE_DATA
from canopen.sdo.exceptions import SdoAbortedError
from canopen.sdo.server import SdoServer

from sim_plant.faces.canopen_pdo import Key

EDS_PATH = Path(__file__).parent.parent / "devices" / "r2r-drive.eds"

UNKNOWN_COMMAND = 0x05040001
OUT_OF_MEMORY = 0x05040005
WRITE_ONLY = 0x06010001
READ_ONLY = 0x06010002
NO_OBJECT = 0x06020000
WRONG_LENGTH = 0x06070010
NO_SUBINDEX = 0x06090011

#: No object of a node is longer: a segmented download that goes on is stopped here.
_LONGEST_DOWNLOAD = 64

Reader = Callable[[], float]
Writer = Callable[[int], None]


@cache
def drive_dictionary() -> ObjectDictionary:
    """The shipped EDS, read once for all drives, as of node 0: `relative` defaults grow by the node id."""
    return import_eds(str(EDS_PATH), 0)


class Objects:
    """The values of one node's object dictionary, keyed by (index, sub-index).

    An object has a reader (computed when asked), or a stored value, or the dictionary's default. A writer is
    called before a value is stored and refuses it by raising SdoAbortedError.
    """

    def __init__(self, node_id: int, dictionary: ObjectDictionary) -> None:
        self.object_dictionary = dictionary
        self.node_id = node_id
        self.readers: dict[Key, Reader] = {}
        self.writers: dict[Key, Writer] = {}
        self._stored: dict[Key, bytes] = {}

    def default(self, index: int, subindex: int = 0) -> int:
        """The number that the dictionary gives the object for this node."""
        variable = self._find(index, subindex)
        assert variable.default is not None, f"the dictionary gives {index:04X}h sub {subindex} no default"
        return variable.default + self.node_id * variable.relative

    def forget(self) -> None:
        """Back to the defaults."""
        self._stored.clear()

    def get_data(self, index: int, subindex: int, check_readable: bool = False) -> bytes:
        """What an SDO upload reads; called by canopen's server. Raises SdoAbortedError."""
        variable = self._find(index, subindex)
        if check_readable and not variable.readable:
            raise SdoAbortedError(WRITE_ONLY)
        key = (index, subindex)
        if reader := self.readers.get(key):
            return bytes(variable.encode_raw(reader()))
        if (stored := self._stored.get(key)) is not None:
            return stored
        if variable.data_type in NUMBER_TYPES:
            return bytes(variable.encode_raw(self.default(index, subindex)))
        return bytes(variable.encode_raw(variable.default or ""))

    def set_data(self, index: int, subindex: int, data: bytes, check_writable: bool = False) -> None:
        """What an SDO download writes; called by canopen's server. Raises SdoAbortedError."""
        variable = self._find(index, subindex)
        if check_writable and not variable.writable:
            raise SdoAbortedError(READ_ONLY)
        if 8 * len(data) != len(variable):  # every writable object is a number
            raise SdoAbortedError(WRONG_LENGTH)
        key = (index, subindex)
        if writer := self.writers.get(key):
            value = variable.decode_raw(bytes(data))
            assert isinstance(value, int)
            writer(value)
        self._stored[key] = bytes(data)

    def _find(self, index: int, subindex: int) -> ODVariable:
        entry = self.object_dictionary.indices.get(index)
        if entry is None:
            raise SdoAbortedError(NO_OBJECT)
        variable = entry if isinstance(entry, ODVariable) else entry.subindices.get(subindex)
        if variable is None or variable.subindex != subindex:
            raise SdoAbortedError(NO_SUBINDEX)
        return variable


class NodeSdoServer(SdoServer):
    """canopen's server, where a request out of order is aborted: the library's own runs into None there."""

    def __init__(self, node_id: int, objects: Objects, network: Network) -> None:
        super().__init__(0x600 + node_id, 0x580 + node_id, objects)
        self.network = network
        self._index = 0
        self._subindex = 0

    def segmented_upload(self, command: int) -> None:
        if self._buffer is None:
            raise SdoAbortedError(UNKNOWN_COMMAND)
        super().segmented_upload(command)
        if not self._buffer:
            self._buffer = None

    def segmented_download(self, command: int, request: bytes) -> None:
        if self._buffer is None:
            raise SdoAbortedError(UNKNOWN_COMMAND)
        if len(self._buffer) > _LONGEST_DOWNLOAD:
            raise SdoAbortedError(OUT_OF_MEMORY)
        super().segmented_download(command, request)
        if command & NO_MORE_DATA:
            self._buffer = None

    def abort(self, abort_code: int = 0x08000000) -> None:
        self._buffer = None
        super().abort(abort_code)

    def request_aborted(self, data: bytes) -> None:
        self._buffer = None
        super().request_aborted(data)
