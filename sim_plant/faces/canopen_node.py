"""One node on the CANopen bus: NMT slave, heartbeat, PDOs, emergency messages, and the SDO server.

What the node is beside that (a drive, an amplifier, a PLC) is its `Device`. The face hands it frames that are for it;
it answers through `network.send_message`. Time is an argument.
"""

import struct
from collections.abc import Mapping
from functools import partial
from math import inf
from typing import Protocol

from canopen import Network
from canopen.objectdictionary import ObjectDictionary, ODRecord
from canopen.sdo.exceptions import SdoAbortedError

from sim_plant.faces.canopen_pdo import MAX_ENTRIES, OUT_OF_RANGE, Key, Pdo
from sim_plant.faces.canopen_sdo import NodeSdoServer, Objects, Reader, Writer

INITIALISING = 0
STOPPED = 4
OPERATIONAL = 5
PRE_OPERATIONAL = 127

NMT_START = 1
NMT_STOP = 2
NMT_ENTER_PRE_OPERATIONAL = 128
NMT_RESET_NODE = 129
NMT_RESET_COMMUNICATION = 130

SHORTEST_HEARTBEAT_MS = 10
SHORT_RPDO = 0x8210  #: EMCY: a PDO with too few bytes, not processed

_EMERGENCY = struct.Struct("<HB5x")
_ERROR_HISTORY = 4
_RPDO = 0x1400
_TPDOS = range(0x1800, 0x1804)
_MAPPING = 0x200  #: a PDO's mapping parameters stand this far behind its communication parameters


class TellError(Protocol):
    """Told the code of each error, and 0 when it is gone; the error register where it is not that of the code."""

    def __call__(self, code: int, register: int | None = None) -> None: ...


class Device(Protocol):
    """What a node is. Times are in s, on the world's clock."""

    @property
    def dictionary(self) -> ObjectDictionary:
        """Its objects, as of node 0; the PDO communication parameters in it say which PDOs it has."""
        ...

    @property
    def commands(self) -> Mapping[Key, str]:
        """The objects that its RPDO takes, with their struct format characters."""
        ...

    @property
    def values(self) -> Mapping[Key, str]:
        """The objects that its TPDOs take."""
        ...

    @property
    def readers(self) -> Mapping[Key, Reader]:
        """Objects that are computed when asked; those of the TPDOs among them."""
        ...

    @property
    def writers(self) -> Mapping[Key, Writer]:
        """What writing an object does. Raises SdoAbortedError to refuse it."""
        ...

    @property
    def error_code(self) -> int:
        """The code of the error that there is, 0 without."""
        ...

    def tell_errors(self, to: TellError) -> None:
        """`to` wants to be told of each error."""
        ...

    def reset(self) -> None:
        """What was written to it is at its default again."""
        ...

    def set_operational(self, operational: bool, now_s: float) -> None:
        """Only while operational it takes commands, and is asked to `sync`."""
        ...

    def lose_power(self, now_s: float) -> None:
        """As leaving operational, but by nobody's will."""
        ...

    def command(self, values: Mapping[Key, int], now_s: float) -> bool:
        """Hold a command until the next `sync`. False when it cannot be used."""
        ...

    def sync(self, now_s: float) -> None:
        """Act on what is held, then measure."""
        ...

    def poll(self, now_s: float) -> None:
        """Notice what time has brought. The world's own timers run without this."""
        ...


class Node:
    """`device` as node `node_id`. Nothing is sent before `boot`."""

    def __init__(self, node_id: int, device: Device, network: Network) -> None:
        self.node_id = node_id
        self.device = device
        self.network = network
        self.state = INITIALISING
        self.objects = Objects(node_id, device.dictionary)
        self.sdo = NodeSdoServer(node_id, self.objects, network)
        self.rpdo = self._pdo(_RPDO, device.commands) if _RPDO in device.dictionary else None
        self.tpdos = [self._pdo(k, device.values) for k in _TPDOS if k in device.dictionary]
        self._commands = dict.fromkeys(device.commands, 0)
        self._errors: list[int] = []
        self._rpdo_too_short = False  #: the last one was
        self._heartbeat_s = 0.0
        self._heartbeat_due_s = inf
        self._now_s = 0.0
        self._wire_objects()
        device.tell_errors(self._send_emergency)

    @property
    def sends(self) -> set[int]:
        """The identifiers of its frames."""
        services = {base + self.node_id for base in (0x80, 0x180, 0x580, 0x700)}
        return services | {pdo.can_id for pdo in self.tpdos}

    def boot(self, now_s: float) -> None:
        """Everything back to the defaults, the boot-up message, then pre-operational."""
        self._now_s = now_s
        self._enter(INITIALISING)
        self.objects.forget()
        for pdo in (*self.tpdos, *([self.rpdo] if self.rpdo else [])):
            pdo.reset()
        self._commands = dict.fromkeys(self._commands, 0)
        self._errors.clear()
        self._rpdo_too_short = False
        self.device.reset()
        self._set_heartbeat(self.objects.default(0x1017))
        self.network.send_message(0x700 + self.node_id, b"\0")
        self._enter(PRE_OPERATIONAL)

    def restart(self, now_s: float) -> None:
        """The power fails for an instant."""
        self.device.lose_power(now_s)
        self.boot(now_s)

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
        """The command PDO: held by the device until the next SYNC. False when it cannot be used.

        Of one that is too long the leading bytes count (CiA 301, 7.2.2.5).
        """
        self._now_s = now_s
        if self.state != OPERATIONAL or self.rpdo is None or not self.rpdo.valid:
            return True
        too_short = len(data) < self.rpdo.layout.size
        if too_short != self._rpdo_too_short:
            self._rpdo_too_short = too_short
            if too_short or not self.device.error_code:  # 0000h says that nothing at all is wrong
                self._send_emergency(SHORT_RPDO if too_short else 0)
        if too_short:
            return False
        self._commands.update(zip(self.rpdo.fields, self.rpdo.layout.unpack_from(data), strict=True))
        return self.device.command(self._commands, now_s)

    def on_sync(self, now_s: float) -> None:
        """The device acts on what it holds, and what it samples at this instant goes out."""
        if self.state != OPERATIONAL:
            return
        self._now_s = now_s
        self.device.sync(now_s)
        readers = self.objects.readers
        for tpdo in self.tpdos:
            if tpdo.valid:
                values = [readers[key]() for key in tpdo.fields]
                self.network.send_message(tpdo.can_id, tpdo.layout.pack(*values))

    def on_sdo(self, data: bytes | bytearray, now_s: float) -> bool:
        """An SDO request. False when it has another length than 8 bytes."""
        self._now_s = now_s
        if len(data) != 8:
            return False
        if self.state != STOPPED:
            self.device.poll(now_s)
            self.sdo.on_request(self.sdo.rx_cobid, data, now_s)
        return True

    def poll(self, now_s: float) -> None:
        """The heartbeat, when it is due."""
        self._now_s = now_s
        self.device.poll(now_s)
        if now_s >= self._heartbeat_due_s:
            # Late by more than a period: skip, never catch up.
            self._heartbeat_due_s = max(self._heartbeat_due_s + self._heartbeat_s, now_s)
            self.network.send_message(0x700 + self.node_id, bytes((self.state,)))

    def _enter(self, state: int) -> None:
        self.state = state
        self.device.set_operational(state == OPERATIONAL, self._now_s)

    def _send_emergency(self, code: int, register: int | None = None) -> None:
        if code:
            self._errors = [code, *self._errors][:_ERROR_HISTORY]
        if self.state != STOPPED:
            told = _error_register(code) if register is None else register
            self.network.send_message(0x80 + self.node_id, _EMERGENCY.pack(code, told))

    def _pdo(self, communication: int, mappable: Mapping[Key, str]) -> Pdo:
        objects, mapping = self.objects, communication + _MAPPING
        highest = len(_record(objects, mapping)) - 1
        entries = [objects.default(mapping, k) for k in range(1, highest + 1)]
        return Pdo(mappable, objects.default(communication, 1), entries, objects.default(mapping))

    def _wire_objects(self) -> None:
        """Which objects are computed, and which writes take effect or are refused."""
        readers, writers = self.objects.readers, self.objects.writers
        readers[0x1001, 0] = lambda: _error_register(self.device.error_code or SHORT_RPDO * self._rpdo_too_short)
        readers[0x1003, 0] = lambda: len(self._errors)
        writers[0x1003, 0] = self._clear_errors
        for k in range(_ERROR_HISTORY):
            readers[0x1003, k + 1] = lambda k=k: self._errors[k] if k < len(self._errors) else 0
        writers[0x1017, 0] = self._set_heartbeat
        readers.update(self.device.readers)
        writers.update(self.device.writers)
        for key in self._commands:
            readers[key] = partial(self._read_command, key)
            writers[key] = partial(self._write_command, key)
        pdos = [(_RPDO, self.rpdo)] if self.rpdo else []
        for communication, pdo in (*pdos, *zip(_TPDOS, self.tpdos, strict=False)):
            _wire_pdo(self.objects, pdo, communication)

    def _read_command(self, key: Key) -> int:
        return self._commands[key]

    def _write_command(self, key: Key, value: int) -> None:
        check = self.device.writers.get(key)
        if check is not None:
            check(value)
        self._commands[key] = value

    def _set_heartbeat(self, period_ms: int) -> None:
        if period_ms and period_ms < SHORTEST_HEARTBEAT_MS:
            raise SdoAbortedError(OUT_OF_RANGE)
        self._heartbeat_s = period_ms * 1e-3
        self._heartbeat_due_s = self._now_s + self._heartbeat_s if period_ms else inf

    def _clear_errors(self, count: int) -> None:
        if count:
            raise SdoAbortedError(OUT_OF_RANGE)
        self._errors.clear()


def _wire_pdo(objects: Objects, pdo: Pdo, communication: int) -> None:
    """The parameters of a PDO. What the dictionary has as read only, the mapping of a fixed one, is never written."""
    readers, writers = objects.readers, objects.writers
    mapping = communication + _MAPPING
    fixed = not _record(objects, mapping)[0].writable
    readers[communication, 1] = lambda: pdo.cob_id
    writers[communication, 1] = pdo.write_switch if fixed else pdo.write_cob_id
    writers[communication, 2] = pdo.write_transmission_type
    readers[mapping, 0] = lambda: pdo.count
    writers[mapping, 0] = partial(pdo.write_mapping, 0)
    for k in range(1, MAX_ENTRIES + 1):
        readers[mapping, k] = lambda k=k: pdo.entries[k - 1]
        writers[mapping, k] = partial(pdo.write_mapping, k)


def _record(objects: Objects, index: int) -> ODRecord:
    record = objects.object_dictionary[index]
    assert isinstance(record, ODRecord), f"{index:04X}h is no record"
    return record


def _error_register(code: int) -> int:
    """1001h: bit 0 for any error, and one bit by the class of the code."""
    if code == 0:
        return 0
    return 1 | _ERROR_CLASS_BITS.get(code >> 12, 0)


#: Current, voltage, temperature, communication, maker's own.
_ERROR_CLASS_BITS = {0x2: 1 << 1, 0x3: 1 << 2, 0x4: 1 << 3, 0x8: 1 << 4, 0xF: 1 << 7}
