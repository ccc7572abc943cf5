"""One drive on the CANopen bus: NMT slave, heartbeat, PDOs, emergency messages, and the objects behind the SDOs.

The face hands it frames that are for it; it answers through `network.send_message`. Time is an argument.
"""

import struct
from collections.abc import Callable
from functools import partial
from math import inf

from canopen import Network
from canopen.sdo.exceptions import SdoAbortedError

from sim_plant.devices.drive import Drive, DriveSample
from sim_plant.faces.canopen_pdo import MAX_ENTRIES, OUT_OF_RANGE, Pdo
from sim_plant.faces.canopen_sdo import DriveSdoServer, Objects

INITIALISING = 0
STOPPED = 4
OPERATIONAL = 5
PRE_OPERATIONAL = 127

NMT_START = 1
NMT_STOP = 2
NMT_ENTER_PRE_OPERATIONAL = 128
NMT_RESET_NODE = 129
NMT_RESET_COMMUNICATION = 130

CYCLIC_SYNCHRONOUS_TORQUE = 10
NO_MODE = 0
QUICK_STOP_RAMP_THEN_OFF = 2
STO_ACTIVE = 1 << 16  #: in 60FDh
WATCHDOG_MS = range(10, 201)
SHORTEST_HEARTBEAT_MS = 10

_CONTROLWORD, _TARGET_TORQUE, _MODE = 0x6040, 0x6071, 0x6060
_RPDO_OBJECTS = {_CONTROLWORD: "H", _TARGET_TORQUE: "h", _MODE: "b"}
_TPDO_OBJECTS = {0x603F: "H", 0x6041: "H", 0x6061: "b", 0x606C: "i", 0x6077: "h", 0x60FD: "I"}
_EMERGENCY = struct.Struct("<HB5x")
_ERROR_HISTORY = 4
SHORT_RPDO = 0x8210  #: EMCY: a PDO with too few bytes, not processed
_INT16, _INT32 = 0x7FFF, 0x7FFFFFFF


class DriveNode:
    """The CANopen side of `drive`, as node `node_id`. Nothing is sent before `boot`."""

    def __init__(self, node_id: int, drive: Drive, network: Network) -> None:
        self.node_id = node_id
        self.drive = drive
        self.network = network
        self.state = INITIALISING
        self.objects = Objects(node_id)
        self.sdo = DriveSdoServer(node_id, self.objects, network)
        self.rpdo = _default_pdo(self.objects, _RPDO_OBJECTS, 0x1400, 0x1600)
        self.tpdo = _default_pdo(self.objects, _TPDO_OBJECTS, 0x1800, 0x1A00)
        self.sample = DriveSample(drive.statusword, 0.0, 0.0)  #: of the last SYNC
        self._commands = dict.fromkeys(_RPDO_OBJECTS, 0)
        self._errors: list[int] = []
        self._rpdo_too_short = False  #: the last one was
        self._heartbeat_s = 0.0
        self._heartbeat_due_s = inf
        self._now_s = 0.0
        self._wire_objects()
        drive.on_emergency = self._send_emergency

    def boot(self, now_s: float) -> None:
        """Everything back to the defaults, the boot-up message, then pre-operational."""
        self._now_s = now_s
        self._enter(INITIALISING)
        self.objects.forget()
        self.rpdo.reset()
        self.tpdo.reset()
        self._commands = dict.fromkeys(_RPDO_OBJECTS, 0)
        self._errors.clear()
        self._rpdo_too_short = False
        self.drive.watchdog_s = 0.0
        self._set_heartbeat(self.objects.default(0x1017))
        self.network.send_message(0x700 + self.node_id, b"\0")
        self._enter(PRE_OPERATIONAL)

    def on_nmt(self, command: int, now_s: float) -> bool:
        """An NMT command for this node. False when there is no such command."""
        self._now_s = now_s
        if command == NMT_START:
            self._enter(OPERATIONAL)
        elif command == NMT_STOP:
            self._enter(STOPPED)
        elif command == NMT_ENTER_PRE_OPERATIONAL:
            self._enter(PRE_OPERATIONAL)
        elif command in (NMT_RESET_NODE, NMT_RESET_COMMUNICATION):
            self.boot(now_s)
        else:
            return False
        return True

    def on_rpdo(self, data: bytes | bytearray, now_s: float) -> bool:
        """The command PDO: held by the drive until the next SYNC. False when it is too short.

        Of one that is too long the leading bytes count (CiA 301, 7.2.2.5).
        """
        self._now_s = now_s
        if self.state != OPERATIONAL or not self.rpdo.valid:
            return True
        too_short = len(data) < self.rpdo.layout.size
        if too_short != self._rpdo_too_short:
            self._rpdo_too_short = too_short
            if too_short or not self.drive.error_code:  # 0000h says that nothing at all is wrong
                self._send_emergency(SHORT_RPDO if too_short else 0)
        if too_short:
            return False
        commands = self._commands
        commands.update(zip(self.rpdo.fields, self.rpdo.layout.unpack_from(data), strict=True))
        target_torque_nm = commands[_TARGET_TORQUE] * 1e-3 * self.drive.rated_torque_nm
        self.drive.receive(commands[_CONTROLWORD], target_torque_nm, commands[_MODE], now_s)
        return True

    def on_sync(self, now_s: float) -> None:
        """The drive acts on what it holds, and what it samples at this instant goes out."""
        if self.state != OPERATIONAL:
            return
        self._now_s = now_s
        self.sample = self.drive.sync(now_s)
        if self.tpdo.valid:
            values = [_TPDO_VALUES[index](self) for index in self.tpdo.fields]
            self.network.send_message(self.tpdo.can_id, self.tpdo.layout.pack(*values))

    def on_sdo(self, data: bytes | bytearray, now_s: float) -> bool:
        """A request to the SDO server. False when its length is wrong."""
        self._now_s = now_s
        if len(data) != 8:
            return False
        if self.state != STOPPED:
            self.sdo.on_request(self.sdo.rx_cobid, data, now_s)
        return True

    def poll(self, now_s: float) -> None:
        """The heartbeat, when it is due."""
        self._now_s = now_s
        if now_s >= self._heartbeat_due_s:
            # Late by more than a period: skip, never catch up.
            self._heartbeat_due_s = max(self._heartbeat_due_s + self._heartbeat_s, now_s)
            self.network.send_message(0x700 + self.node_id, bytes((self.state,)))

    def _enter(self, state: int) -> None:
        self.drive.poll(self._now_s)
        self.state = state
        self.drive.operational = state == OPERATIONAL

    def _send_emergency(self, code: int) -> None:
        if code:
            self._errors = [code, *self._errors][:_ERROR_HISTORY]
        if self.state != STOPPED:
            self.network.send_message(0x80 + self.node_id, _EMERGENCY.pack(code, _error_register(code)))

    def _wire_objects(self) -> None:
        """Which objects are computed, and which writes take effect or are refused."""
        readers, writers = self.objects.readers, self.objects.writers
        drive = self.drive
        readers[0x1001, 0] = lambda: _error_register(drive.error_code or SHORT_RPDO * self._rpdo_too_short)
        readers[0x1003, 0] = lambda: len(self._errors)
        writers[0x1003, 0] = self._clear_errors
        for k in range(_ERROR_HISTORY):
            readers[0x1003, k + 1] = lambda k=k: self._errors[k] if k < len(self._errors) else 0
        writers[0x1017, 0] = self._set_heartbeat
        writers[0x1400, 5] = self._set_watchdog
        writers[0x605A, 0] = _quick_stop_option
        writers[_MODE, 0] = self._set_mode
        for index in _RPDO_OBJECTS:
            readers[index, 0] = lambda index=index: self._commands[index]
        for index in (_CONTROLWORD, _TARGET_TORQUE):
            writers[index, 0] = lambda value, index=index: self._commands.__setitem__(index, value)
        for index, value in _TPDO_VALUES.items():
            readers[index, 0] = partial(value, self)
        readers[0x6041, 0] = lambda: drive.statusword
        readers[0x6072, 0] = lambda: round(1e3 * drive.max_torque_nm / drive.rated_torque_nm)
        readers[0x6076, 0] = lambda: round(1e3 * drive.rated_torque_nm)
        _wire_pdo(self.objects, self.rpdo, 0x1400, 0x1600)
        _wire_pdo(self.objects, self.tpdo, 0x1800, 0x1A00)

    def _set_heartbeat(self, period_ms: int) -> None:
        if period_ms and period_ms < SHORTEST_HEARTBEAT_MS:
            raise SdoAbortedError(OUT_OF_RANGE)
        self._heartbeat_s = period_ms * 1e-3
        self._heartbeat_due_s = self._now_s + self._heartbeat_s if period_ms else inf

    def _set_watchdog(self, time_ms: int) -> None:
        if time_ms and time_ms not in WATCHDOG_MS:
            raise SdoAbortedError(OUT_OF_RANGE)
        self.drive.watchdog_s = time_ms * 1e-3

    def _set_mode(self, mode: int) -> None:
        if mode not in (NO_MODE, CYCLIC_SYNCHRONOUS_TORQUE):
            raise SdoAbortedError(OUT_OF_RANGE)
        self._commands[_MODE] = mode

    def _clear_errors(self, count: int) -> None:
        if count:
            raise SdoAbortedError(OUT_OF_RANGE)
        self._errors.clear()


def _default_pdo(objects: Objects, mappable: dict[int, str], communication: int, mapping: int) -> Pdo:
    entries = [objects.default(mapping, subindex) for subindex in range(1, MAX_ENTRIES + 1)]
    return Pdo(mappable, objects.default(communication, 1), entries, objects.default(mapping))


def _wire_pdo(objects: Objects, pdo: Pdo, communication: int, mapping: int) -> None:
    readers, writers = objects.readers, objects.writers
    readers[communication, 1] = lambda: pdo.cob_id
    writers[communication, 1] = pdo.write_cob_id
    writers[communication, 2] = pdo.write_transmission_type
    readers[mapping, 0] = lambda: pdo.count
    writers[mapping, 0] = partial(pdo.write_mapping, 0)
    for k in range(1, MAX_ENTRIES + 1):
        readers[mapping, k] = lambda k=k: pdo.entries[k - 1]
        writers[mapping, k] = partial(pdo.write_mapping, k)


def _quick_stop_option(value: int) -> None:
    if value != QUICK_STOP_RAMP_THEN_OFF:
        raise SdoAbortedError(OUT_OF_RANGE)


def _error_register(code: int) -> int:
    """1001h: bit 0 for any error, and one bit by the class of the code."""
    if code == 0:
        return 0
    return 1 | _ERROR_CLASS_BITS.get(code >> 12, 0)


def _saturated(value: float, highest: int) -> int:
    """The nearest number that the object can hold: a drive shows its range's end, it does not wrap."""
    return max(-highest, min(highest, round(value)))


#: Current, voltage, temperature, communication, maker's own.
_ERROR_CLASS_BITS = {0x2: 1 << 1, 0x3: 1 << 2, 0x4: 1 << 3, 0x8: 1 << 4, 0xF: 1 << 7}

#: What the objects of the TPDO hold, as numbers of the wire.
_TPDO_VALUES: dict[int, Callable[[DriveNode], int]] = {
    0x603F: lambda node: node.drive.error_code,
    0x6041: lambda node: node.sample.statusword,
    0x6061: lambda node: node.drive.mode,
    0x606C: lambda node: _saturated(node.sample.speed_m_per_s * 1e6, _INT32),
    0x6077: lambda node: _saturated(1e3 * node.sample.torque_nm / node.drive.rated_torque_nm, _INT16),
    0x60FD: lambda node: STO_ACTIVE if node.drive.sto else 0,
}
