"""Drives, a load-cell amplifier and the line PLC on one bus: the link against scripted nodes, bytes by hand."""

import asyncio
import struct
from collections.abc import Awaitable, Callable
from math import inf, nan

import pytest

from drivers.canopen import questions
from drivers.canopen.link import CanopenLink
from drivers.port import PrepareRefused
from drivers.registry import LinksRefused, build_links
from gateway.core.finding import Finding, finding
from gateway.core.line import Line
from gateway.core.signals import DriveRequest, DriveState, Inputs, Outputs, Quality
from tests.protocol.driver_support import ENABLED, GROUP, READY, Drive, Drives, cycle, line, until
from tests.support.ports import free_port

AMPLIFIER, PLC = 20, 30
SPANS = 3
RUNNING = 0b0111  #: permissive, circuit healthy, transport on


class Amplifier(Drive):
    """Node 20 with four channels, of which the line uses 1, 2 and 3: two TPDOs, each with the sample counter."""

    def __init__(self) -> None:
        super().__init__(AMPLIFIER)
        self.counts = [1000, 2000, 3000, 0]
        self.status = [0, 0, 0, 0]
        self.counter = 65530
        self.moves = True  #: the sample counter
        self.sends = {0x180, 0x280}  #: which of its TPDOs it sends
        self.objects = {
            (0x1018, 1): struct.pack("<I", 0x520),
            (0x1018, 2): struct.pack("<I", 0x404),
            (0x1017, 0): struct.pack("<H", 100),
            (0x2131, 0): b"\x04",
            (0x2132, 0): b"\x01",
            **{(0x6131, c): struct.pack("<I", 0x00210000) for c in range(1, 5)},
            **{(0x6132, c): b"\x02" for c in range(1, 5)},
        }
        for m in range(4):
            first = 2 * m + 1
            mapped = [0x71300010 | first << 8, 0x61500008 | first << 8]
            mapped += [entry + 0x100 for entry in mapped] + [0x21300010]
            self.objects |= {
                (0x1800 + m, 1): struct.pack("<I", 0x40000000 | 0x180 + 0x100 * m + AMPLIFIER),
                (0x1800 + m, 2): b"\x01",
                (0x1A00 + m, 0): b"\x05",
                **{(0x1A00 + m, sub): struct.pack("<I", entry) for sub, entry in enumerate(mapped, 1)},
            }

    def sdo(self, request: bytes) -> bytes | None:
        self.measure()
        self.objects[0x2130, 0] = struct.pack("<H", self.counter)
        for c in range(1, 5):
            self.objects[0x7130, c] = struct.pack("<h", self.counts[c - 1])
            self.objects[0x6150, c] = bytes((self.status[c - 1],))
        return super().sdo(request)

    def measure(self) -> None:
        self.counter = (self.counter + self.moves) & 0xFFFF

    def frames(self) -> list[tuple[int, bytes]]:
        self.measure()
        c, s = self.counts, self.status
        first = struct.pack("<hBhBH", c[0], s[0], c[1], s[1], self.counter)
        second = struct.pack("<hBhBH", c[2], s[2], c[3], s[3], self.counter)
        return [(base + AMPLIFIER, data) for base, data in ((0x180, first), (0x280, second)) if base in self.sends]


class Plc(Drive):
    """Node 30. The command in its RPDO takes effect with the SYNC after it."""

    def __init__(self) -> None:
        super().__init__(PLC)
        self.status = 0b0011
        self.speed_um_per_s = 0
        self.echo = 0
        self.echoes = True
        self.objects = {
            (0x1018, 1): struct.pack("<I", 0x520),
            (0x1018, 2): struct.pack("<I", 0x401),
            (0x1017, 0): struct.pack("<H", 100),
            (0x1400, 1): struct.pack("<I", 0x200 + PLC),
            (0x1400, 2): b"\x01",
            (0x1600, 0): b"\x03",
            (0x1600, 1): struct.pack("<I", 0x20010110),
            (0x1600, 2): struct.pack("<I", 0x20010220),
            (0x1600, 3): struct.pack("<I", 0x20010310),
            (0x1800, 1): struct.pack("<I", 0x40000180 + PLC),
            (0x1800, 2): b"\x01",
            (0x1A00, 0): b"\x03",
            (0x1A00, 1): struct.pack("<I", 0x20000110),
            (0x1A00, 2): struct.pack("<I", 0x20000220),
            (0x1A00, 3): struct.pack("<I", 0x20000310),
            (0x2002, 0): struct.pack("<H", 0),
        }

    def sdo(self, request: bytes) -> bytes | None:
        self.objects[0x2000, 1] = struct.pack("<H", self.status)
        self.objects[0x2000, 2] = struct.pack("<i", self.speed_um_per_s)
        self.objects[0x2000, 3] = struct.pack("<H", self.echo)
        return super().sdo(request)

    def frames(self) -> list[tuple[int, bytes]]:
        if self.rpdos and self.echoes:
            self.echo = struct.unpack("<HiH", self.rpdos[-1])[2]
        return [(0x180 + PLC, struct.pack("<HiH", self.status, self.speed_um_per_s, self.echo))]


class Bus(Drives):
    """Every node answers a SYNC with the frames that it has, and a heartbeat."""

    def __init__(self, port: int) -> None:
        self.first, self.second = Drive(1), Drive(2)
        self.amplifier, self.plc = Amplifier(), Plc()
        self.deaf: set[int] = set()  #: nodes that do not react to SYNC
        nodes = [self.first, self.second, self.amplifier, self.plc]
        super().__init__(nodes, interface="udp_multicast", channel=GROUP, port=port, hop_limit=0, fd=False)

    def _on_frame(self, cob_id: int, data: bytes) -> None:
        if cob_id != 0x080:
            super()._on_frame(cob_id, data)
            return
        self.frames.append((cob_id, data))
        for drive in self.drives.values():
            if drive.node in self.deaf:
                continue
            self.heartbeat(drive.node)
            scripted = isinstance(drive, Amplifier | Plc)
            for answer in drive.frames() if scripted else [(0x180 + drive.node, drive.tpdo())]:
                self.send(*answer)

    async def settle(self) -> None:
        """Read everything that was sent before."""
        seen = len(self.frames)
        self.send(0x67F, bytes(8))
        await until(lambda: any(cob_id == 0x67F for cob_id, _ in self.frames[seen:]))


def mixed(port: int) -> Line:
    good = line(SPANS, can_bus={"interface": "udp_multicast", "channel": GROUP, "port": port})
    cells = [
        cell.model_copy(update={"bus": "drives", "map": "r2r-cell-can", "address": AMPLIFIER})
        for cell in good.load_cells
    ]
    plc = good.plc.model_copy(update={"bus": "drives", "map": "line-plc-can", "address": PLC})
    return good.model_copy(update={"drives": good.drives[:2], "load_cells": cells, "plc": plc})


Body = Callable[[CanopenLink, Bus], Awaitable[None]]


def bench(body: Body) -> None:
    async def run() -> None:
        port = free_port()
        (link,) = build_links(mixed(port))
        assert isinstance(link, CanopenLink)
        async with Bus(port) as bus:
            await link.open()
            try:
                await body(link, bus)
            finally:
                await link.close()

    asyncio.run(run())


def write(link: CanopenLink, speed_m_per_s: float = 0.0, run: bool = False, torque_nm: float = 0.0) -> None:
    outputs = Outputs(SPANS)
    outputs.drive_request[:] = DriveRequest.ENABLE
    outputs.torque_nm[:] = torque_nm
    outputs.speed_request_m_per_s, outputs.run = speed_m_per_s, run
    link.write(outputs)


async def commanded(link: CanopenLink, bus: Bus, inputs: Inputs, speed_m_per_s: float = 0.1) -> None:
    """A cycle with its commands."""
    await cycle(link, inputs)
    write(link, speed_m_per_s, run=True)
    await bus.settle()


def qualities(inputs: Inputs) -> list[int]:
    return [int(quality) for quality in inputs.tension.quality]


GOOD, STALE, BAD, MISSING = (int(q) for q in (Quality.GOOD, Quality.STALE, Quality.BAD, Quality.MISSING))


# silent


def test_a_silent_link_reads_cells_and_plc_and_writes_nothing() -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        bus.plc.speed_um_per_s = -2_000
        began_s = asyncio.get_running_loop().time()
        async with asyncio.timeout(5.0):
            while MISSING in qualities(inputs) or inputs.plc.quality == Quality.MISSING:
                await cycle(link, inputs)
                write(link, 0.1, run=True)
                await asyncio.sleep(0)
        assert list(inputs.tension.value) == pytest.approx([10.0, 20.0, 30.0])  # counts of 0.01 N
        assert min(inputs.tension.time_s) >= began_s and inputs.unwind_speed.value[0] == pytest.approx(-0.002)
        assert (inputs.plc.permissive, inputs.plc.emergency_stop, inputs.plc.running) == (True, False, False)
        sent = {cob_id for cob_id, _ in bus.frames}
        assert sent == {0x600 + AMPLIFIER, 0x600 + PLC}, "SDO only, and only to those that are read"
        assert all(data[0] == 0x40 for _, data in bus.frames), "uploads only"
        # A reading counts once, however often the cycle looks at it.
        bus.amplifier.sdo_answers = bus.plc.sdo_answers = False
        await cycle(link, inputs)
        await cycle(link, inputs)
        assert qualities(inputs) == [STALE] * SPANS and inputs.plc.quality == Quality.STALE

    bench(body)


def test_a_node_that_is_dead_at_the_start_is_named_and_the_others_are_heard() -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        bus.amplifier.sdo_answers = False
        for node in (1, 2):
            bus.heartbeat(node, 0x7F)
        async with asyncio.timeout(5.0):
            while inputs.plc.quality == Quality.MISSING:
                await cycle(link, inputs)
                await asyncio.sleep(0)
        assert link.health.absent == ["cell-1, cell-2, cell-3"]
        assert list(inputs.drive_state[:2]) == [DriveState.OFF] * 2 and set(qualities(inputs)) == {MISSING}
        with pytest.raises(PrepareRefused) as refusal:
            await link.prepare()
        assert refusal.value.reasons == [finding("node-silent", device="cell-1, cell-2, cell-3", node=20)]
        assert not any(drive.writes for drive in bus.drives.values())

    bench(body)


# prepare


def test_a_reading_that_is_under_way_ends_when_the_link_becomes_active() -> None:
    """Its answer would stand among those to SYNC, with the time of the cycle."""

    async def body(link: CanopenLink, bus: Bus) -> None:
        began, ended = asyncio.Event(), asyncio.Event()

        async def read(*_: object) -> list[Finding]:
            began.set()
            try:
                await asyncio.Event().wait()
            finally:
                ended.set()
            return []

        setattr(link._nodes[3], "read", read)  # noqa: SLF001, B010
        preparing = asyncio.create_task(link.prepare())
        await until(lambda: 0x80 in bus.amplifier.nmt)
        link.trigger(asyncio.get_running_loop().time())
        await began.wait()
        await preparing
        await ended.wait()
        inputs = Inputs(SPANS)
        await cycle(link, inputs)
        assert inputs.tension.good()

    bench(body)


def test_prepare_writes_the_watchdog_and_compares_what_is_fixed() -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        await link.prepare()
        assert bus.amplifier.writes == [(0x1017, 0, struct.pack("<H", 100))]
        assert bus.plc.writes == [(0x1017, 0, struct.pack("<H", 100)), (0x2002, 0, struct.pack("<H", 100))]
        assert all(drive.nmt == [0x80, 0x01] for drive in bus.drives.values())
        await link.release()
        await bus.settle()
        assert all(drive.nmt == [0x80, 0x01, 0x80] for drive in bus.drives.values())

    bench(body)


CELLS = "cell-1, cell-2, cell-3"


def differs(at: str, found: int, wanted: int, device: str = CELLS) -> Finding:
    return finding("object-differs", device=device, object=f"object {at}", found=found, wanted=wanted)


def another(device: str, product: int, wanted: int) -> Finding:
    vendors = {"vendor": 0x520, "wanted_vendor": 0x520}
    return finding("node-is-another", device=device, product=product, wanted_product=wanted, **vendors)


def refusal(arrange: Callable[[Bus], None]) -> list[Finding]:
    seen: list[Finding] = []

    async def body(link: CanopenLink, bus: Bus) -> None:
        arrange(bus)
        with pytest.raises(PrepareRefused) as refused:
            await link.prepare()
        bus.frames.clear()
        write(link, 0.1, run=True)
        await bus.settle()
        assert [cob_id for cob_id, _ in bus.frames] == [0x67F]
        assert bus.plc.objects[0x2002, 0] == bytes(2), "its watchdog is as it was"
        seen.extend(refused.value.reasons)

    bench(body)
    return seen


@pytest.mark.parametrize(
    ("node", "place", "value", "found"),
    [
        ("amplifier", (0x1A01, 1), struct.pack("<I", 0x71300410), differs("1A01h sub 1", 0x71300410, 0x71300310)),
        ("amplifier", (0x1800, 1), struct.pack("<I", 0xC0000194), differs("1800h sub 1", 0xC0000194, 0x194)),
        ("amplifier", (0x1800, 2), b"\xff", differs("1800h sub 2", 0xFF, 1)),
        ("amplifier", (0x2131, 0), b"\x02", finding("channel-missing", device="cell-3", channel=3, channels=2)),
        (
            "amplifier",
            (0x6131, 2),
            struct.pack("<I", 0x00470000),
            finding("cell-unit-differs", cell="cell-2", found=0x00470000, wanted=0x00210000),
        ),
        ("amplifier", (0x6132, 1), b"\x07", finding("cell-digits", cell="cell-1", digits=7, most_digits=6)),
        ("amplifier", (0x6132, 3), b"\xc8", finding("cell-digits", cell="cell-3", digits=200, most_digits=6)),
        (
            "amplifier",
            (0x6132, 2),
            b"\x03",
            finding("cell-range-short", cell="cell-2", full_scale_n=32.767, capacity_n=100.0),
        ),
        ("amplifier", (0x2132, 0), b"\x00", finding("amplifier-not-healthy", device=CELLS)),
        ("amplifier", (0x1018, 2), struct.pack("<I", 0x402), another(CELLS, 0x402, 0x404)),
        ("plc", (0x1600, 3), struct.pack("<I", 0x20010210), differs("1600h sub 3", 0x20010210, 0x20010310, "plc")),
        ("plc", (0x1A00, 0), b"\x02", differs("1A00h sub 0", 2, 3, "plc")),
        ("plc", (0x1018, 2), struct.pack("<I", 0x404), another("plc", 0x404, 0x401)),
    ],
)
def test_what_is_not_as_the_map_says_is_refused(
    node: str, place: tuple[int, int], value: bytes, found: Finding
) -> None:
    assert refusal(lambda bus: getattr(bus, node).objects.update({place: value})) == [found]


def test_the_plcs_watchdog_is_undone_when_another_node_fails() -> None:
    (reason,) = refusal(lambda bus: bus.first.aborts.update({(0x1400, 5): 0x06090030}))
    assert (reason.code, reason.parameters["device"]) == ("node-not-configured", "drive-1")
    (reason,) = refusal(lambda bus: setattr(bus.amplifier, "starts", False))
    assert reason.code == "node-not-operational"


def test_a_watchdog_that_the_plc_does_not_keep_is_refused() -> None:
    reads_back = {"object": "object 2002h sub 0", "set_counts": 100, "found_counts": 0}
    reasons = refusal(lambda bus: bus.plc.stubborn.add((0x2002, 0)))
    assert reasons == [finding("object-reads-back", device="plc", **reads_back)]


# tensions


def test_a_cycle_reads_tensions_from_all_pdos() -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        bus.amplifier.objects[0x6132, 3] = b"\x01"  # channel 3 counts tenths
        await link.prepare()
        bus.amplifier.counts = [-1, 9_999, 321, 0]
        now_s = asyncio.get_running_loop().time()
        link.trigger(now_s)
        await link.collect(inputs, now_s + 5.0)
        assert list(inputs.tension.value) == pytest.approx([-0.01, 99.99, 32.1])
        assert inputs.tension.good() and set(inputs.tension.time_s) == {now_s}
        assert link.health.malformed == link.health.timeouts == 0

    bench(body)


def test_a_tension_that_the_amplifier_doubts_is_bad() -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        await link.prepare()
        await cycle(link, inputs)
        for code, text in (
            (1, "not valid"),
            (2, "overload"),
            (4, "wire break"),
            (8, "not calibrated"),
            (9, "status 9"),
        ):
            bus.amplifier.status = [0, code, 0, 0]
            bus.amplifier.counts = [1100, 5000, 3100, 0]
            await cycle(link, inputs)
            assert qualities(inputs) == [GOOD, BAD, GOOD] and list(inputs.tension.value) == [11.0, 20.0, 31.0]
            assert link.health.last_error.startswith("cell-2: ") and text in link.health.last_error
        bus.amplifier.status = [0, 0, 0, 0]
        bus.amplifier.counts = [1100, 10_001, -10_001, 0]
        await cycle(link, inputs)
        assert qualities(inputs) == [GOOD, BAD, BAD] and "capacity of 100 N" in link.health.last_error
        bus.amplifier.counts = [1100, 0x7FFF, -0x8000, 0]
        await cycle(link, inputs)
        assert qualities(inputs) == [GOOD, BAD, BAD] and "cell-3: -32768, the end" in link.health.last_error
        bus.amplifier.counts = [1100, 2000, 3000, 0]
        bus.send(0x080 + AMPLIFIER, bytes.fromhex("01FF 81 0000000000"))
        await cycle(link, inputs)
        assert qualities(inputs) == [BAD] * SPANS and "FF01h" in link.health.last_error
        bus.send(0x080 + AMPLIFIER, bytes(8))
        await cycle(link, inputs)
        assert inputs.tension.good()

    bench(body)


def test_a_sample_counter_that_stands_still_is_no_sample() -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        await link.prepare()
        await cycle(link, inputs)
        bus.amplifier.moves = False
        bus.amplifier.counts = [5000, 5000, 5000, 0]
        await cycle(link, inputs)
        assert qualities(inputs) == [STALE] * SPANS and inputs.tension.value[0] == 10.0
        assert "sample counter stands still" in link.health.last_error
        bus.amplifier.moves = True
        await cycle(link, inputs)
        assert inputs.tension.good() and inputs.tension.value[0] == 50.0

    bench(body)


def test_duplicates_and_wrong_lengths_are_no_tensions() -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        await link.prepare()
        answer = bus.amplifier.frames
        bus.amplifier.frames = lambda: [*answer()[:1], *answer()]  # the first twice, with another counter
        await cycle(link, inputs)
        assert inputs.tension.good() and link.health.malformed == 1
        bus.amplifier.frames = lambda: [(cob_id, data[:7]) for cob_id, data in answer()]
        await cycle(link, inputs, 0.02)
        await bus.settle()
        await until(lambda: link.health.malformed == 3)
        assert qualities(inputs) == [STALE] * SPANS and "the mapped PDO has 8" in link.health.last_error

    bench(body)


def test_half_an_answer_is_half_an_answer() -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        await link.prepare()
        await cycle(link, inputs)
        bus.amplifier.sends = {0x180}
        for _ in range(3):
            await cycle(link, inputs, 0.02)
            assert qualities(inputs) == [GOOD, GOOD, STALE]
        assert link.health.absent == ["cell-1, cell-2, cell-3"]

    bench(body)


def test_a_lost_amplifier_costs_the_others_no_time_and_comes_back() -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        await link.prepare()
        await cycle(link, inputs)
        bus.deaf.add(AMPLIFIER)
        for _ in range(3):
            await cycle(link, inputs, 0.02)
        assert link.health.absent == ["cell-1, cell-2, cell-3"] and link.health.timeouts == 3
        assert "no answer to 3 SYNCs" in link.health.last_error
        async with asyncio.timeout(5.0):
            await cycle(link, inputs, 60.0)
        assert qualities(inputs) == [STALE] * SPANS and list(inputs.tension.value) == [10.0, 20.0, 30.0]
        assert inputs.speed.quality[0] == inputs.plc.quality == Quality.GOOD
        write(link)
        await bus.settle()
        assert bus.amplifier.nmt == [0x80, 0x01], "it moves nothing: there is nothing to stop"
        bus.deaf.clear()
        async with asyncio.timeout(5.0):
            while not inputs.tension.good():
                await cycle(link, inputs, 0.02)
        assert link.health.absent == []

    bench(body)


def test_an_amplifier_without_heartbeats_is_not_believed() -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        await link.prepare()
        await cycle(link, inputs)
        station = link._nodes[3].station  # noqa: SLF001
        assert station.name.startswith("cell-1") and station.heard_s is not None
        station.heard_s -= 10.0
        bus.heartbeat = lambda node, state=5: None
        await cycle(link, inputs)
        assert qualities(inputs) == [STALE] * SPANS and link.health.absent == [station.name]

    bench(body)


# the PLC


def test_the_plc_is_commanded_with_a_life_that_moves() -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        await link.prepare()
        bus.plc.status, bus.plc.speed_um_per_s = RUNNING, 123_456
        for _ in range(5):
            await commanded(link, bus, inputs, -0.25)
        assert [rpdo[:6] for rpdo in bus.plc.rpdos] == [bytes.fromhex("0100 702F FCFF")] * 5  # -250 000 um/s
        assert [struct.unpack("<H", rpdo[6:])[0] for rpdo in bus.plc.rpdos] == [1, 2, 3, 4, 5]
        assert inputs.plc.quality == Quality.GOOD and inputs.unwind_speed.value[0] == pytest.approx(0.123456)
        assert inputs.plc.permissive and inputs.plc.running and not inputs.plc.emergency_stop
        write(link, 0.0, run=False)
        await bus.settle()
        assert bus.plc.rpdos[-1] == bytes.fromhex("0000 0000 0000 0600")
        bus.plc.status = 0b1000
        await cycle(link, inputs)
        assert inputs.plc.emergency_stop and not inputs.plc.permissive
        assert "watchdog has tripped" in link.health.last_error

    bench(body)


def test_an_echo_that_stands_still_makes_the_plc_stale() -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        await link.prepare()
        for _ in range(3):
            await commanded(link, bus, inputs)
        bus.plc.echoes = False
        seen: list[int] = []
        for _ in range(5):
            await commanded(link, bus, inputs)
            seen.append(int(inputs.plc.quality))
        assert seen == [GOOD, GOOD, STALE, STALE, STALE], "3 T; the first shows the echo of before"
        assert "echo of the life counter stands still" in link.health.last_error

    bench(body)


@pytest.mark.parametrize("speed_m_per_s", [nan, inf, -inf, 50.1, 1e12])
def test_a_command_that_the_plc_cannot_take_is_not_sent(speed_m_per_s: float) -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        await link.prepare()
        await commanded(link, bus, inputs)
        lives = len(bus.plc.rpdos)
        await commanded(link, bus, inputs, speed_m_per_s)
        assert len(bus.plc.rpdos) == lives, "its watchdog has the last word"
        assert link.health.malformed == 1 and "plc" in link.health.last_error
        assert len(bus.first.rpdos) == 2, "the drives are commanded all the same"
        await cycle(link, inputs)
        assert inputs.plc.quality == Quality.STALE and inputs.unwind_speed.good()
        assert "refused" in link.health.last_error

    bench(body)


def test_a_plc_that_is_lost_is_told_to_stop_and_its_life_is_withheld() -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        await link.prepare()
        bus.first.statusword = bus.second.statusword = ENABLED
        await commanded(link, bus, inputs)
        bus.deaf.add(PLC)
        for _ in range(3):
            await cycle(link, inputs, 0.02)
            assert inputs.plc.quality == Quality.STALE and not inputs.unwind_speed.good()
        bus.plc.rpdos.clear()
        for _ in range(3):
            write(link, 0.1, run=True, torque_nm=8.0)
            await bus.settle()
        assert link.health.absent == ["plc"] and bus.plc.rpdos == []
        assert bus.plc.nmt == [0x80, 0x01, 0x80], "leaving operational counts as run = 0"
        assert list(inputs.drive_state[:2]) == [DriveState.ENABLED] * 2
        assert bus.first.rpdos[-1] == struct.pack("<Hhb", 0x0F, 100, 10)
        bus.deaf.clear()
        async with asyncio.timeout(5.0):
            while link.health.absent:
                await cycle(link, inputs, 0.02)
        assert inputs.plc.quality == Quality.STALE and "arm again" in link.health.last_error

    bench(
        body,
    )


def test_a_plc_that_was_restarted_is_not_commanded() -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        await link.prepare()
        await commanded(link, bus, inputs)
        bus.heartbeat(PLC, 0)
        bus.heartbeat(PLC, 5)
        bus.plc.rpdos.clear()
        await commanded(link, bus, inputs)
        assert bus.plc.rpdos == [] and inputs.plc.quality == Quality.STALE
        assert "plc: restarted" in link.health.last_error
        await link.prepare()
        await commanded(link, bus, inputs)
        assert inputs.plc.quality == Quality.GOOD and bus.plc.rpdos

    bench(body)


def test_a_plc_whose_watchdog_was_altered_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(questions, "VERIFY_S", 0.0)

    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        await link.prepare()
        await commanded(link, bus, inputs)
        bus.plc.objects[0x2002, 0] = bytes(2)
        async with asyncio.timeout(5.0):
            while bus.plc.nmt[-1] != 0x80:
                await commanded(link, bus, inputs)
        assert link.health.last_error.startswith("plc: its watchdog, object 2002h sub 0, was set to 0x64 and is 0x0;")
        bus.plc.rpdos.clear()
        await commanded(link, bus, inputs)
        assert bus.plc.rpdos == [] and inputs.plc.quality == Quality.STALE and bus.first.nmt[-1] == 0x01

    bench(body)


def test_a_late_or_malformed_status_is_not_used() -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        await link.prepare()
        await commanded(link, bus, inputs)
        bus.plc.frames = lambda: [(0x180 + PLC, bytes(7))]
        await cycle(link, inputs, 0.02)
        assert inputs.plc.quality == Quality.STALE and "the mapped PDO has 8" in link.health.last_error
        bus.plc.frames = lambda: []
        await cycle(link, inputs, 0.02)
        bus.send(0x180 + PLC, struct.pack("<HiH", RUNNING, 9_000_000, 9))
        await bus.settle()
        await until(lambda: "after its cycle" in link.health.last_error)
        await cycle(link, inputs, 0.02)
        assert inputs.plc.quality == Quality.STALE and inputs.unwind_speed.value[0] == 0.0

    bench(body)


# own frames


def test_own_commands_echoed_by_the_bus_are_no_answers() -> None:
    """udp_multicast hands a sender its own frames: they must neither fill inputs nor change what is sent next."""

    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs = Inputs(SPANS)
        await link.prepare()
        bus.first.statusword = bus.second.statusword = ENABLED
        await cycle(link, inputs)
        bus.first.rpdos.clear()
        for torque_nm, per_mille in ((8.0, 100), (16.0, 200), (-8.0, -100)):
            write(link, 0.1, run=True, torque_nm=torque_nm)
            await bus.settle()
            link._bus.drain_all()  # noqa: SLF001
            await cycle(link, inputs)
            assert inputs.torque.value[0] == 0.0 and inputs.unwind_speed.value[0] == 0.0
            assert bus.first.rpdos[-1] == struct.pack("<Hhb", 0x0F, per_mille, 10)
        assert len(bus.first.rpdos) == 3 and link.health.malformed == 0

    bench(body)


def test_a_fault_is_reset_without_enabling() -> None:
    async def body(link: CanopenLink, bus: Bus) -> None:
        inputs, outputs = Inputs(SPANS), Outputs(SPANS)
        await link.prepare()
        outputs.drive_request[:] = DriveRequest.RESET_FAULT
        outputs.torque_nm[:] = 8.0
        words: list[int] = []
        for statusword in (0x0218, 0x0218, 0x0250, READY, ENABLED):
            bus.first.statusword = statusword
            await cycle(link, inputs)
            link.write(outputs)
            await bus.settle()
            word, torque, _ = struct.unpack("<Hhb", bus.first.rpdos[-1])
            words.append(word)
            assert torque == 0
        assert words == [0x80, 0, 0, 0, 0], "the edge, and nothing that leads further"

    bench(body)


def test_a_channel_that_the_map_does_not_know_is_refused() -> None:
    good = mixed(5000)
    cells = [*good.load_cells[:2], good.load_cells[2].model_copy(update={"channel": 9})]
    with pytest.raises(LinksRefused) as refused:
        build_links(good.model_copy(update={"load_cells": cells}))
    assert refused.value.reasons == ["cell-3: channel 9; allowed: 1 to 8"]


def test_two_devices_at_one_node_are_refused() -> None:
    good = mixed(5000)
    plc = good.plc.model_copy(update={"address": AMPLIFIER})
    with pytest.raises(LinksRefused) as refused:
        build_links(good.model_copy(update={"plc": plc}))
    assert len(refused.value.reasons) == 1 and "COB-ID 194h is already plc's" in refused.value.reasons[0]
