"""What every node on the bus has, whatever it does: NMT state, heartbeat, emergency, answers to SYNC. No I/O."""

import struct

from drivers.canopen.emergencies import Emergency, EmergencyClass, class_of
from drivers.canopen.map_parts import EmergencyClasses, HeartbeatObject, Watchdog
from drivers.scaling import si_per_count
from gateway.core.finding import Finding, finding

HEARTBEATS_ALLOWED = 1.5  #: producer times without a heartbeat until a node that the line depends on counts as lost
HEARTBEATS_ALLOWED_AT_REST = 3.0  #: the same while nothing moves by it
STATUSWORDS_AWAITED = 2  #: until an emergency is a warning: the first one may have been taken before it
ANSWERS_ALLOWED = 3  #: SYNCs in a row without an answer until a node counts as absent

BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
START, ENTER_PRE_OPERATIONAL = 0x01, 0x80  #: NMT commands
_NMT = 0x000  #: COB-ID
_NMT_NAMES = {BOOT_UP: "boot-up", STOPPED: "stopped", OPERATIONAL: "operational", PRE_OPERATIONAL: "pre-operational"}
_EMCY = struct.Struct("<HB5s")


def nmt_frame(command: int, node: int) -> tuple[int, bytes]:
    """COB-ID and payload of an NMT command."""
    return _NMT, bytes((command, node))


class Station:
    """One node. `frames` are the PDOs that it sends with every SYNC; with `has_statusword` its statusword says whether

    it is in fault. `distrust` is why it is not relied on until the next `prepare`, None while there is no reason.
    """

    def __init__(
        self,
        name: str,
        node: int,
        heartbeat: HeartbeatObject,
        frames: int = 1,
        watchdog: Watchdog | None = None,
        *,
        classes: EmergencyClasses | None = None,
        has_statusword: bool = False,
    ) -> None:
        self.name = name
        self.node = node
        self.fed = watchdog is not None  #: it has a watchdog that our commands feed
        #: The number under which its watchdog expects our heartbeat; None: it expects receive PDOs, or nothing.
        self.listens_to = watchdog.node if watchdog is not None and watchdog.kind == "heartbeat-consumer" else None
        self.heartbeat_s = heartbeat.value * si_per_count(heartbeat.unit, 1.0)
        self._patience_s = HEARTBEATS_ALLOWED * self.heartbeat_s
        self._patience_at_rest_s = HEARTBEATS_ALLOWED_AT_REST * self.heartbeat_s
        self.nmt_state: int | None = None
        self.heard_s: float | None = None
        self.boot_ups = 0
        self.heartbeats = 0  #: heard, boot-ups among them
        self.supervised = False  #: must stay operational
        self.emergency: Finding | None = None  #: of the class fault
        self.warning: Emergency | None = None  #: of the class warning
        self._classes = EmergencyClasses() if classes is None else classes
        self._has_statusword = has_statusword
        self.undecided: Emergency | None = None  #: its statusword has to say what it means
        self._statuswords = 0  #: since
        self.distrust: Finding | None = None
        self.dropped = False  #: was lost while supervised: not fed any more, so that its own watchdog can fire
        self.withheld = False  #: not fed, to see its watchdog fire
        self.serial = ""  #: number, as it was read last; empty: it tells none
        self.missed = 0  #: SYNCs in a row that it did not answer in full
        self.awaited = False  #: its answer to the present SYNC is waited for
        self._frames = frames
        self._came = 0  #: frames of the answer to the present SYNC
        self._heard_again = False  #: it answered, though too late, while it was absent

    # what arrives

    def on_frame(self) -> None:
        """A PDO of the answer to the present SYNC came and was understood."""
        self._came += 1
        if self.answered:
            self.missed = 0

    def on_late_frame(self) -> None:
        """A PDO outside its cycle. Its sample is not used; who was absent is waited for again."""
        self._heard_again = True

    def on_heartbeat(self, data: bytes | bytearray, now_s: float) -> None:
        """A heartbeat or boot-up message. Raises ValueError for a wrong length."""
        if len(data) != 1:
            raise ValueError(f"a heartbeat has 1 byte, this one {len(data)}")
        self.nmt_state = data[0] & 0x7F
        self.heard_s = now_s
        self.heartbeats += 1
        self.boot_ups += self.nmt_state == BOOT_UP
        if not self.supervised or self.dropped:
            return
        if self.nmt_state == BOOT_UP:
            self.distrust = finding("device-restarted", device=self.name)
        elif self.nmt_state != OPERATIONAL:
            self.distrust = finding("node-left-operational", device=self.name, state=self.state_name)

    def heard(self, now_s: float) -> None:
        """It showed life in another way than by its heartbeat."""
        self.heard_s = now_s

    def on_emergency(self, data: bytes | bytearray) -> None:
        """An EMCY message; code 00xxh takes the last one back. Raises ValueError for a wrong length."""
        if len(data) != _EMCY.size:
            raise ValueError(f"an EMCY has 8 bytes, this one {len(data)}")
        emergency = Emergency(*_EMCY.unpack(data))
        self.undecided, self._statuswords = None, 0
        if not emergency.code >> 8:
            self.emergency = self.warning = None
            return
        match class_of(emergency, self._classes, has_statusword=self._has_statusword):
            case EmergencyClass.FAULT:
                self.emergency = emergency.of(self.name)
            case EmergencyClass.WARNING:
                self.warning = emergency
            case EmergencyClass.AS_STATUSWORD:
                self.undecided = emergency

    def on_statusword(self, *, in_fault: bool) -> None:
        """What its statusword says of an emergency that it has sent."""
        if self.undecided is None:
            return
        self._statuswords += 1
        if in_fault:
            self.emergency, self.undecided = self.undecided.of(self.name), None
        elif self._statuswords >= STATUSWORDS_AWAITED:
            self.warning, self.undecided = self.undecided, None

    @property
    def emergency_told(self) -> Finding | None:
        """What its last emergency message said, whatever it means; None where that is over."""
        said = self.undecided or self.warning
        return self.emergency or (said.of(self.name) if said is not None else None)

    @property
    def state_name(self) -> str:
        """Its NMT state as it said it last, in words; empty where it has not."""
        return "" if self.nmt_state is None else _NMT_NAMES.get(self.nmt_state, f"{self.nmt_state:#x}")

    def recover(self) -> None:
        """What it told in emergency messages is over."""
        self.emergency = self.warning = self.undecided = None

    # the cycle

    @property
    def answered(self) -> bool:
        """Whether the present SYNC is answered in full."""
        return self._came >= self._frames

    def begin_sync(self) -> None:
        self._came = 0
        self.awaited = self.missed < ANSWERS_ALLOWED or self._heard_again
        self._heard_again = False

    def end_sync(self) -> None:
        self.missed += not self.answered

    def heartbeat_lost(self, now_s: float, relied_on: bool) -> bool:
        patience_s = self._patience_s if relied_on else self._patience_at_rest_s
        return self.heard_s is None or now_s - self.heard_s > patience_s

    def absent(self, now_s: float, relied_on: bool) -> bool:
        """Never heard, or lost. `relied_on`: something moves by it, so its heartbeats count strictly."""
        return self.missed >= ANSWERS_ALLOWED or self.heartbeat_lost(now_s, relied_on)

    def trouble(self, now_s: float, relied_on: bool) -> Finding | None:
        """What is wrong with it; None when nothing is."""
        if self.heartbeat_lost(now_s, relied_on):
            return finding("heartbeat-lost", device=self.name)
        if self.missed >= ANSWERS_ALLOWED:
            return finding("sync-unanswered", device=self.name, syncs=self.missed)
        return self.distrust or self.emergency

    def drop(self, trouble: Finding) -> None:
        """It is lost, or cannot be relied on: not fed until the next `prepare`, so that its watchdog fires."""
        self.distrust = trouble
        self.dropped = True

    def forget(self) -> None:
        """Nothing that was true of the node before counts any more, except that it was heard."""
        self.supervised = False
        self.missed = 0
        self.distrust = None
        self.dropped = self.withheld = False
        self.undecided = None
        self._came = 0
