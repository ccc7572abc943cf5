"""The map of a line PLC on CANopen."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from drivers.canopen.map_parts import (
    UNSIGNED,
    CanMap,
    CanObject,
    Pdo,
    Watchdog,
    WebSpeedObject,
    emergency_problems,
    heartbeat_problems,
    pdo_problems,
    place_problems,
    watchdog_problems,
)
from drivers.map_fields import Bit, refuse_together
from drivers.map_rules import bit_problems, range_problems, type_problems
from gateway.core.line import Strict


class PlcRead(Strict):
    status: CanObject
    permissive: Bit
    emergency_stop: Bit  #: yes: the emergency stop circuit is open
    running: Bit
    watchdog_tripped: Bit
    local: Bit | None = None  #: yes: the line is not started from elsewhere
    speed: WebSpeedObject
    life_echo: CanObject


class PlcWrite(Strict):
    command: CanObject
    run: Bit
    warning: Bit | None = None  #: lamp and horn before anything moves
    speed: WebSpeedObject
    life: CanObject


class PlcReceivePdo(Pdo):
    objects: Annotated[list[Literal["command", "speed", "life"]], Field(min_length=1, max_length=8)]


class PlcTransmitPdo(Pdo):
    objects: Annotated[list[Literal["status", "speed", "life_echo"]], Field(min_length=1, max_length=8)]


class PlcMap(CanMap):
    role: Literal["line-plc"]
    read: PlcRead
    write: PlcWrite
    receive_pdo: PlcReceivePdo
    transmit_pdo: PlcTransmitPdo
    watchdog: Watchdog

    def objects_of(self, pdo: PlcReceivePdo | PlcTransmitPdo) -> list[CanObject]:
        """The objects of a PDO in mapping order."""
        table = self.write if isinstance(pdo, PlcReceivePdo) else self.read
        return [getattr(table, name) for name in pdo.objects]

    @model_validator(mode="after")
    def _layout(self) -> "PlcMap":
        read, write = dict(self.read), dict(self.write)
        problems = pdo_problems("receive_pdo", self.receive_pdo.objects, write, ["command", "speed", "life"])
        problems += pdo_problems("transmit_pdo", self.transmit_pdo.objects, read, ["status", "speed", "life_echo"])
        objects = {f"read.{name}": entry for name, entry in read.items() if isinstance(entry, CanObject)}
        objects |= {f"write.{name}": entry for name, entry in write.items() if isinstance(entry, CanObject)}
        problems += place_problems({**objects, "watchdog": self.watchdog, "heartbeat": self.heartbeat})
        for key in ("read.status", "write.command"):
            problems += type_problems(key, objects[key].type, UNSIGNED)
        for key in ("read.life_echo", "write.life"):
            problems += type_problems(key, objects[key].type, ("u16", "u32"))
        problems += bit_problems("write.run", self.write.run.bit, self.write.command.type)
        if self.write.warning is not None:
            problems += bit_problems("write.warning", self.write.warning.bit, self.write.command.type)
        for name in ("permissive", "emergency_stop", "running", "watchdog_tripped", "local"):
            if read[name] is not None:
                problems += bit_problems(f"read.{name}", read[name].bit, self.read.status.type)
        problems += range_problems("read.speed", self.read.speed.range)
        problems += range_problems("write.speed", self.write.speed.range)
        if self.watchdog.kind != "receive-pdo":
            problems.append(f"watchdog.kind: {self.watchdog.kind!r}; allowed: 'receive-pdo', the life counter's")
        problems += emergency_problems(self.emergency)
        return refuse_together(self, problems + watchdog_problems(self.watchdog) + heartbeat_problems(self.heartbeat))
