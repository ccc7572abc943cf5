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
    heartbeat_problems,
    pdo_problems,
    place_problems,
    watchdog_problems,
)
from drivers.map_fields import Bit, Range, refuse_together
from drivers.map_rules import INTEGERS, bit_problems, range_problems, type_problems
from gateway.core.line import Strict


class SafeTorqueOff(CanObject, Bit):
    """Where the drive says that its hard-wired safe torque off is active."""


class TargetTorqueObject(TorqueObject):
    range: Range | None = None  #: what the object takes, in its unit, where that is less than its type


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


class DriveOptions(Strict):
    """Settings that decide what the rest of the map means."""

    abort_connection: OptionObject | None = None  #: what it does when its watchdog fires; must take torque off
    fault_reaction: OptionObject | None = None
    speed_unit: OptionObject | None = None  #: the unit of `objects.speed`, where the device lets it be chosen

    def present(self) -> list[OptionObject]:
        return [option for _, option in self if option is not None]


DriveEntry = Literal["controlword", "statusword", "mode", "target_torque", "torque", "speed", "safe_torque_off"]


class DrivePdo(Pdo):
    objects: Annotated[list[DriveEntry], Field(min_length=1, max_length=8)]


class DriveMap(CanMap):
    role: Literal["drive"]
    cyclic_torque_mode: Annotated[int, Field(ge=-128, le=127)]
    follows_command: Bit | None = None  #: of the statusword: the target torque is followed, not ignored
    objects: DriveObjects
    options: DriveOptions = DriveOptions()
    receive_pdo: DrivePdo
    transmit_pdo: DrivePdo
    watchdog: Watchdog

    def objects_of(self, pdo: DrivePdo) -> list[CanObject]:
        """The objects of a PDO in mapping order."""
        return [getattr(self.objects, name) for name in pdo.objects]

    @property
    def speed(self) -> SpeedObject:
        """The roller's."""
        return self.objects.speed

    @model_validator(mode="after")
    def _layout(self) -> "DriveMap":
        entries = dict(self.objects)
        receive, transmit = self.receive_pdo.objects, self.transmit_pdo.objects
        problems = pdo_problems("receive_pdo", receive, entries, ["controlword", "target_torque"])
        problems += pdo_problems("transmit_pdo", transmit, entries, ["statusword", "speed", "torque"])
        problems += place_problems({f"objects.{name}": entry for name, entry in entries.items() if entry is not None})
        problems += _drive_type_problems(self.objects)
        if self.follows_command is not None:
            problems += bit_problems("follows_command", self.follows_command.bit, "u16")
        for name, option in self.options:
            if option is not None:
                problems += type_problems(f"options.{name}", option.type, INTEGERS)
        return refuse_together(self, problems + watchdog_problems(self.watchdog) + heartbeat_problems(self.heartbeat))


def _drive_type_problems(objects: DriveObjects) -> list[str]:
    problems = type_problems("objects.controlword", objects.controlword.type, ("u16",))
    problems += type_problems("objects.statusword", objects.statusword.type, ("u16",))
    problems += type_problems("objects.mode", objects.mode.type, ("i8",))
    if objects.target_torque.range is not None:
        problems += range_problems("objects.target_torque", objects.target_torque.range)
    if (sto := objects.safe_torque_off) is not None:
        problems += type_problems("objects.safe_torque_off", sto.type, INTEGERS)
        problems += bit_problems("objects.safe_torque_off", sto.bit, sto.type)
    rated = objects.rated_torque
    if rated is not None and rated.unit == "rated torque":
        problems.append("objects.rated_torque.unit: 'rated torque' of itself says nothing; allowed: Nm, mNm")
    return problems
