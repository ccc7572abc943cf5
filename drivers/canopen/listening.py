"""What goes over a CAN bus without being asked for: who sends what how often, and how full the wire is. No I/O."""

from dataclasses import dataclass

from drivers.canopen.station import BOOT_UP, OPERATIONAL, PRE_OPERATIONAL, STOPPED
from gateway.core.can_load import frame_bits

HEARTBEAT = 0x700  #: COB-ID of node 0
EMERGENCY = 0x080
_NMT, _SYNC, _TIME = 0x000, 0x080, 0x100
#: Function codes (the upper four bits of a COB-ID) of the predefined connection set, CiA 301, 7.3.3.
_FUNCTIONS = {
    0x1: "EMCY",
    0x3: "TPDO1",
    0x4: "RPDO1",
    0x5: "TPDO2",
    0x6: "RPDO2",
    0x7: "TPDO3",
    0x8: "RPDO3",
    0x9: "TPDO4",
    0xA: "RPDO4",
    0xB: "SDO answer",
    0xC: "SDO request",
    0xE: "heartbeat",
}
_BROADCASTS = {_NMT: "NMT command", _SYNC: "SYNC", _TIME: "time stamp"}
_NMT_NAMES = {
    BOOT_UP: "boot-up",
    STOPPED: "stopped",
    OPERATIONAL: "operational",
    PRE_OPERATIONAL: "pre-operational",
}
_FROM_A_MASTER = (0x4, 0x6, 0x8, 0xA, 0xC)  #: function codes of what a master sends to a node


@dataclass(slots=True)
class Seen:
    """Frames of one COB-ID."""

    first_s: float
    last_s: float
    count: int = 0
    bits: int = 0

    @property
    def rate_hz(self) -> float | None:
        """None for a single frame."""
        return (self.count - 1) / (self.last_s - self.first_s) if self.last_s > self.first_s else None


def in_words(cob_id: int) -> str:
    """What a COB-ID is by the predefined connection set: "TPDO1 of node 3"."""
    node, function = cob_id & 0x7F, _FUNCTIONS.get(cob_id >> 7)
    if cob_id in _BROADCASTS:
        return _BROADCASTS[cob_id]
    return f"{function} of node {node}" if function and node else "not of the predefined connection set"


class Listening:
    """Fed with every frame that was heard, until somebody is asked something."""

    def __init__(self) -> None:
        self.frames: dict[int, Seen] = {}
        self.nmt_states: dict[int, int] = {}  #: by node, from its heartbeats
        self.emergencies: dict[int, bytes] = {}  #: the last by node

    def on_frame(self, cob_id: int, data: bytes | bytearray, now_s: float) -> None:
        seen = self.frames.setdefault(cob_id, Seen(now_s, now_s))
        seen.last_s = now_s
        seen.count += 1
        seen.bits += frame_bits(len(data))
        node = cob_id & 0x7F
        if node and cob_id & ~0x7F == HEARTBEAT and len(data) == 1:
            self.nmt_states[node] = data[0] & 0x7F
        elif node and cob_id & ~0x7F == EMERGENCY and len(data) == 8:
            self.emergencies[node] = bytes(data)

    def load(self, bitrate_bit_per_s: int, listened_s: float, *, without: frozenset[int] = frozenset()) -> float:
        """Fraction of the wire, with worst-case stuffing; of the frames whose node is not in `without`."""
        bits = sum(seen.bits for cob_id, seen in self.frames.items() if (cob_id & 0x7F) not in without)
        return bits / (bitrate_bit_per_s * listened_s)

    def master(self) -> str:
        """What shows that somebody commands or asks the nodes already; empty where nothing does."""
        signs = [in_words(c) for c in sorted(self.frames) if c in (_NMT, _SYNC) or c >> 7 in _FROM_A_MASTER]
        return ", ".join(signs[:3]) + (", ..." if len(signs) > 3 else "")

    def state_of(self, node: int) -> str:
        """Its NMT state in words; empty when no heartbeat was heard."""
        state = self.nmt_states.get(node)
        return "" if state is None else _NMT_NAMES.get(state, f"state {state:02X}h")
