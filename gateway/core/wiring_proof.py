"""The proof that a line is wired as its file says, and the hash of the wiring that it holds for. Pure.

A proof is made with the web at rest (`r2rgate prove`): each drive by itself with a small torque, each load cell's
answer, each watchdog's reaction. It holds for one wiring: the tables of buses, drives, load cells and the line PLC, the
bytes of the device maps that these name, and the serial numbers of the devices. Whatever of it changes, the proof is
one of another line.
"""

import hashlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field

from gateway.core.canonical import hash_of
from gateway.core.deployment import Hash
from gateway.core.finding import Code, Finding, finding
from gateway.core.line import Drive, Line, LinePlc, LoadCell, Name, NonNegative, Positive, Strict

Device = TypeVar("Device", Drive, LoadCell, LinePlc)

MOST_DEVICES = 200
LONGEST_TEXT = 120  #: characters, of a serial number and of a person's name

Text = Annotated[str, Field(max_length=LONGEST_TEXT)]
Roller = Annotated[int, Field(ge=1, le=60)]
Span = Annotated[int, Field(ge=1, le=60)]

#: Keys of devices and buses that are no wiring: another value of them leaves what was proved as it is.
NO_WIRING = {
    "drives": {"braking_torque_nm", "braking_power_w", "braking_energy_j"},
    "load_cells": set[str](),
    "plc": {"speed_lag_s"},
    "buses": {"certificate", "private_key", "server_certificate"},
}


class DriveProved(Strict):
    """A drive that turned its own roller, the way that its torque said."""

    drive: Name
    roller: Roller
    torque_nm: float  #: the greatest that was given
    way_m: float  #: of the roller's surface, with the sign of the line's direction
    answered: list[Span]  #: whose load cells answered to it


class CellProved(Strict):
    """A load cell that sees the tension of its own span."""

    cell: Name
    span: Span
    zero_n: float  #: with a slack web
    factor: float  #: the change that it told, of the change that the torque explains
    answered_to: list[Roller]


class WatchdogProved(Strict):
    """A device whose reaction to silence was seen, or, where `reacted_s` is None, is known otherwise: `how`."""

    device: Name
    deadline_s: Positive
    reacted_s: NonNegative | None  #: from the last command
    how: Text  #: what was withheld, and what was seen


class Answer(Strict):
    """What a person has said where no torque that is allowed can show it."""

    question: Code
    device: Name
    by: Text


class DeviceIdentity(Strict):
    """What a device was when it was proved."""

    device: Name
    map: Name
    map_hash: Hash  #: SHA-256 of the map's file
    serial: Text  #: "": it tells none


class WiringProof(Strict):
    format: Literal[1] = 1
    wiring: Hash  #: `wiring_hash`
    wall_s: NonNegative  #: when, since 1970
    devices: Annotated[list[DeviceIdentity], Field(max_length=MOST_DEVICES)] = []
    drives: Annotated[list[DriveProved], Field(max_length=MOST_DEVICES)]
    cells: Annotated[list[CellProved], Field(max_length=MOST_DEVICES)]
    watchdogs: Annotated[list[WatchdogProved], Field(max_length=MOST_DEVICES)]
    answers: Annotated[list[Answer], Field(max_length=MOST_DEVICES)] = []


#: Questions whose answer stands in place of what no pull has shown, of a drive and of a load cell.
IN_PLACE_OF_A_PULL = {"drive": ("roller-did-not-move", "drive-direction-unseen"), "cell": ("cell-unseen",)}


def asked_of(question: Finding) -> str:
    """The device that a question is about: a drive or a load cell, by its name."""
    parameters = question.parameters
    return str(parameters.get("drive", parameters.get("cell", parameters.get("device", ""))))


def proof_hash(proof: WiringProof) -> Hash:
    """Of all that a proof says, as the audit has it."""
    return hash_of(proof.model_dump(mode="json"))


def devices_of(line: Line) -> list[Drive | LoadCell | LinePlc]:
    """Every device of the line."""
    return [*line.drives, *line.load_cells, line.plc]


def device_identities(line: Line, maps: Mapping[str, bytes], serials: Mapping[str, str]) -> list[DeviceIdentity]:
    """Every device with the hash of its map and its serial number."""
    return [
        DeviceIdentity(
            device=device.name,
            map=device.map,
            map_hash=hashlib.sha256(maps.get(device.map, b"")).hexdigest(),
            serial=serials.get(device.name, "")[:LONGEST_TEXT],
        )
        for device in devices_of(line)
    ]


def wiring_hash(line: Line, maps: Mapping[str, bytes], serials: Mapping[str, str]) -> Hash:
    """The hash of what is wired to what: `maps` are the files of device maps by name, `serials` are by device.

    How a span is controlled is part of it: what its load cell shows is acted upon, or is not.

    A device without a serial number has "" or no entry. Keys that stand at their default do not count, so that a key
    that is new in a later version leaves a proof as it is. A map that is not there counts as an empty one.
    """
    return _hash_of(line, device_identities(line, maps, serials))


def _hash_of(line: Line, devices: Sequence[DeviceIdentity]) -> Hash:
    wiring = {
        "rollers": len(line.rollers),
        "spans": [span.control for span in line.spans],
        "watchdog_s": line.limits.watchdog_s,
        "tables": dict(_tables(line)),
        "devices": [one.model_dump() for one in devices],
    }
    return hash_of(wiring)


def _tables(line: Line) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    tables: dict[str, Sequence[Strict]] = {
        "drives": line.drives, "load_cells": line.load_cells, "plc": [line.plc], "buses": line.buses,
    }  # fmt: skip
    for name, rows in tables.items():
        without = NO_WIRING[name]
        yield name, [row.model_dump(mode="json", exclude_defaults=True, exclude=without) for row in rows]


def why_not_proved(
    proof: WiringProof | None, line: Line, maps: Mapping[str, bytes], serials: Mapping[str, str]
) -> list[Finding]:
    """What speaks against closing the loop on this wiring; empty: it is the one that was proved."""
    if proof is None:
        return [finding("wiring-unproved")]
    if proof.wiring == wiring_hash(line, maps, serials):
        return not_shown(line, proof.drives, proof.cells, proof.answers) + undrilled(line, proof.watchdogs)
    return list(_changes(proof, device_identities(line, maps, serials))) or [finding("wiring-changed")]


def more_than(
    only: Collection[str],
    proof: WiringProof | None,
    line: Line,
    maps: Mapping[str, bytes],
    serials: Mapping[str, str],
) -> list[Finding]:
    """What speaks against proving nothing but `only` anew; empty: nothing else has changed since `proof`.

    Of the devices named nothing need have changed: many tell no serial number, and a person knows what was exchanged.
    """
    if proof is None:
        return [finding("wiring-unproved")]
    today = device_identities(line, maps, serials)
    others = [each for each in _changes(proof, today) if each.parameters["device"] not in only]
    if not others and _hash_as_proved(proof, line, today, only) != proof.wiring:
        others = [finding("wiring-changed")]
    unshown = not_shown(line, proof.drives, proof.cells, proof.answers)
    return others + [each for each in unshown if each.parameters["device"] not in only]


def _hash_as_proved(proof: WiringProof, line: Line, today: Sequence[DeviceIdentity], only: Collection[str]) -> Hash:
    """The hash of the wiring if the devices of `only` were still those that were proved, with the maps of then."""
    proved = {one.device: one for one in proof.devices if one.device in only}

    def mapped(device: Device) -> Device:
        was = proved.get(device.name)
        return device if was is None else device.model_copy(update={"map": was.map})

    as_proved = line.model_copy(
        update={
            "drives": [mapped(drive) for drive in line.drives],
            "load_cells": [mapped(cell) for cell in line.load_cells],
            "plc": mapped(line.plc),
        }
    )
    return _hash_of(as_proved, [proved.get(one.device, one) for one in today])


def merged(
    proof: WiringProof,
    only: Collection[str],
    drives: Sequence[DriveProved],
    cells: Sequence[CellProved],
    answers: Sequence[Answer],
) -> tuple[list[DriveProved], list[CellProved], list[Answer]]:
    """What `proof` says of all others, and what has been shown and answered now of those in `only`."""
    said = {(answer.question, answer.device) for answer in answers}
    kept = [one for one in proof.answers if one.device not in only and (one.question, one.device) not in said]
    return (
        sorted([*(one for one in proof.drives if one.drive not in only), *drives], key=lambda one: one.roller),
        sorted([*(one for one in proof.cells if one.cell not in only), *cells], key=lambda one: one.span),
        [*kept, *answers],
    )


def undrilled(line: Line, watchdogs: Sequence[WatchdogProved]) -> list[Finding]:
    """Drives and the line PLC of which no drill says what their watchdogs do, or that they have none."""
    drilled = {one.device for one in watchdogs}
    names = [*(drive.name for drive in line.drives), line.plc.name]
    return [finding("watchdog-unshown", device=name) for name in names if name not in drilled]


def not_shown(
    line: Line, drives: Sequence[DriveProved], cells: Sequence[CellProved], answers: Sequence[Answer]
) -> list[Finding]:
    """Drives and load cells of the line that neither a pull has shown nor a person has answered for."""
    said = {(answer.device, answer.question) for answer in answers}

    def is_said(device: str, kind: str) -> bool:
        return any((device, question) in said for question in IN_PLACE_OF_A_PULL[kind])

    shown = {(one.drive, one.roller) for one in drives if one.answered or is_said(one.drive, "drive")}
    shown |= {(one.cell, one.span) for one in cells if one.answered_to or is_said(one.cell, "cell")}
    wanted = [(drive.name, drive.roller) for drive in line.drives] + [
        (cell.name, cell.span) for cell in line.load_cells
    ]
    return [finding("device-unshown", device=name) for name, number in wanted if (name, number) not in shown]


def _changes(proof: WiringProof, today: list[DeviceIdentity]) -> Iterator[Finding]:
    """Devices that are not what they were. A change of the line's file is not among them."""
    proved = {one.device: one for one in proof.devices}
    for now in today:
        before = proved.get(now.device)
        if before is None:
            yield finding("device-unproved", device=now.device)
        elif before.serial != now.serial:
            yield finding("device-exchanged", device=now.device, proved=before.serial or "-", now=now.serial or "-")
        elif before.map_hash != now.map_hash:
            yield finding("map-changed", device=now.device, map=now.map)
