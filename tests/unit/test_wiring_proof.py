"""For which wiring a proof holds: for exactly the one that was proved."""

import pytest
from pydantic import ValidationError

from gateway.cli.stepped import shown_as_described
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.wiring_proof import (
    Answer,
    DriveProved,
    WatchdogProved,
    WiringProof,
    device_identities,
    devices_of,
    merged,
    more_than,
    why_not_proved,
    wiring_hash,
)

LINE = load_line(line_template(3), "line.toml")
MAPS = {device.map: f"map {device.map}".encode() for device in devices_of(LINE)}
SERIALS = {"drive-1": "4711", "drive-2": "4712"}


def proof(line: Line = LINE, maps=MAPS, serials=SERIALS) -> WiringProof:
    drives, cells, watchdogs = shown_as_described(line)
    return WiringProof(
        wiring=wiring_hash(line, maps, serials), wall_s=1.8e9, devices=device_identities(line, maps, serials),
        drives=drives, cells=cells, watchdogs=watchdogs,
    )  # fmt: skip


def changed(table: str, index: int | None = None, **values) -> Line:
    """The line with other values in one row of a table, or in a table that has no rows."""
    plain = LINE.model_dump(mode="json")
    (plain[table] if index is None else plain[table][index]).update(values)
    return Line.model_validate(plain)


def codes(found):
    return [(one.code, one.parameters.get("device")) for one in found]


def test_the_wiring_that_was_proved_is_proved():
    assert why_not_proved(proof(), LINE, MAPS, SERIALS) == []
    assert why_not_proved(WiringProof.model_validate_json(proof().model_dump_json()), LINE, MAPS, SERIALS) == []


def test_a_line_without_a_proof_is_unproved():
    assert codes(why_not_proved(None, LINE, MAPS, SERIALS)) == [("wiring-unproved", None)]


@pytest.mark.parametrize(
    "line",
    [
        changed("drives", 0, channel=2),
        changed("drives", 0, rated_torque_nm=LINE.drives[0].rated_torque_nm * 2),
        changed("load_cells", 1, address=99),
        changed("load_cells", 1, capacity_n=LINE.load_cells[1].capacity_n * 2),
        changed("plc", address=99),
        changed("limits", watchdog_s=0.15),
        changed("spans", 2, control="draw"),
    ],
    ids=["channel", "rated torque", "node of a cell", "capacity", "node of the PLC", "deadline", "control"],
)
def test_another_wiring_is_not_the_one_that_was_proved(line):
    assert codes(why_not_proved(proof(), line, MAPS, SERIALS)) == [("wiring-changed", None)]


def test_two_cells_that_change_places_in_the_file_are_another_wiring():
    first, second = LINE.load_cells[0], LINE.load_cells[1]
    crossed = changed("load_cells", 0, address=second.address, channel=second.channel).model_dump(mode="json")
    crossed["load_cells"][1].update(address=first.address, channel=first.channel)
    assert why_not_proved(proof(), Line.model_validate(crossed), MAPS, SERIALS)


@pytest.mark.parametrize(
    "line",
    [
        changed("limits", tension_max_n=LINE.limits.tension_max_n * 1.1),
        changed("drives", 0, braking_torque_nm=1.0, braking_power_w=100.0),
        changed("plc", speed_lag_s=0.1),
        changed("gate", cool_down_s=5.0),
    ],
    ids=["limit", "braking", "lag", "gate"],
)
def test_what_is_no_wiring_leaves_the_proof_as_it_is(line):
    assert why_not_proved(proof(), line, MAPS, SERIALS) == []


def test_another_device_is_named_with_both_numbers():
    (found,) = why_not_proved(proof(), LINE, MAPS, SERIALS | {"drive-2": "4799"})
    assert (found.code, found.parameters) == (
        "device-exchanged", {"device": "drive-2", "proved": "4712", "now": "4799"},
    )  # fmt: skip


def test_a_device_that_tells_its_number_no_more_is_another_one():
    assert codes(why_not_proved(proof(), LINE, MAPS, {"drive-1": "4711"})) == [("device-exchanged", "drive-2")]


def test_no_number_is_the_same_as_an_empty_one():
    assert why_not_proved(proof(), LINE, MAPS, SERIALS | {"drive-3": ""}) == []


def test_a_device_map_that_was_edited_is_named_for_each_device_that_has_it():
    name = LINE.drives[0].map
    found = why_not_proved(proof(), LINE, MAPS | {name: MAPS[name] + b"\n"}, SERIALS)
    assert codes(found) == [("map-changed", drive.name) for drive in LINE.drives]


def test_a_device_that_is_new_is_named():
    renamed = changed("drives", 1, name="drive-new")
    assert ("device-unproved", "drive-new") in codes(why_not_proved(proof(), renamed, MAPS, SERIALS))


DRIVE, CELL = LINE.drives[1].name, LINE.load_cells[1].name


def leaving_out(**updates) -> WiringProof:
    """The proof, its second drive or load cell with these values; None: without it."""
    parts = {"drives": list(proof().drives), "cells": list(proof().cells)}
    for table, update in updates.items():
        parts[table][1:2] = [] if update is None else [parts[table][1].model_copy(update=update)]
    return proof().model_copy(update=parts)


@pytest.mark.parametrize(
    ("partial", "names"),
    [
        (leaving_out(drives=None), [DRIVE]),
        (leaving_out(drives={"answered": []}), [DRIVE]),
        (leaving_out(drives={"roller": 3}), [DRIVE]),
        (leaving_out(cells=None), [CELL]),
        (leaving_out(cells={"answered_to": []}), [CELL]),
        (leaving_out(cells={"span": 1}), [CELL]),
        (leaving_out(drives=None, cells=None), [DRIVE, CELL]),
    ],
)
def test_a_kept_proof_that_leaves_a_device_out_is_none(partial, names):
    assert codes(why_not_proved(partial, LINE, MAPS, SERIALS)) == [("device-unshown", name) for name in names]


@pytest.mark.parametrize("question", ["roller-did-not-move", "drive-direction-unseen"])
def test_a_person_may_answer_for_a_drive_that_has_pulled_and_for_no_other(question):
    answer = Answer(question=question, device=DRIVE, by="somebody")
    partial = leaving_out(drives={"answered": []}).model_copy(update={"answers": [answer]})
    assert why_not_proved(partial, LINE, MAPS, SERIALS) == []
    never = leaving_out(drives=None).model_copy(update={"answers": [answer]})
    assert codes(why_not_proved(never, LINE, MAPS, SERIALS)) == [("device-unshown", DRIVE)]


def test_a_person_may_answer_for_a_load_cell_that_no_drive_could_show():
    partial = leaving_out(cells={"answered_to": []})
    factor = Answer(question="cell-factor-unseen", device=CELL, by="somebody")  # says nothing of where it is
    of_another = partial.model_copy(update={"answers": [factor]})
    assert codes(why_not_proved(of_another, LINE, MAPS, SERIALS)) == [("device-unshown", CELL)]
    unseen = factor.model_copy(update={"question": "cell-unseen"})
    assert why_not_proved(partial.model_copy(update={"answers": [unseen]}), LINE, MAPS, SERIALS) == []


@pytest.mark.parametrize("name", [LINE.drives[0].name, LINE.plc.name])
def test_a_proof_that_was_kept_without_the_drill_of_a_device_is_none(name):
    watchdogs = [one for one in proof().watchdogs if one.device != name]
    undrilled = proof().model_copy(update={"watchdogs": watchdogs})
    assert codes(why_not_proved(undrilled, LINE, MAPS, SERIALS)) == [("watchdog-unshown", name)]
    assert more_than([DRIVE], undrilled, LINE, MAPS, SERIALS) == [], "the drill that comes before it has all devices"


# Few devices are proved anew


def mapped_anew() -> Line:
    """The second drive is of another make: the file names another map for it."""
    return changed("drives", 1, map="cia402-torque" if LINE.drives[1].map != "cia402-torque" else "other-torque")


@pytest.mark.parametrize(
    ("line", "maps", "serials"),
    [
        (LINE, MAPS, SERIALS),  # tells no number: a person says that it is another one
        (LINE, MAPS, SERIALS | {DRIVE: "4799"}),
        (LINE, MAPS, {"drive-1": "4711"}),
        (mapped_anew(), MAPS | {mapped_anew().drives[1].map: b"another map"}, SERIALS | {DRIVE: "4799"}),
    ],
    ids=["nothing", "number", "no number", "map"],
)
def test_what_is_named_may_have_been_exchanged(line, maps, serials):
    assert more_than([DRIVE], proof(), line, maps, serials) == []
    # and for any other one what differs is named
    others = codes(more_than([CELL], proof(), line, maps, serials))
    assert len(others) == (why_not_proved(proof(), line, maps, serials) != [])


@pytest.mark.parametrize(
    ("line", "maps", "serials", "found"),
    [
        (LINE, MAPS, SERIALS | {DRIVE: "4799", "drive-1": "4798"}, ("device-exchanged", "drive-1")),
        (changed("load_cells", 1, address=99), MAPS, SERIALS | {DRIVE: "4799"}, ("wiring-changed", None)),
        (changed("drives", 1, channel=2), MAPS, SERIALS, ("wiring-changed", None)),
        (changed("drives", 1, direction="reversed"), MAPS, SERIALS, ("wiring-changed", None)),
        (changed("limits", watchdog_s=0.15), MAPS, SERIALS, ("wiring-changed", None)),
    ],
    ids=["another number", "node of a cell", "its own channel", "its own direction", "deadline"],
)
def test_whatever_else_has_changed_asks_for_a_whole_proof(line, maps, serials, found):
    assert codes(more_than([DRIVE], proof(), line, maps, serials)) == [found]


def test_a_map_that_others_have_too_asks_for_them():
    name = LINE.drives[1].map
    found = more_than([DRIVE], proof(), LINE, MAPS | {name: b"edited"}, SERIALS)
    assert codes(found) == [("map-changed", drive.name) for drive in LINE.drives if drive.name != DRIVE]


def test_there_is_nothing_to_add_to_without_a_proof_or_with_one_that_leaves_something_out():
    assert codes(more_than([DRIVE], None, LINE, MAPS, SERIALS)) == [("wiring-unproved", None)]
    partial = leaving_out(drives=None, cells=None)
    assert codes(more_than([DRIVE], partial, LINE, MAPS, SERIALS)) == [("device-unshown", CELL)]


def test_of_what_is_named_nothing_old_stays_and_of_others_everything():
    asked = [Answer(question=code, device=name, by="then") for name in (DRIVE, CELL) for code in ("cell-unseen",)]
    before = proof().model_copy(update={"answers": asked})
    drive = before.drives[1].model_copy(update={"torque_nm": 2.0})
    now = Answer(question="drive-torque-unseen", device=DRIVE, by="now")
    drives, cells, answers = merged(before, [DRIVE], [drive], [], [now])
    assert drives == [before.drives[0], drive, before.drives[2]] and cells == before.cells
    assert answers == [asked[1], now]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0, "0.1"])
def test_numbers_of_a_proof_are_numbers(value):
    with pytest.raises(ValidationError):
        WatchdogProved(device="drive-1", deadline_s=value, reacted_s=None, how="")
    with pytest.raises(ValidationError):
        DriveProved(drive="drive-1", roller=value, torque_nm=1.0, way_m=0.1, answered=[1])
