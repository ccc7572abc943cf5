"""One drive, or one axis of a device with several, on Modbus: registers to SI and back, and its state. No I/O."""

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.cia402 import DISABLE_VOLTAGE, PowerState, drive_state, power_state
from drivers.modbus.device import (
    WATCHDOG_OFF,
    Check,
    Proofs,
    Setting,
    Standing,
    identity_check,
    register_block,
)
from drivers.modbus.frozen import FrozenAnswers
from drivers.modbus.maps import DriveMap, Register
from drivers.modbus.plan import Wish
from drivers.modbus.registers import Field, RegisterBlock, SerialNumber
from drivers.mode_display import ModeDisplay
from drivers.power_stage import PowerStage
from drivers.scaling import speed_per_count, torque_per_count, torque_step, watchdog_counts
from drivers.torque_rules import against_max_torque, against_rated_torque, limit_counts
from gateway.core.finding import Finding, finding
from gateway.core.line import Drive
from gateway.core.signals import DriveCondition, DriveState, Inputs, Outputs

_LARGEST = {"i16": 2**15 - 1, "i32": 2**31 - 1, "f32": 3.4e38}  #: counts of a target torque, either way
_WARNS = int(DriveCondition.WARNS)


@dataclass(frozen=True, slots=True)
class AxisSettings:
    """What a line asks of one drive."""

    channel: int  #: axis of the device, from 1
    rated_torque_nm: float
    torque_limit_nm: float
    watchdog_s: float
    radius_m: float  #: nominal, of its roller


def axis_settings(drive: Drive, torque_nm: float, watchdog_s: float, radius_m: float) -> AxisSettings:
    return AxisSettings(drive.channel, drive.rated_torque_nm, torque_nm, watchdog_s, radius_m)


class Axis:
    """Raises ValueError when the line asks for what the drive cannot do."""

    gives_torque = True

    def __init__(self, name: str, index: int, device: DriveMap, settings: AxisSettings) -> None:
        self.name = name
        self._index = index  #: roller - 1
        self._device = device
        self._settings = settings
        read, write, rated_nm = device.read, device.write, settings.rated_torque_nm
        axes = device.axes
        self._read_offset = (settings.channel - 1) * axes.read_stride if axes else 0
        write_offset = (settings.channel - 1) * axes.write_stride if axes else 0
        self._speed_scale = speed_per_count(read.speed.unit, read.speed.scale, settings.radius_m)
        self._torque_scale = torque_per_count(read.torque.unit, read.torque.scale, rated_nm)
        target = write.target_torque
        self._counts_per_nm = 1.0 / torque_per_count(target.unit, target.scale, rated_nm)
        self._whole_counts = target.type != "f32"
        self._most_nm = _LARGEST[target.type] / self._counts_per_nm  #: either way
        fields = [self._read_field(entry) for entry in (read.statusword, read.speed, read.torque)]
        self._sto_at = self._error_at = self._mode_at = -1
        if read.safe_torque_off is not None:
            self._sto_at = _place(fields, self._read_field(read.safe_torque_off))
        if read.error_code is not None:
            self._error_at = _place(fields, self._read_field(read.error_code))
        self._mode: ModeDisplay | None = None
        if (displayed := read.mode_displayed) is not None and device.torque_mode is not None:
            self._mode_at = _place(fields, self._read_field(displayed))
            self._mode = ModeDisplay(device.torque_mode, at_rest=displayed.shown == "always", certain=True)
        self._write = self._block((write.controlword, write.target_torque), write_offset)
        self.wish = Wish(name, fields, device.word_order, (self._write.address, self._write.count))
        self.proofs = self._what_must_hold()
        self.stage = PowerStage(device.follows_command, device.voltage_enabled)
        self._state = DriveState.ABSENT
        self._commanded_nm = 0.0
        self._frozen = FrozenAnswers(self._torque_scale)
        self._told = ""  #: the trouble that was told last; what lasts is told once

    # what must hold of it

    def _what_must_hold(self) -> Proofs:
        device, settings = self._device, self._settings
        identity = [identity_check(self.name, device.device_id, device)]
        if device.axis_count is not None:
            identity.append(Check(self._block([device.axis_count]), self._against_axis_count))
        if device.rated_torque is not None:
            identity.append(Check(self._block([device.rated_torque]), self._against_rated_torque))
        maximum = self._block([device.max_torque])
        counts = watchdog_counts(device.watchdog, settings.watchdog_s)
        watchdog = Setting(self.name, "watchdog", self._block([device.watchdog]), counts, WATCHDOG_OFF)
        trust: list[Check] = []
        written = [watchdog]
        if device.max_torque.writable:
            written.insert(0, Setting(self.name, "max_torque", maximum, self._torque_limit_counts()))
        else:
            identity.append(Check(maximum, self._against_max_torque))
        statusword = RegisterBlock([self._read_field(device.read.statusword)], device.word_order)
        trust.append(Check(statusword, self._against_enabled))
        return Proofs(identity, trust, written, SerialNumber.of(device))

    def _against_axis_count(self, found: float) -> list[Finding]:
        channel = self._settings.channel
        if channel <= found:
            return []
        return [finding("channel-missing", device=self.name, channel=channel, channels=int(found))]

    def _against_rated_torque(self, found: float) -> list[Finding]:
        entry, wanted_nm = self._device.rated_torque, self._settings.rated_torque_nm
        assert entry is not None
        found_nm = found * torque_per_count(entry.unit, entry.scale, wanted_nm)
        return against_rated_torque(self.name, found_nm, wanted_nm)

    def _against_max_torque(self, found: float) -> list[Finding]:
        entry, settings = self._device.max_torque, self._settings
        nm_per_count = torque_per_count(entry.unit, entry.scale, settings.rated_torque_nm)
        step_nm = torque_step(entry.type, entry.unit, entry.scale, settings.rated_torque_nm)
        return against_max_torque(self.name, found * nm_per_count, settings.torque_limit_nm, step_nm)

    def _against_enabled(self, found: float) -> list[Finding]:
        if drive_state(power_state(int(found))) not in (DriveState.ENABLED, DriveState.STOPPING):
            return []
        return [finding("still-enabled", drive=self.name, statusword=int(found))]

    def _torque_limit_counts(self) -> float:
        entry, limit_nm = self._device.max_torque, self._settings.torque_limit_nm
        counts = limit_counts(entry, limit_nm, self._settings.rated_torque_nm)
        try:
            self._block([entry]).encode([counts])
        except ValueError as error:
            raise ValueError(f"limits.torque_nm = {limit_nm} Nm does not fit max_torque: {error}") from error
        return counts

    # the cycle

    def fill(self, inputs: Inputs, numbers: Sequence[float] | None, standing: Standing, time_s: float) -> list[str]:
        """State, speed and torque into `inputs`; returns what was wrong, once. Without an answer they are missed."""
        index = self._index
        if numbers is None:
            self._miss(inputs, standing)
            return []
        if self._frozen.after(numbers, self._commanded_nm, following=standing.wrote and self._follows):
            self._miss(inputs, standing)
            return [f"{self.name}: answers, but nothing that it says moves while its torque command does"]
        sto = self._device.read.safe_torque_off
        active = sto.is_set(int(numbers[self._sto_at])) if sto is not None else None
        self.stage.on_statusword(int(numbers[0]), active)
        inputs.speed.put(index, numbers[1] * self._speed_scale, time_s)
        inputs.torque.put(index, numbers[2] * self._torque_scale, time_s)
        says = self.stage.state
        # One that disobeys is shown as it is: whoever reads FAULT takes torque for off.
        self._state = DriveState.FAULT if standing.distrust and not self.stage.disobeys else says
        inputs.drive_state[index] = self._state
        inputs.power_barred[index] = self.stage.barred
        self._tell_condition(inputs, numbers)
        if says is not DriveState.FAULT:
            self._told = ""
            return []
        return self._fault_told_once(numbers)

    def _tell_condition(self, inputs: Inputs, numbers: Sequence[float]) -> None:
        """What it says beside its state, and the code of what it warns of."""
        index, stage, condition = self._index, self.stage, self.stage.condition
        if self._mode is not None:
            enabled = stage.power is PowerState.OPERATION_ENABLED
            self._mode.on_mode(int(numbers[self._mode_at]), enabled=enabled)
            condition |= self._mode.condition(enabled=enabled)
            inputs.drive_mode[index] = int(numbers[self._mode_at])
        inputs.drive_condition[index] = condition
        coded = self._error_at >= 0 and condition & _WARNS and stage.state is not DriveState.FAULT
        inputs.drive_warning[index] = int(numbers[self._error_at]) if coded else 0

    def _miss(self, inputs: Inputs, standing: Standing) -> None:
        inputs.speed.miss(self._index)
        inputs.torque.miss(self._index)
        inputs.power_barred[self._index] = False
        self._state = self._state_unheard(standing)
        inputs.drive_state[self._index] = self._state

    @property
    def _follows(self) -> bool:
        """Whether it said at last that it follows its torque command."""
        return self.stage.state is DriveState.ENABLED

    def _state_unheard(self, standing: Standing) -> DriveState:
        if standing.absent or self.stage.power is None:  # lost, or never heard
            return DriveState.ABSENT
        return DriveState.FAULT if standing.distrust else self.stage.state

    def _fault_told_once(self, numbers: Sequence[float]) -> list[str]:
        trouble = f"{self.name}: fault, statusword {int(numbers[0]):04X}h"
        if (entry := self._device.read.error_code) is not None:
            code = int(numbers[self._error_at])
            trouble += f", error code {code:#x}{_meaning(entry.texts, code)}"
        if trouble == self._told:
            return []
        self._told = trouble
        return [trouble]

    def command(self, outputs: Outputs) -> list[int]:
        """See `Device.command`."""
        request = int(outputs.drive_request[self._index])
        torque_nm = float(outputs.torque_nm[self._index])
        # Checked also where it is not given: what cannot be commanded says that something is wrong.
        if not -self._most_nm <= torque_nm <= self._most_nm:  # NaN, too
            raise ValueError(f"torque {torque_nm} Nm does not fit the target torque register")
        controlword, self._commanded_nm = self.stage.command(request, torque_nm, self._state, trusted=True)
        return self._encode(controlword, self._commanded_nm)

    def rest(self) -> list[int]:
        return self._encode(DISABLE_VOLTAGE, 0.0)

    def _encode(self, controlword: int, torque_nm: float) -> list[int]:
        counts = torque_nm * self._counts_per_nm
        return self._write.encode((controlword, round(counts) if self._whole_counts else counts))

    @property
    def disobeys(self) -> bool:
        return self.stage.disobeys

    def forget(self) -> None:
        self.stage.forget()
        if self._mode is not None:
            self._mode.forget()
        self._frozen.forget()
        self._commanded_nm = 0.0
        self._told = ""

    # registers

    def _read_field(self, entry: Register) -> Field:
        return entry.address - self._device.address_base + self._read_offset, entry.type

    def _block(self, entries: Sequence[Register], offset: int = 0) -> RegisterBlock:
        return register_block(entries, self._device, offset)


def _place(fields: list[Field], field: Field) -> int:
    """Where `field` is in `fields`; appended if it is not there yet (flags share registers)."""
    if field not in fields:
        fields.append(field)
    return fields.index(field)


def _meaning(texts: dict[str, str], code: int) -> str:
    text = next((text for key, text in texts.items() if int(key, 0) == code), "")
    return f" ({text})" if text else ""
