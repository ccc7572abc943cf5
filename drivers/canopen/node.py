"""What the gateway knows of one drive on the bus. No I/O: frames and times come in, a DriveState comes out."""

import struct

from canopen.emcy import EmcyError

from drivers.canopen.configure import DriveSettings
from drivers.canopen.maps import DriveMap
from drivers.canopen.pdo import DriveSample, MalformedPdo, PdoCodec
from drivers.power_stage import PowerStage
from drivers.scaling import si_per_count
from gateway.core.signals import DriveState

HEARTBEATS_ALLOWED = 1.5  #: producer times without a heartbeat until a drive that may give torque counts as lost
HEARTBEATS_ALLOWED_AT_REST = 3.0  #: the same while it gives none and none is asked of it
ANSWERS_ALLOWED = 3  #: SYNCs in a row without an answer until a drive counts as absent

BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
_NMT_NAMES = {STOPPED: "stopped", OPERATIONAL: "operational", PRE_OPERATIONAL: "pre-operational"}
_EMCY = struct.Struct("<HB5s")


class DriveNode:
    """One drive. `distrust` is why it gets no torque until the next `prepare`, empty while there is no reason."""

    def __init__(self, name: str, index: int, device: DriveMap, settings: DriveSettings, radius_m: float) -> None:
        self.name = name
        self.index = index  #: roller - 1
        self.device = device
        self.settings = settings
        self.codec = PdoCodec(device, settings.rated_torque_nm, radius_m)
        heartbeat = device.heartbeat
        self.heartbeat_s = heartbeat.value * si_per_count(heartbeat.unit, 1.0)
        self.nmt_state: int | None = None
        self.heard_s: float | None = None
        self.sample: DriveSample | None = None  #: the answer to the present SYNC
        self.stage = PowerStage(device.follows_command)
        self.missed = 0  #: SYNCs in a row without an answer
        self.emergency = ""
        self.distrust = ""
        self.dropped = False  #: was lost while supervised: no RPDO any more, so that its own watchdog can fire
        self.awaited = False  #: its answer to the present SYNC is waited for
        self._heard_again = False  #: it answered, though too late, while it was absent
        self.boot_ups = 0
        self.supervised = False  #: must stay operational

    @property
    def node(self) -> int:
        return self.settings.node

    # what arrives

    def on_answer(self, data: bytes | bytearray) -> None:
        """The TPDO of the present SYNC. Raises MalformedPdo for a second one or a wrong length."""
        if self.sample is not None:
            raise MalformedPdo("a second answer to one SYNC")
        sample = self.codec.decode(data)
        self.sample = sample
        self.missed = 0
        self.stage.on_statusword(sample.statusword, sample.safe_torque_off)
        if self.stage.fault_was_reset:
            self.emergency = ""

    def on_late_answer(self, data: bytes | bytearray) -> None:
        """A TPDO outside its cycle. Its sample is not used; who was absent is waited for again. Raises MalformedPdo."""
        self.codec.decode(data)
        self._heard_again = True

    def on_heartbeat(self, data: bytes | bytearray, now_s: float) -> None:
        """A heartbeat or boot-up message. Raises ValueError for a wrong length."""
        if len(data) != 1:
            raise ValueError(f"a heartbeat has 1 byte, this one {len(data)}")
        self.nmt_state = data[0] & 0x7F
        self.heard_s = now_s
        self.boot_ups += self.nmt_state == BOOT_UP
        if not self.supervised or self.dropped:
            return
        if self.nmt_state == BOOT_UP:
            self.distrust = "restarted: its settings are lost, arm again"
        elif self.nmt_state != OPERATIONAL:
            self.distrust = f"left operational for {_NMT_NAMES.get(self.nmt_state, hex(self.nmt_state))}, arm again"

    def on_emergency(self, data: bytes | bytearray) -> None:
        """An EMCY message; code 00xxh takes the last one back. Raises ValueError for a wrong length."""
        if len(data) != _EMCY.size:
            raise ValueError(f"an EMCY has 8 bytes, this one {len(data)}")
        code, register, rest = _EMCY.unpack(data)
        text = EmcyError(code, register, rest, 0.0).get_desc()
        self.emergency = f"EMCY {code:04X}h {text}".rstrip() + f", error register {register:02X}h" if code >> 8 else ""

    # the cycle

    def begin_sync(self) -> None:
        self.sample = None
        self.awaited = self.missed < ANSWERS_ALLOWED or self._heard_again
        self._heard_again = False

    def end_sync(self) -> None:
        if self.sample is None:
            self.missed += 1

    def heartbeat_lost(self, now_s: float) -> bool:
        allowed = HEARTBEATS_ALLOWED if self.stage.gives_torque else HEARTBEATS_ALLOWED_AT_REST
        return self.heard_s is None or now_s - self.heard_s > allowed * self.heartbeat_s

    def state(self, now_s: float) -> DriveState:
        if self.heartbeat_lost(now_s) or self.missed >= ANSWERS_ALLOWED:
            return DriveState.ABSENT
        if self.distrust or self.emergency:
            return DriveState.FAULT
        return self.stage.state

    def drop(self, now_s: float) -> None:
        """It is lost: no RPDO until the next `prepare`, which would keep a watchdog fed that nobody listens behind."""
        self.distrust = f"{self.trouble(now_s)}; its torque was taken off, arm again"
        self.dropped = True

    def command(self, request: int, torque_nm: float, state: DriveState) -> bytes:
        """The RPDO towards `request`. A drive that is not trusted is told to take torque off.

        Raises ValueError when the torque cannot be commanded; nothing may be sent then.
        """
        word, given_nm = self.stage.command(request, torque_nm, state, trusted=not self.distrust)
        # Encoded also where it is not given: what cannot be commanded says that something is wrong.
        self.codec.encode(word, torque_nm)
        return self.codec.encode(word, given_nm)

    # prepare

    def forget(self) -> None:
        """Nothing that was true of the drive before counts any more, except that it was heard."""
        self.supervised = False
        self.sample = None
        self.stage.forget()
        self.missed = 0
        self.distrust = ""
        self.dropped = False

    def trouble(self, now_s: float) -> str:
        """What is wrong with it, for a person; empty when nothing is."""
        if self.heartbeat_lost(now_s):
            return "no heartbeat"
        if self.missed >= ANSWERS_ALLOWED:
            return f"no answer to {self.missed} SYNCs in a row"
        return self.distrust or self.emergency
