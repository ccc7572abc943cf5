"""The Modbus link against a raw TCP server that follows the map, or breaks it in every way a device can."""

import asyncio
import struct
from collections.abc import Awaitable, Callable
from math import inf, nan

import pytest

from drivers.modbus.link import ModbusLink
from drivers.port import PrepareRefused
from gateway.core.finding import Finding, finding
from gateway.core.signals import Inputs, Quality
from tests.protocol.driver_support import Registers, cycle, frame, line, until
from tests.protocol.modbus_support import bench, command, modbus_links, until_good


def test_a_cycle_reads_si_in_one_request_a_device() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        peer.tension(1, 12.5)
        peer.tension(2, -0.25)
        peer.plc[2:4] = [0xFFFF, 0x8AD0]  # -30 000 um/s, high word first
        now_s = asyncio.get_running_loop().time()
        link.trigger(now_s)
        await link.collect(inputs, now_s + 0.5)
        assert list(inputs.tension.value) == [12.5, -0.25] and inputs.tension.good()
        assert inputs.tension.time_s[0] == now_s
        assert inputs.unwind_speed.value[0] == pytest.approx(-0.03) and inputs.unwind_speed.good()
        plc = inputs.plc
        assert (plc.quality, plc.permissive, plc.emergency_stop, plc.running) == (Quality.GOOD, True, False, False)
        # Registers 2 (status) to 22 (status of channel 2) by function 4; 1 to 4, and the watchdog in 14, by function 3.
        assert peer.requests == [(1, struct.pack(">BHH", 4, 2, 21)), (2, struct.pack(">BHH", 3, 1, 14))]
        peer.plc[1] = 0b0100
        await cycle(link, inputs)
        assert (plc.permissive, plc.emergency_stop, plc.running) == (False, True, True)

    bench(body)


def test_sixty_channels_take_as_few_requests_as_fit() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(60)
        for channel in range(1, 61):
            peer.tension(channel, channel / 4)
        await cycle(link, inputs)
        assert list(inputs.tension.value) == [channel / 4 for channel in range(1, 61)]
        assert [struct.unpack(">BHH", pdu)[2] <= 125 for unit, pdu in peer.requests if unit == 1] == [True] * 3

    bench(body, 60, 60)


def test_the_command_is_written_with_a_life_counter_only_when_active() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        link.write(command(True, 0.1))
        await cycle(link, inputs)
        assert {pdu[0] for _, pdu in peer.requests} == {3, 4}, "a silent link reads only"
        assert peer.plc[10:15] == [0, 0, 0, 0, 0]
        await link.prepare()
        assert peer.plc[14] == 100, "limits.watchdog_s in ms"
        peer.requests.clear()
        await cycle(link, inputs)
        assert {pdu[0] for _, pdu in peer.requests} == {3, 4}, "nothing is commanded yet"
        peer.requests.clear()
        lives: list[int] = []
        for _ in range(3):
            link.write(command(True, -0.1))
            await cycle(link, inputs)
            lives.append(peer.plc[13])
        assert lives == [1, 2, 3]
        assert peer.plc[10:13] == [1, 0xFFFE, 0x7960]  # run, -100 000 um/s
        written = [pdu for unit, pdu in peer.requests if unit == 2]
        assert written[0] == struct.pack(">BHHHHBHHHH", 23, 1, 14, 10, 4, 8, 1, 0xFFFE, 0x7960, 1)
        link.write(command(True, 0.1))
        link.silence()
        peer.requests.clear()
        link.write(command(True, 0.1))
        await cycle(link, inputs)
        assert {pdu[0] for _, pdu in peer.requests} == {3, 4}
        await link.prepare()
        peer.requests.clear()
        await cycle(link, inputs)
        assert {pdu[0] for _, pdu in peer.requests} == {3, 4}, "nothing of an old command is left"

    bench(body)


def test_a_command_is_sent_with_the_next_cycle_or_never() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        await link.prepare()
        link.write(command(True, 0.1))
        await cycle(link, inputs)
        peer.requests.clear()
        await cycle(link, inputs)
        assert 23 not in {pdu[0] for _, pdu in peer.requests}, "a loop that hangs does not go on commanding"

        async def mute(head: bytes, unit: int, pdu: bytes) -> list[bytes] | None:
            return []

        peer.script = mute
        link.write(command(True, 0.2))
        await cycle(link, inputs, 0.0)
        link.write(command(True, 0.3))
        now_s = asyncio.get_running_loop().time()
        link.trigger(now_s)  # the one before is still running
        await link.collect(inputs, now_s)
        peer.script = None
        await until_good(link, inputs)
        written = [struct.unpack(">i", pdu[12:16])[0] for _, pdu in peer.requests if pdu[0] == 23]
        assert written == [200_000], "what could not be sent in its cycle is old"

    bench(body)


@pytest.mark.parametrize("speed_m_per_s", [nan, inf, -inf, 51.0, -51.0, 1e30])
def test_a_speed_that_cannot_be_commanded_is_not_written(speed_m_per_s: float) -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        await link.prepare()
        link.write(command(True, 0.1))
        await cycle(link, inputs)
        before = list(peer.plc)
        link.write(command(True, speed_m_per_s))
        await cycle(link, inputs)
        assert peer.plc == before, "not even the life counter: the PLC's watchdog has the last word"
        assert link.health.malformed == 1 and "plc" in link.health.last_error
        assert inputs.unwind_speed.quality[0] == Quality.GOOD, "it is read all the same"
        assert inputs.plc.quality == Quality.STALE, "but a PLC that cannot be told to stop does not count as there"

    bench(body)


# answers that must not be believed


async def _other_function(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
    return [frame(head, unit, bytes((6 if pdu[0] == 3 else 3, 42)) + bytes(42))]


async def _too_short(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
    return [frame(head, unit, bytes((pdu[0], 4)) + bytes(4))]


async def _too_long(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
    return [frame(head, unit, bytes((pdu[0], 100)) + bytes(100))]


async def _none_at_all(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
    return [frame(head, unit, bytes((pdu[0], 0)))]


async def _exception(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
    return [frame(head, unit, bytes((pdu[0] | 0x80, 4)))]


async def _garbage(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
    return [b"HTTP/1.1 400 Bad Request\r\n\r\n"]


async def _half(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
    return [frame(head, unit, bytes((pdu[0], 42)) + bytes(42))[:20]]


async def _other_unit(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
    return [frame(head, unit + 7, bytes((pdu[0], 42)) + bytes(42))]


async def _other_transaction(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
    return [frame(b"\x77\x77", unit, bytes((pdu[0], 42)) + bytes(42))]


async def _nothing(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
    return []


@pytest.mark.parametrize(
    "script",
    [
        _other_function,
        _too_short,
        _too_long,
        _none_at_all,
        _exception,
        _garbage,
        _half,
        _other_unit,
        _other_transaction,
        _nothing,
    ],
)
def test_an_answer_that_does_not_fit_is_a_lost_sample(script: Callable[..., Awaitable[list[bytes]]]) -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        peer.tension(1, 12.5)
        await cycle(link, inputs)
        peer.tension(1, 99.0)
        peer.script = script
        await cycle(link, inputs)
        assert list(inputs.tension.quality) == [Quality.STALE] * 2
        assert inputs.tension.value[0] == 12.5, "the last good value stays"
        assert inputs.plc.quality == Quality.STALE and inputs.unwind_speed.quality[0] == Quality.STALE
        assert link.health.timeouts == 2 and link.health.last_error
        await cycle(link, inputs, 0.05)
        await cycle(link, inputs, 0.05)
        assert sorted(link.health.absent) == ["cell-1, cell-2", "plc"]
        # The device recovers: so does the link, on a new connection where the old one could not be trusted.
        peer.script = None
        await until_good(link, inputs)
        assert inputs.tension.value[0] == 99.0

    bench(body)


def test_after_half_an_answer_the_connection_is_made_anew() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        await cycle(link, inputs)
        held: list[bytes] = []

        async def halves(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
            answer = frame(head, unit, peer.answer(unit, pdu))
            if unit == 2 or peer.connections > 2:
                return [answer]
            before, held[:] = b"".join(held), [answer[20:]]
            return [before + answer[:20]]

        peer.script = halves
        peer.tension(1, 3.0)
        await cycle(link, inputs)
        assert list(inputs.tension.quality) == [Quality.STALE] * 2
        await until_good(link, inputs)
        assert inputs.tension.value[0] == 3.0
        assert peer.connections == 3, "at once, not after some more lost samples; the PLC keeps its own"

    bench(body)


def test_a_late_answer_never_passes_for_a_fresh_one() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        release = asyncio.Event()
        asked: list[int] = []

        async def late(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
            answer = frame(head, unit, peer.answer(unit, pdu))
            asked.append(unit)
            await release.wait()
            return [answer]

        peer.tension(1, 1.0)
        await cycle(link, inputs)
        peer.script = late
        peer.tension(1, 2.0)
        loop = asyncio.get_running_loop()
        now_s = loop.time()
        link.trigger(now_s + 10.0)  # the exchange may last; the cycle does not wait for it
        await until(lambda: len(asked) == 2)
        await link.collect(inputs, loop.time())
        assert list(inputs.tension.quality) == [Quality.STALE] * 2
        count = len(peer.requests)
        link.trigger(now_s + 10.01)  # still running: not doubled
        peer.script = None
        release.set()
        await link.collect(inputs, loop.time() + 0.05)
        assert list(inputs.tension.quality) == [Quality.STALE] * 2 and inputs.tension.value[0] == 1.0
        await until(lambda: link.health.malformed == 2)  # both devices answered after their cycle
        assert len(peer.requests) == count, "none is doubled"
        assert link.health.timeouts == 4
        await until_good(link, inputs)
        assert inputs.tension.value[0] == 2.0

    bench(body)


def test_what_a_load_cell_says_is_checked() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        peer.tension(2, 7.0)
        unusable = [(value, 0) for value in (nan, inf, -inf, 100.001, -100.001)]
        for value, status in [*unusable, (50.0, 1), (50.0, 2), (50.0, 3), (50.0, 9)]:
            peer.tension(1, 1.0)
            await cycle(link, inputs)
            assert inputs.tension.good()
            peer.tension(1, value, status)
            await cycle(link, inputs)
            assert list(inputs.tension.quality) == [Quality.BAD, Quality.GOOD], (value, status)
            assert inputs.tension.value[0] == 1.0
            assert "cell-1" in link.health.last_error
        for value in (100.0, -100.0, -0.5, 0.0):
            peer.tension(1, value)
            await cycle(link, inputs)
            assert inputs.tension.good() and inputs.tension.value[0] == value
        peer.amplifier[2] = 0
        await cycle(link, inputs)
        assert list(inputs.tension.quality) == [Quality.BAD] * 2 and "not healthy" in link.health.last_error

    bench(body)


def test_a_sample_counter_that_stands_still_makes_stale() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        peer.amplifier[3] = 0xFFFE
        for _ in range(4):  # also over the wrap
            await cycle(link, inputs)
            assert inputs.tension.good()
        peer.counts = False
        await cycle(link, inputs)
        assert list(inputs.tension.quality) == [Quality.STALE] * 2
        assert "sample counter" in link.health.last_error

    bench(body)


def test_a_plc_that_no_longer_echoes_is_stale() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        await link.prepare()
        for _ in range(5):
            link.write(command(True, 0.1))
            await cycle(link, inputs)
            assert inputs.plc.quality == Quality.GOOD
        peer.echoes = False
        qualities: list[int] = []
        for _ in range(3):
            link.write(command(True, 0.1))
            await cycle(link, inputs)
            qualities.append(inputs.plc.quality)
        assert qualities == [Quality.GOOD, Quality.GOOD, Quality.STALE]

    bench(body)


def test_a_tripped_plc_watchdog_and_an_impossible_speed_are_named() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        peer.plc[1] |= 0b1000
        await cycle(link, inputs)
        assert "watchdog has tripped" in link.health.last_error
        peer.plc[2:4] = [0x7FFF, 0xFFFF]  # 2147 m/s
        await cycle(link, inputs)
        assert inputs.unwind_speed.quality[0] == Quality.BAD

    bench(body)


def test_a_dead_unit_costs_the_other_nothing() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        await cycle(link, inputs)

        async def amplifier_is_dead(head: bytes, unit: int, pdu: bytes) -> list[bytes] | None:
            return [] if unit == 1 else None

        peer.script = amplifier_is_dead
        before = link.health.timeouts
        for _ in range(3):
            await cycle(link, inputs)
            assert inputs.plc.quality == Quality.GOOD, "from the first cycle on"
            assert list(inputs.tension.quality) == [Quality.STALE] * 2
        assert link.health.absent == ["cell-1, cell-2"] and link.health.timeouts == before + 3
        async with asyncio.timeout(5.0):
            for _ in range(10):
                await cycle(link, inputs, 60.0)  # an absent unit is asked, and not waited for
                assert inputs.plc.quality == Quality.GOOD

    bench(body)


# connections


def test_reconnects_by_itself_and_costs_no_time() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        await link.prepare()
        await cycle(link, inputs)
        await peer.stop()
        loop = asyncio.get_running_loop()
        for _ in range(5):
            begin_s = loop.time()
            link.trigger(begin_s)
            await link.collect(inputs, begin_s + 60.0)
            assert loop.time() - begin_s < 1.0, "nothing is waited for on a lost connection"
        assert inputs.plc.quality == Quality.STALE and len(link.health.absent) == 2
        await peer.start()
        await until_good(link, inputs)
        assert link.health.reconnects == 2 and link.health.absent == [], "one a unit"

    bench(body)


def test_a_peer_that_stops_and_goes_on_does_not_find_a_heap_of_requests() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        await link.prepare()
        link.write(command(True, 0.1))
        await cycle(link, inputs)
        goes_on = asyncio.Event()

        async def stopped(head: bytes, unit: int, pdu: bytes) -> list[bytes] | None:
            await goes_on.wait()
            return None

        peer.script = stopped
        peer.requests.clear()
        before, loop = peer.connections, asyncio.get_running_loop()
        end_s = loop.time() + 2.0  # twenty periods
        while loop.time() < end_s:
            link.write(command(True, 0.1))
            await cycle(link, inputs, 0.1)
            await asyncio.sleep(0.01)
        assert len(link.health.absent) == 2
        waiting = peer.connections - before  # each got one request, and waited alone for its answer
        assert 2 <= waiting <= 12, "six a unit"
        await until(lambda: len(peer.requests) >= 2 + waiting)
        goes_on.set()
        await settle(peer)
        written = [pdu for _, pdu in peer.requests if pdu[0] == 23]
        assert len(written) <= 3, "0.3 s of requests, then one a connection, which proves before it writes"
        assert len(peer.requests) <= 6 + 2 * waiting
        await until_good(link, inputs)

    bench(body)


async def settle(peer: Registers) -> None:
    """Let the peer take everything that was sent before, on every connection it has."""
    seen = -1
    while seen != len(peer.requests):
        seen = len(peer.requests)
        await asyncio.sleep(0.02)


def test_an_amplifier_is_proven_again_after_a_reconnection() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        await link.prepare()
        await cycle(link, inputs)
        assert inputs.tension.good()
        for registers in ([0x7777, 2], [0x5201, 1]):
            await peer.stop()
            await cycle(link, inputs, 0.02)
            peer.amplifier[:2] = registers
            await peer.start()
            async with asyncio.timeout(5.0):
                while inputs.unwind_speed.quality[0] != Quality.GOOD or not peer.requests:
                    await cycle(link, inputs, 0.1)
                    await asyncio.sleep(0)
            assert list(inputs.tension.quality) == [Quality.BAD] * 2
        await cycle(link, inputs)
        assert "not proven: cell-2: channel 2, the device has 1" in link.health.last_error
        peer.amplifier[:2] = [0x5201, 2]
        await cycle(link, inputs)
        assert inputs.tension.good()

    bench(body)


def test_a_slow_device_is_proven_over_several_cycles() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        await peer.stop()
        await cycle(link, inputs, 0.02)
        seen: list[int] = []

        async def slow(head: bytes, unit: int, pdu: bytes) -> list[bytes] | None:
            # Of its requests in a cycle only the first is answered; the second is what the cycle has no time for.
            seen.append(unit)
            return [] if unit == 1 and seen.count(1) % 2 == 0 else None

        peer.script = slow
        await peer.start()
        await until_good(link, inputs)

    bench(body)


def test_a_plc_that_lost_its_watchdog_is_not_written_to_again() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        await link.prepare()
        link.write(command(True, 0.1))
        await cycle(link, inputs)
        for watchdog_ms, written in ((100, True), (0, False)):
            await peer.stop()
            await cycle(link, inputs, 0.02)
            peer.plc[14] = watchdog_ms  # 0: it was restarted, its settings are the defaults
            await peer.start()
            await until_good(link, inputs)
            # Device and watchdog are read, alone, before anything is written.
            await until(lambda: (2, struct.pack(">BHH", 3, 14, 1)) in peer.requests)
            await cycle(link, inputs)
            peer.requests.clear()
            link.write(command(True, 0.1))
            await cycle(link, inputs)
            runs = {pdu[11] for unit, pdu in peer.requests if unit == 2 and pdu[0] == 23}
            assert runs == {int(written)}, "without its watchdog it is told to take transport off"
            peer.requests.clear()
        for _ in range(5):
            peer.requests.clear()
            link.write(command(True, 0.1))
            await cycle(link, inputs)
        assert {pdu[0] for unit, pdu in peer.requests if unit == 2} == {3}, "and left alone then"
        assert "watchdog" in link.health.last_error
        assert inputs.plc.quality == Quality.STALE and inputs.unwind_speed.good()
        await link.prepare()
        link.write(command(True, 0.1))
        await cycle(link, inputs)
        assert peer.plc[14] == 100 and peer.requests[-1][1][0] == 23
        assert inputs.plc.quality == Quality.GOOD

    bench(body)


def test_open_says_what_to_do_and_the_link_goes_on_trying() -> None:
    async def run() -> None:
        async with Registers() as peer:
            await peer.stop()
            (link,) = modbus_links(line(modbus_port=peer.port))
            with pytest.raises(OSError, match="check host and port"):
                await link.open()
            with pytest.raises(PrepareRefused, match="device-not-connected"):
                await link.prepare()
            await peer.start()
            inputs = Inputs(2)
            await until_good(link, inputs)
            await link.close()
            await link.close()

    asyncio.run(run())


def test_two_addresses_are_two_links() -> None:
    async def run() -> None:
        async with Registers() as amplifier, Registers() as plc:
            links = modbus_links(line(modbus_port=amplifier.port, plc_port=plc.port))
            inputs = Inputs(2)
            for link in links:
                await link.open()
                await cycle(link, inputs)
                await link.close()
            assert [link.name for link in links] == ["io", "plc-io"]
            assert {unit for unit, _ in amplifier.requests} == {1} and {unit for unit, _ in plc.requests} == {2}
            assert inputs.tension.good() and inputs.plc.quality == Quality.GOOD

    asyncio.run(run())


# what prepare refuses


def refusal(arrange: Callable[[Registers], None], channels: int = 2) -> tuple[list[Finding], Registers]:
    seen: list[tuple[list[Finding], Registers]] = []

    async def body(link: ModbusLink, peer: Registers) -> None:
        arrange(peer)
        with pytest.raises(PrepareRefused) as refused:
            await link.prepare()
        peer.script = None
        peer.requests.clear()
        link.write(command(True, 0.1))
        await cycle(link, Inputs(2))
        assert 23 not in {pdu[0] for _, pdu in peer.requests}, "a refused link stays silent"
        seen.append((refused.value.reasons, peer))

    bench(body, channels=channels)
    return seen[0]


def test_every_wrong_device_is_named() -> None:
    def arrange(peer: Registers) -> None:
        peer.amplifier[0], peer.plc[0] = 0x1111, 0x2222

    reasons, peer = refusal(arrange)
    assert peer.plc[14] == 0
    assert reasons == [
        finding("device-id-differs", device="cell-1, cell-2", found=0x1111, wanted=0x5201),
        finding("device-id-differs", device="plc", found=0x2222, wanted=0x5202),
    ]


def test_a_missing_channel_is_named() -> None:
    reasons, _ = refusal(lambda peer: None, channels=1)
    assert reasons == [finding("channel-missing", device="cell-2", channel=2, channels=1)]


def test_a_watchdog_that_does_not_stick_is_refused_and_undone() -> None:
    def arrange(peer: Registers) -> None:
        peer.plc[14] = 500

        async def stubborn(head: bytes, unit: int, pdu: bytes) -> list[bytes] | None:
            if pdu[0] == 16:
                peer.plc[14] = 77 if pdu[-2:] == b"\x00\x64" else struct.unpack(">H", pdu[-2:])[0]
                return [frame(head, unit, pdu[:5])]
            return None

        peer.script = stubborn

    reasons, peer = refusal(arrange)
    assert reasons == [finding("setting-reads-back", device="plc", setting="watchdog", set_counts=100, found_counts=77)]
    assert peer.plc[14] == 500


def test_a_plc_that_refuses_the_watchdog_is_refused() -> None:
    def arrange(peer: Registers) -> None:
        async def refuses(head: bytes, unit: int, pdu: bytes) -> list[bytes] | None:
            return [frame(head, unit, b"\x90\x03")] if pdu[0] == 16 else None

        peer.script = refuses

    reasons, _ = refusal(arrange)
    error = "exception 3 to function 16"
    assert reasons == [finding("setting-not-set", device="plc", setting="watchdog", error=error)]
