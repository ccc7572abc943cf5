"""Drives whose watchdog listens to the gateway's heartbeat, as the shipped EPOS4 map has it, against scripted ones."""

import asyncio
import struct
from collections.abc import Awaitable, Callable
from math import nan
from pathlib import Path

import pytest

from drivers.canopen.heartbeat import HeartbeatProducer
from drivers.canopen.link import CanopenLink
from drivers.device_map import MapRefused, load_map
from drivers.map_fields import MAPS
from drivers.port import PrepareRefused
from drivers.registry import LinksRefused, build_links
from gateway.core.finding import finding
from gateway.core.line import Line
from gateway.core.signals import DriveRequest, DriveState, Inputs, Outputs
from tests.protocol.driver_support import (
    ENABLED,
    FAULT,
    GROUP,
    READY,
    SWITCH_ON_DISABLED,
    Drive,
    Drives,
    cycle,
    line,
    until,
)
from tests.support.ports import free_port

MAP = "maxon-epos4-50-15-can"
OURS = (0x77F, b"\x05")


class Epos(Drive):
    """The objects that the map needs, with the device's own units; the rest as any drive has it."""

    def __init__(self, node: int) -> None:
        super().__init__(node)
        for absent in ((0x1400, 5), (0x6072, 0), (0x60FD, 0)):
            del self.objects[absent]
        self.objects |= {
            (0x1016, 1): bytes(4),
            (0x1018, 1): struct.pack("<I", 0xFB),
            (0x1018, 2): struct.pack("<I", 0x65520000),
            (0x6007, 0): struct.pack("<h", 3),
            (0x6040, 0): bytes(2),
            (0x6076, 0): struct.pack("<I", 512_871),  # uNm
            (0x60A9, 0): struct.pack("<I", 0x00B44700),
        }


class Bus(Drives):
    """Keeps what the link sends as its own heartbeat, which the other peers take for an echo."""

    def __init__(self, drives: list[Drive], port: int) -> None:
        self.heartbeats: list[tuple[int, bytes]] = []
        super().__init__(drives, interface="udp_multicast", channel=GROUP, port=port, hop_limit=0, fd=False)

    def _on_frame(self, cob_id: int, data: bytes) -> None:
        if cob_id == OURS[0]:
            self.heartbeats.append((cob_id, data))
        super()._on_frame(cob_id, data)

    async def settle(self) -> None:
        """Read everything that was sent before."""
        seen = len(self.frames)
        self.send(0x67F, bytes(8))
        await until(lambda: any(cob_id == 0x67F for cob_id, _ in self.frames[seen:]))


def epos_line(port: int = 5000) -> Line:
    good = line(2, can_bus={"interface": "udp_multicast", "channel": GROUP, "port": port})
    drives = [drive.model_copy(update={"map": MAP, "rated_torque_nm": 0.512871}) for drive in good.drives]
    limits = good.limits.model_copy(update={"torque_nm": 1.0})
    return good.model_copy(update={"drives": drives, "limits": limits})


Body = Callable[[CanopenLink, Bus, Epos, Epos], Awaitable[None]]


def bench(body: Body) -> None:
    async def run() -> None:
        port = free_port()
        first, second = Epos(1), Epos(2)
        link = build_links(epos_line(port))[0]
        assert isinstance(link, CanopenLink)
        async with Bus([first, second], port) as bus:
            await link.open()
            try:
                await body(link, bus, first, second)
            finally:
                await link.close()

    asyncio.run(run())


async def enabled(link: CanopenLink, bus: Bus, inputs: Inputs, first: Epos, second: Epos) -> None:
    """Prepared, enabled, and one heartbeat sent."""
    await link.prepare()
    first.statusword = second.statusword = ENABLED
    await cycle(link, inputs)
    write(link, 0.25)
    await bus.settle()
    assert bus.heartbeats == [OURS]
    bus.heartbeats.clear()


def write(link: CanopenLink, *torque_nm: float) -> None:
    outputs = Outputs(2)
    outputs.drive_request[:] = DriveRequest.ENABLE
    outputs.torque_nm[:] = torque_nm
    link.write(outputs)


def forget_the_last_heartbeat(link: CanopenLink) -> None:
    """The next one is due, whatever the clock says."""
    assert link._feed._heartbeat is not None  # noqa: SLF001
    link._feed._heartbeat.forget()  # noqa: SLF001


def test_the_watchdog_is_an_entry_of_1016h_and_its_reaction_is_set() -> None:
    async def body(link: CanopenLink, bus: Bus, first: Epos, second: Epos) -> None:
        await link.prepare()
        for drive in (first, second):
            assert drive.objects[0x1016, 1] == bytes.fromhex("6400 7F00"), "100 ms of node 127"
            assert drive.objects[0x6007, 0] == struct.pack("<h", 2), "disable voltage"
            assert drive.objects[0x60A9, 0] == struct.pack("<I", 0x00B44700)
        await bus.settle()
        assert bus.heartbeats == [], "nothing but `write` sends it"
        await link.release()
        await bus.settle()
        assert first.objects[0x1016, 1] == second.objects[0x1016, 1] == bytes(4), "nobody waits any more"
        assert first.nmt[-1] == 0x80
        write(link, 0.25)
        await bus.settle()
        assert bus.heartbeats == []

    bench(body)


@pytest.mark.parametrize(
    ("place", "value", "code"),
    [
        ((0x60A9, 0), struct.pack("<I", 0xFDB44700), "object-differs"),
        ((0x6076, 0), struct.pack("<I", 512_871_000), "rated-torque-differs"),
        ((0x1018, 2), struct.pack("<I", 0x61500000), "node-is-another"),
    ],
)
def test_what_would_scale_wrongly_is_refused(place: tuple[int, int], value: bytes, code: str) -> None:
    async def body(link: CanopenLink, bus: Bus, first: Epos, second: Epos) -> None:
        first.objects[place] = value
        with pytest.raises(PrepareRefused, match=f"^{code}$"):
            await link.prepare()
        assert first.writes == second.writes == []

    bench(body)


def test_a_watchdog_that_does_not_stick_is_refused_and_undone() -> None:
    async def body(link: CanopenLink, bus: Bus, first: Epos, second: Epos) -> None:
        second.stubborn.add((0x1016, 1))
        with pytest.raises(PrepareRefused) as refused:
            await link.prepare()
        reads_back = {"object": "object 1016h sub 1", "set_counts": 0x7F0064, "found_counts": 0}
        assert refused.value.reasons == [finding("object-reads-back", device="drive-2", **reads_back)]
        assert first.objects == Epos(1).objects and second.objects == Epos(2).objects

    bench(body)


def test_units_of_the_device() -> None:
    async def body(link: CanopenLink, bus: Bus, first: Epos, second: Epos) -> None:
        inputs = Inputs(2)
        first.speed_um_per_s, first.torque_per_mille = 60, 500  # the fields: here 60 rpm
        await enabled(link, bus, inputs, first, second)
        await cycle(link, inputs)
        assert inputs.speed.value[0] == pytest.approx(0.2513, abs=1e-4), "60 rpm at 0.04 m"
        assert inputs.torque.value[0] == pytest.approx(0.2564, abs=1e-4)
        first.rpdos.clear()
        write(link, 0.2564355, 0.0)
        await bus.settle()
        assert first.rpdos == [struct.pack("<Hhb", 0x0F, 500, 10)]

    bench(body)


def test_a_loop_that_hangs_sends_no_heartbeat() -> None:
    async def body(link: CanopenLink, bus: Bus, first: Epos, second: Epos) -> None:
        inputs = Inputs(2)
        await enabled(link, bus, inputs, first, second)
        forget_the_last_heartbeat(link)
        for _ in range(3):
            await cycle(link, inputs)
        await bus.settle()
        assert bus.heartbeats == []

    bench(body)


def test_the_heartbeat_keeps_a_third_of_the_watchdog_time() -> None:
    producer = HeartbeatProducer(127, watchdog_s=0.1, period_s=0.01)
    sent = [0.0]
    for k in range(1, 101):
        if producer.due(k * 0.01):
            producer.sent(k * 0.01)
            sent.append(k * 0.01)
    gaps = [later - earlier for earlier, later in zip(sent[1:], sent[2:], strict=False)]
    assert 0.02 < min(gaps) and max(gaps) <= 0.1 / 3
    slow = HeartbeatProducer(127, watchdog_s=0.1, period_s=0.05)
    slow.sent(1.0)
    assert slow.due(1.05), "with every cycle where a third is less than a cycle"


def test_a_drive_that_is_deaf_to_sync_confirms_and_the_others_go_on() -> None:
    async def body(link: CanopenLink, bus: Bus, first: Epos, second: Epos) -> None:
        inputs = Inputs(2)
        await enabled(link, bus, inputs, first, second)
        first.on_sync = lambda drive: []
        for _ in range(3):
            await cycle(link, inputs, 0.02)
        assert list(inputs.drive_state) == [DriveState.ABSENT, DriveState.ENABLED]
        first.rpdos.clear()
        forget_the_last_heartbeat(link)
        write(link, 0.25)
        await bus.settle()
        assert (first.rpdos, bus.heartbeats, first.nmt[-1]) == ([], [], 0x80), "withheld until it is known to be off"
        first.statusword = SWITCH_ON_DISABLED
        async with asyncio.timeout(5.0):
            while not bus.heartbeats:
                await cycle(link, inputs, 0.02)
                write(link, 0.25)
                await bus.settle()
        assert (0x6040, 0, bytes(2)) in first.writes, "disable voltage, which needs no SYNC"
        assert inputs.drive_state[1] == DriveState.ENABLED and not first.rpdos

    bench(body)


@pytest.mark.parametrize("mute", [True, False])
def test_a_drive_that_does_not_confirm_stops_the_heartbeat_for_all(mute: bool) -> None:
    """Dead or mute; or it answers, and still has torque."""

    async def body(link: CanopenLink, bus: Bus, first: Epos, second: Epos) -> None:
        inputs = Inputs(2)
        await enabled(link, bus, inputs, first, second)
        first.on_sync = lambda drive: []
        first.sdo_answers = not mute
        for _ in range(3):
            await cycle(link, inputs, 0.02)
        asked = len(bus.frames)
        async with asyncio.timeout(5.0):
            while sum(cob_id == 0x601 for cob_id, _ in bus.frames[asked:]) < 3:  # asked, and asked again
                await cycle(link, inputs, 0.02)
                write(link, 0.25)
                await bus.settle()
        assert bus.heartbeats == [] and second.rpdos, "the others are commanded, and lose their watchdog's food"
        second.rpdos.clear()
        first.on_sync, first.sdo_answers, first.statusword = (lambda drive: [drive.tpdo()]), True, SWITCH_ON_DISABLED
        second.statusword = SWITCH_ON_DISABLED
        await link.prepare()
        await cycle(link, inputs)
        write(link, 0.0)
        await bus.settle()
        assert bus.heartbeats == [OURS] and first.rpdos, "armed again"

    bench(body)


def test_a_drive_that_was_restarted_has_to_confirm_as_well() -> None:
    async def body(link: CanopenLink, bus: Bus, first: Epos, second: Epos) -> None:
        inputs = Inputs(2)
        await enabled(link, bus, inputs, first, second)
        forget_the_last_heartbeat(link)
        bus.heartbeat(1, 0)
        await cycle(link, inputs)
        write(link, 0.25)
        await bus.settle()
        assert bus.heartbeats == [] and "restarted" in link.health.last_error

    bench(body)


@pytest.mark.parametrize("torque_nm", [nan, 17.0])
def test_a_command_that_is_refused_stops_the_heartbeat(torque_nm: float) -> None:
    """It would keep a drive alive that follows its last command."""

    async def body(link: CanopenLink, bus: Bus, first: Epos, second: Epos) -> None:
        inputs = Inputs(2)
        await enabled(link, bus, inputs, first, second)
        for _ in range(3):
            forget_the_last_heartbeat(link)
            await cycle(link, inputs)
            write(link, torque_nm, 0.25)
        await bus.settle()
        assert bus.heartbeats == [] and link.health.malformed == 3
        write(link, 0.25, 0.25)
        await bus.settle()
        assert bus.heartbeats == [OURS]

    bench(body)


def test_a_drive_that_does_not_take_its_torque_off_is_not_kept_alive() -> None:
    """It hears the heartbeat, and heeds none of its orders."""

    async def body(link: CanopenLink, bus: Bus, first: Epos, second: Epos) -> None:
        inputs, outputs = Inputs(2), Outputs(2)
        await enabled(link, bus, inputs, first, second)
        second.statusword = SWITCH_ON_DISABLED
        async with asyncio.timeout(5.0):
            while first.nmt[-1] != 0x80 or not first.rpdos:
                await cycle(link, inputs)
                link.write(outputs)
                await bus.settle()
        bus.heartbeats.clear()
        first.rpdos.clear()
        async with asyncio.timeout(5.0):
            while (0x6040, 0, bytes(2)) not in first.writes:
                forget_the_last_heartbeat(link)
                await cycle(link, inputs)
                link.write(outputs)
                await bus.settle()
        await cycle(link, inputs)
        assert bus.heartbeats == first.rpdos == [] and list(inputs.drive_state) == [DriveState.FAULT, DriveState.OFF]
        assert first.nmt.count(0x80) == second.nmt.count(0x80) + 1, "told once"
        assert (0x6040, 0, bytes(2)) not in second.writes and second.rpdos, "the other is commanded as before"

    bench(body)


def test_what_a_drive_has_confirmed_counts_until_it_shows_torque_again() -> None:
    async def body(link: CanopenLink, bus: Bus, first: Epos, second: Epos) -> None:
        inputs = Inputs(2)
        await enabled(link, bus, inputs, first, second)

        async def turn() -> None:
            bus.heartbeats.clear()
            forget_the_last_heartbeat(link)
            await cycle(link, inputs)
            write(link, 0.25)
            await bus.settle()

        bus.heartbeat(1, 0)
        first.statusword = SWITCH_ON_DISABLED
        await turn()
        assert not bus.heartbeats, "restarted"
        async with asyncio.timeout(5.0):
            while not bus.heartbeats:
                await turn()
        first.statusword = ENABLED
        for _ in range(4):
            await turn()
            assert not bus.heartbeats, "what it has confirmed before is over"
        first.statusword = SWITCH_ON_DISABLED
        async with asyncio.timeout(5.0):
            while not bus.heartbeats:
                await turn()

    bench(body)


@pytest.mark.parametrize("mute", [True, False])
def test_release_leaves_the_watchdog_to_a_drive_that_does_not_confirm(mute: bool) -> None:
    async def body(link: CanopenLink, bus: Bus, first: Epos, second: Epos) -> None:
        inputs = Inputs(2)
        await enabled(link, bus, inputs, first, second)
        first.sdo_answers = not mute
        second.statusword = SWITCH_ON_DISABLED
        await link.release()
        await bus.settle()
        assert first.objects[0x1016, 1] == bytes.fromhex("6400 7F00") and second.objects[0x1016, 1] == bytes(4)
        assert first.nmt[-1] == second.nmt[-1] == 0x80 and bus.heartbeats == []
        assert link.health.last_error.startswith("drive-1: ")
        assert link.health.last_error.endswith("its watchdog was left on and fires")

    bench(body)


# what is refused before there is a bus


def test_a_limit_that_the_drive_cannot_be_asked_for_is_refused() -> None:
    good = epos_line()
    with pytest.raises(LinksRefused) as refused:
        build_links(good.model_copy(update={"limits": good.limits.model_copy(update={"torque_nm": 1.1})}))
    assert len(refused.value.reasons) == 2 and "1.02574 Nm" in refused.value.reasons[0]


def test_the_gateways_own_number_is_no_drive() -> None:
    good = epos_line()
    drives = [good.drives[0].model_copy(update={"address": 127}), good.drives[1]]
    with pytest.raises(LinksRefused, match="drive-1: node 127 is the gateway's own number on bus drives"):
        build_links(good.model_copy(update={"drives": drives}))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('sub = 1\ntype = "u32"', 'sub = 1\ntype = "u16"', ["watchdog.type: u16; allowed: u32"]),
        ('type = "u32"\nunit = "ms"', 'type = "u32"\nunit = "s"', ["watchdog.unit", "milliseconds"]),
        ("range = [20, 1000]", "range = [20, 70000]", ["watchdog.range", "0 to 65535"]),
        ('"heartbeat-consumer"', '"heartbeat"', ["watchdog.kind: 'heartbeat'", "mean 'heartbeat-consumer'"]),
        ('"heartbeat-consumer"', '"receive-pdo"', ["watchdog.node", "listens to a node"]),
        ("node = 127 # the gateway", "node = 128", ["watchdog.node: 128", "less than or equal to 127"]),
        ("range = [-2, 2]", "range = [2, -2]", ["objects.target_torque.range", "must rise"]),
        ("abort_connection =", "abort_conection =", ["options.abort_conection", "mean 'abort_connection'"]),
    ],
)
def test_what_is_wrong_in_such_a_map_is_named(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    text = (MAPS / f"{MAP}.toml").read_text()
    assert old in text
    (tmp_path / "drive.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(MapRefused) as refused:
        load_map(tmp_path / "drive.toml")
    assert all(word in " / ".join(refused.value.reasons) for word in words), refused.value.reasons


# the drill of the watchdogs


@pytest.mark.parametrize(("statusword", "barred"), [(FAULT, True), (SWITCH_ON_DISABLED, True), (READY, False)])
def test_of_a_drive_that_leaves_operational_for_its_watchdog_the_statusword_is_asked_by_sdo(
    statusword: int, barred: bool
) -> None:
    async def body(link: CanopenLink, bus: Bus, first: Epos, second: Epos) -> None:
        inputs = Inputs(2)
        await link.prepare()
        first.statusword = second.statusword = READY
        await cycle(link, inputs)
        assert not inputs.power_barred.any()
        link.withhold(link.watched)
        begun = len(bus.frames)
        first.on_sync = lambda drive: []
        first.statusword = statusword
        second.statusword = FAULT
        bus.heartbeat(1, 0x7F)
        while statusword_questions(bus, begun) < 2 or not inputs.power_barred[1]:  # so the first one is answered
            await cycle(link, inputs, 0.01)
            write(link, 0.0)
        await cycle(link, inputs, 0.01)
        assert inputs.power_barred.tolist() == [barred, True]
        assert inputs.drive_state[0] != DriveState.READY, "it left operational, whatever its power stage is"
        sent = bus.frames[begun:]
        told = [data for cob_id, data in sent if cob_id == 0x000]
        orders = [data for cob_id, data in sent if cob_id == 0x601 and data[:3] == b"\x2b\x40\x60"]
        assert not told and not orders, "who takes torque off because it is told has shown nothing of its watchdog"
        link.withhold(frozenset())
        await cycle(link, inputs)
        assert not inputs.power_barred[0]

    bench(body)


def statusword_questions(bus: Bus, begun: int) -> int:
    return sum(cob_id == 0x601 and data[:3] == b"\x40\x41\x60" for cob_id, data in bus.frames[begun:])
