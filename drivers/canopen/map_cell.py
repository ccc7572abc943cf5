"""The map of a load-cell amplifier on CANopen."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from drivers.canopen.map_parts import (
    UNSIGNED,
    CanMap,
    CanObject,
    Index,
    ObjectType,
    Pdo,
    emergency_problems,
    heartbeat_problems,
    size_problems,
)
from drivers.map_fields import Bit, TensionUnit, refuse_together
from drivers.map_rules import bit_problems, type_problems
from gateway.core.line import Positive, Strict

COB_ID_STEP = 0x100  #: from one PDO of a node to its next (CiA 301, predefined connection set)


class ChannelObject(Strict):
    """An object whose sub-index is the channel."""

    index: Index
    type: ObjectType

    def of_channel(self, channel: int) -> CanObject:
        return CanObject(index=self.index, sub=channel, type=self.type)


class ChannelTension(ChannelObject):
    unit: TensionUnit
    scale: Positive = 1.0
    digits: ChannelObject | None = None  #: where the device says how many decimal digits a count has (CiA 404)


class ChannelStatus(ChannelObject):
    ok: int
    texts: dict[str, str] = {}  #: what the other values mean; keys are the values


class ChannelCheck(ChannelObject):
    value: int  #: what a channel must have there


class Healthy(CanObject, Bit):
    """Where the amplifier says that it is healthy."""


class LoadCellObjects(Strict):
    channel_count: CanObject
    sample_counter: CanObject  #: moves with every measurement: a frozen amplifier is found by it
    tension: ChannelTension
    status: ChannelStatus | None = None
    physical_unit: ChannelCheck | None = None
    healthy: Healthy | None = None


ChannelEntry = Literal["tension", "status", "sample_counter"]


class ChannelPdos(Pdo):
    """Several PDOs alike, for as many channels each as `objects` lists "tension". Communication, mapping and COB-ID
    are those of the first; of each further one the records are the next, the COB-ID 100h higher."""

    count: Annotated[int, Field(ge=1, le=4)]
    objects: Annotated[list[ChannelEntry], Field(min_length=2, max_length=8)]

    @property
    def channels_each(self) -> int:
        return self.objects.count("tension")


class LoadCellMap(CanMap):
    role: Literal["load-cell"]
    objects: LoadCellObjects
    transmit_pdos: ChannelPdos

    @property
    def channels(self) -> int:
        return self.transmit_pdos.count * self.transmit_pdos.channels_each

    def transmit_pdo(self, pdo: int) -> Pdo:
        """PDO `pdo`, counted from 0."""
        first = self.transmit_pdos
        return Pdo(
            communication=first.communication + pdo,
            mapping=first.mapping + pdo,
            cob_id=first.cob_id + COB_ID_STEP * pdo,
            writable=first.writable,
        )

    def objects_of(self, pdo: int) -> list[CanObject]:
        """The objects of PDO `pdo`, counted from 0, in mapping order."""
        first = pdo * self.transmit_pdos.channels_each
        seen = {"tension": first, "status": first}
        entries: list[CanObject] = []
        for name in self.transmit_pdos.objects:
            if name == "sample_counter":
                entries.append(self.objects.sample_counter)
                continue
            seen[name] += 1
            entry = getattr(self.objects, name)
            entries.append(entry.of_channel(seen[name]))
        return entries

    @model_validator(mode="after")
    def _layout(self) -> "LoadCellMap":
        names, objects = self.transmit_pdos.objects, self.objects
        needed = ("sample_counter", "tension")
        problems = [f"transmit_pdos.objects: lacks {name}" for name in needed if name not in names]
        if names.count("sample_counter") > 1:
            problems.append("transmit_pdos.objects: sample_counter listed twice")
        wanted = names.count("tension") if objects.status is not None else 0
        if names.count("status") != wanted:
            problems.append(f"transmit_pdos.objects: {names.count('status')} times status; allowed: {wanted}")
        else:
            problems += size_problems("transmit_pdos", self.objects_of(0))
        problems += type_problems("objects.channel_count", objects.channel_count.type, UNSIGNED)
        problems += type_problems("objects.sample_counter", objects.sample_counter.type, UNSIGNED)
        if objects.status is not None:
            problems += type_problems("objects.status", objects.status.type, UNSIGNED)
        if objects.tension.digits is not None:
            problems += type_problems("objects.tension.digits", objects.tension.digits.type, ("u8", "i8"))
        if (healthy := objects.healthy) is not None:
            problems += type_problems("objects.healthy", healthy.type, UNSIGNED)
            problems += bit_problems("objects.healthy", healthy.bit, healthy.type)
        problems += emergency_problems(self.emergency)
        return refuse_together(self, problems + heartbeat_problems(self.heartbeat))
