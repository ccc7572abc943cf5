"""The map of a drive on CANopen."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from drivers.canopen.map_parts import (
    CanMap,
    CanObject,
    OptionObject,
    Pdo,
    SpeedObject,
    TorqueObject,
    Watchdog,
    emergency_problems,
    heartbeat_problems,
    pdo_problems,
    place_problems,
    watchdog_problems,
)
from drivers.map_fields import UNSEEN_POWER, Bit, Range, TorqueAccuracy, TorqueFilter, refuse_together
from drivers.map_rules import INTEGERS, bit_problems, range_problems, type_problems
from gateway.core.drive_tells import INVERTER_ACCURACY, TORQUE_FILTER_S
from gateway.core.line import Strict


class SafeTorqueOff(CanObject, Bit):
    """Where the drive says that its hard-wired safe torque off is active."""


class TargetTorqueObject(TorqueObject):
    range: Range | None = None  #: what the object takes, in its unit, where that is less than its type


class ModeDisplayed(CanObject):
    """Where the drive displays its mode of operation (CiA 402: 6061h)."""

    #: "always", or only "enabled": it displays 0 as long as it is not enabled.
    shown: Literal["always", "enabled"] = "always"


class MaxTorqueObject(TorqueObject):
    writable: bool  #: true: set to the line's limit; false: the drive's own, which must allow the line's limit


class DriveObjects(Strict):
    """The objects of CiA 402 cyclic synchronous torque, wherever the device keeps them."""

    controlword: CanObject
    statusword: CanObject
    mode: CanObject
    target_torque: TargetTorqueObject
    torque: TorqueObject
    speed: SpeedObject
    max_torque: MaxTorqueObject | None = None  #: without it the drive itself does not hold the line's limit
    rated_torque: TorqueObject | None = None  #: compared with the line's file when it is there
    safe_torque_off: SafeTorqueOff | None = None
    mode_displayed: ModeDisplayed | None = None  #: without it that of the profile is tried: see `DriveMap`


class ReactionObject(OptionObject):
    """What the drive does when its connection is lost (CiA 402: 6007h)."""

    required: bool = True  #: false: one that has no such object is not refused, and its drill alone shows what it does


class DriveOptions(Strict):
    """Settings that decide what the rest of the map means."""

    abort_connection: ReactionObject | None = None  #: what it does when its watchdog fires; must take torque off
    quick_stop: OptionObject | None = None  #: what it does then where that is a quick stop (CiA 402: 605Ah)
    fault_reaction: OptionObject | None = None
    speed_unit: OptionObject | None = None  #: the unit of `objects.speed`, where the device lets it be chosen

    def present(self) -> list[OptionObject]:
        return [option for _, option in self if option is not None]


DriveEntry = Literal[
    "controlword", "statusword", "mode", "target_torque", "torque", "speed", "safe_torque_off", "mode_displayed"
]


_ABORT_CONNECTION, _QUICK_STOP = 0x6007, 0x605A
#: Values of 6007h that take torque away (CiA 402; with 1 what a fault does is in 605Eh, and every value of that does).
TORQUE_OFF_OPTIONS = {1: "fault", 2: "disable voltage", 3: "quick stop"}
BY_QUICK_STOP = 3
#: Values of 605Ah after which the power stage goes off; with 5 to 8 the drive stays in quick stop active, under torque.
QUICK_STOP_OFF = range(5)
_MODES_OF_OPERATION = range(0x6060, 0xA000, 0x800)  #: object of the profile, by axis


class DrivePdo(Pdo):
    objects: Annotated[list[DriveEntry], Field(min_length=1, max_length=8)]


class DriveMap(CanMap):
    role: Literal["drive"]
    cyclic_torque_mode: Annotated[int, Field(ge=-128, le=127)]
    follows_command: Bit | None = None  #: of the statusword: the target torque is followed, not ignored
    voltage_enabled: Bit | None = None  #: of the statusword: the power stage is supplied, whether it is on or off
    torque_accuracy: TorqueAccuracy = INVERTER_ACCURACY
    torque_filter_s: TorqueFilter = TORQUE_FILTER_S
    objects: DriveObjects
    options: DriveOptions = DriveOptions()
    receive_pdo: DrivePdo
    transmit_pdo: DrivePdo
    watchdog: Watchdog

    def objects_of(self, pdo: DrivePdo) -> list[CanObject]:
        """The objects of a PDO in mapping order."""
        return [getattr(self.objects, name) for name in pdo.objects]

    @property
    def mode_displayed(self) -> ModeDisplayed | None:
        """Where its mode is displayed, as the map says, or else as the profile does for 6060h: the object behind it."""
        objects = self.objects
        if objects.mode_displayed is not None:
            return objects.mode_displayed
        if objects.mode.sub == 0 and objects.mode.index in _MODES_OF_OPERATION:
            return ModeDisplayed(index=objects.mode.index + 1, type="i8", shown="enabled")
        return None

    @property
    def speed(self) -> SpeedObject:
        """The roller's."""
        return self.objects.speed

    @property
    def unseen(self) -> list[str]:
        """What its answers do not tell, as far as this map says, each with the key that would."""
        power = [] if self.voltage_enabled is not None else [UNSEEN_POWER]
        return power if self.mode_displayed is not None else [*power, "its mode of operation (objects.mode_displayed)"]

    @property
    def names_reaction(self) -> bool:
        """Whether it says what the drive does when its watchdog fires: option codes are set, or compared, at arming."""
        return self.options.abort_connection is not None

    @property
    def torques(self) -> tuple[TorqueObject, TorqueObject]:
        """What it reports, and what it is asked for."""
        return self.objects.torque, self.objects.target_torque

    @property
    def mode(self) -> int:
        """The mode of operation in which torques are followed."""
        return self.cyclic_torque_mode

    @model_validator(mode="after")
    def _layout(self) -> "DriveMap":
        entries = dict(self.objects)
        receive, transmit = self.receive_pdo.objects, self.transmit_pdo.objects
        problems = pdo_problems("receive_pdo", receive, entries, ["controlword", "target_torque"])
        problems += pdo_problems("transmit_pdo", transmit, entries, ["statusword", "speed", "torque"])
        problems += place_problems({f"objects.{name}": entry for name, entry in entries.items() if entry is not None})
        problems += _drive_type_problems(self.objects)
        for key, bit in (("follows_command", self.follows_command), ("voltage_enabled", self.voltage_enabled)):
            if bit is not None:
                problems += bit_problems(key, bit.bit, "u16")
        problems += emergency_problems(self.emergency)
        for name, option in self.options:
            if option is not None:
                problems += type_problems(f"options.{name}", option.type, INTEGERS)
        problems += _reaction_problems(self.watchdog, self.options.abort_connection)
        problems += _quick_stop_problems(self.options)
        return refuse_together(self, problems + watchdog_problems(self.watchdog) + heartbeat_problems(self.heartbeat))


def _reaction_problems(watchdog: Watchdog, option: ReactionObject | None) -> list[str]:
    """A watchdog without a reaction is none: what a drive does when a heartbeat fails is what its 6007h says."""
    key = "options.abort_connection"
    if option is None:
        said = '{ index = 0x6007, type = "i16", value = 2, writable = true }'
        missing = (
            f"{key}: is missing; when the heartbeat ends, the drive does what 6007h says, and 0 is nothing: {said}"
        )
        return [missing] if watchdog.kind == "heartbeat-consumer" else []
    if option.value not in TORQUE_OFF_OPTIONS and (option.index - _ABORT_CONNECTION) % 0x800 == 0:
        allowed = ", ".join(f"{value} ({words})" for value, words in TORQUE_OFF_OPTIONS.items())
        return [f"{key}.value: {option.value} does not take torque away; allowed: {allowed}"]
    if not option.required and watchdog.kind == "heartbeat-consumer":
        return [f"{key}.required: false; when the heartbeat ends, nothing but this object says what the drive does"]
    if not option.required and not option.writable:
        return [f"{key}.required: false is only for an object that is set (writable = true)"]
    return []


def _quick_stop_problems(options: DriveOptions) -> list[str]:
    """A reaction by quick stop takes torque away only where the drive leaves the quick stop by itself."""
    reaction, key = options.abort_connection, "options.quick_stop"
    axis = 0 if reaction is None else reaction.index - _ABORT_CONNECTION
    if reaction is None or reaction.value != BY_QUICK_STOP or axis % 0x800:
        return []
    if options.quick_stop is None:
        said = f'{{ index = {_QUICK_STOP + axis:#06x}, type = "i16", value = 2, writable = true }}'
        return [f"{key}: is missing; with options.abort_connection.value = 3 it says whether torque goes: {said}"]
    if options.quick_stop.index != _QUICK_STOP + axis:
        return [f"{key}.index: {options.quick_stop.index:#06x}; allowed: {_QUICK_STOP + axis:#06x}"]
    if options.quick_stop.value not in QUICK_STOP_OFF:
        return [
            f"{key}.value: {options.quick_stop.value} leaves the drive in quick stop, under torque; allowed: 0 to 4"
        ]
    return []


def _drive_type_problems(objects: DriveObjects) -> list[str]:
    problems = type_problems("objects.controlword", objects.controlword.type, ("u16",))
    problems += type_problems("objects.statusword", objects.statusword.type, ("u16",))
    problems += type_problems("objects.mode", objects.mode.type, ("i8",))
    if (displayed := objects.mode_displayed) is not None:
        problems += type_problems("objects.mode_displayed", displayed.type, ("i8",))
    if objects.target_torque.range is not None:
        problems += range_problems("objects.target_torque", objects.target_torque.range)
    if (sto := objects.safe_torque_off) is not None:
        problems += type_problems("objects.safe_torque_off", sto.type, INTEGERS)
        problems += bit_problems("objects.safe_torque_off", sto.bit, sto.type)
    rated = objects.rated_torque
    if rated is not None and rated.unit == "rated torque":
        problems.append("objects.rated_torque.unit: 'rated torque' of itself says nothing; allowed: Nm, mNm")
    return problems
