"""A whole line in one Modbus unit: one transaction a cycle, written whole or not at all, and every way it can lie."""

import asyncio
import struct
from collections.abc import Awaitable, Callable
from math import inf, nan

import pytest

from drivers.modbus.link import ModbusLink
from drivers.port import PrepareRefused
from gateway.core.finding import finding
from gateway.core.line import Line
from gateway.core.signals import DriveRequest, DriveState, Inputs, Outputs, Quality
from tests.protocol.driver_support import FAULT, SWITCH_ON_DISABLED, Registers, cycle, frame, until
from tests.protocol.modbus_support import Rack, modbus_links, rack_line, torques

ENABLE = DriveRequest.ENABLE
Body = Callable[[ModbusLink, Rack, Registers], Awaitable[None]]


def rack_bench(body: Body, n: int = 3, change: Callable[[Line], Line] = lambda line: line) -> None:
    async def run() -> None:
        async with Registers() as peer:
            rack = Rack(n)
            peer.script = rack.script
            (link,) = modbus_links(change(rack_line(n, peer.port)))
            await link.open()
            try:
                await body(link, rack, peer)
            finally:
                await link.close()

    asyncio.run(run())


def outputs(n: int, torque_nm: float = 8.0, request: int = ENABLE) -> Outputs:
    wanted = torques(DriveRequest(request), *[torque_nm] * n)
    wanted.run, wanted.speed_request_m_per_s = True, 0.1
    return wanted


async def enabled(link: ModbusLink, inputs: Inputs) -> None:
    await link.prepare()
    inputs.drive_state[:] = DriveState.OFF
    async with asyncio.timeout(5.0):
        while not (inputs.drive_state == DriveState.ENABLED).all():
            link.write(outputs(inputs.n))
            await cycle(link, inputs)


def test_one_request_makes_a_cycle() -> None:
    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        inputs = Inputs(3)
        for channel in (1, 2, 3):
            rack.number(9 + 8 * (channel - 1), ">i", 10_000 * channel)
            rack.number(11 + 8 * (channel - 1), ">h", -100 * channel)
            rack.number(13 + 8 * (channel - 1), ">f", 1.5 * channel)
        rack.number(3, ">i", 30_000)
        await link.prepare()
        assert rack.registers[300:302] == [100, 100]
        assert rack.writes == [(300, 300), (301, 301)] or rack.writes == [(301, 301), (300, 300)], "each set once"
        peer.requests.clear()
        link.write(outputs(3))
        await cycle(link, inputs)
        assert [pdu[:9] for _, pdu in peer.requests] == [struct.pack(">BHHHH", 23, 2, 30, 200, 10)]
        assert list(inputs.speed.value) == pytest.approx([0.01, 0.02, 0.03])
        assert list(inputs.torque.value) == pytest.approx([-8.0, -16.0, -24.0])
        assert list(inputs.tension.value) == [1.5, 3.0, 4.5] and inputs.tension.good()
        assert inputs.unwind_speed.value[0] == pytest.approx(0.03) and inputs.plc.permissive
        assert inputs.plc.quality == Quality.GOOD and list(inputs.drive_state) == [DriveState.OFF] * 3
        assert rack.registers[200:204] == [1, 0x0001, 0x86A0, rack.registers[5]], "run, 100 000 um/s, life"

    rack_bench(body)


def test_every_axis_gets_its_own_command() -> None:
    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        inputs = Inputs(14)
        await enabled(link, inputs)
        wanted = outputs(14)
        wanted.torque_nm[:] = range(14)
        wanted.drive_request[4] = DriveRequest.OFF
        link.write(wanted)
        await cycle(link, inputs)
        given = [power.commands[-1] for power in rack.powers]
        assert given == [(0x0F, round(12.5 * k)) if k != 4 else (0, 0) for k in range(14)]
        assert rack.reads[-1] == (2, 119) and rack.writes[-1] == (200, 231)

    rack_bench(body, 14)


def test_registers_that_are_nobodys_are_not_written() -> None:
    """Axis 2 drives nothing of this line: two writes go around it."""

    def without_axis_2(line: Line) -> Line:
        drives = [drive for drive in line.drives if drive.channel != 2]
        return line.model_copy(update={"drives": drives})

    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        await link.prepare()
        rack.writes.clear()
        peer.requests.clear()
        link.write(outputs(3))
        await cycle(link, Inputs(3))
        assert rack.writes == [(200, 205), (208, 209)]
        assert [pdu[0] for _, pdu in peer.requests] == [23, 16]
        assert rack.powers[0].commands and rack.powers[2].commands and not rack.powers[1].commands

    rack_bench(body, change=without_axis_2)


def test_one_torque_that_cannot_be_commanded_stops_the_whole_unit() -> None:
    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        inputs = Inputs(3)
        await enabled(link, inputs)
        before = len(rack.writes)
        wanted = outputs(3)
        wanted.torque_nm[1] = nan
        link.write(wanted)
        await cycle(link, inputs)
        assert len(rack.writes) == before, "there is no half of a transaction"
        assert "drive-2: torque nan" in link.health.last_error and "it is not written to" in link.health.last_error
        assert inputs.plc.quality == Quality.STALE, "it could not be told to stop"
        assert inputs.tension.good() and inputs.speed.good()
        link.write(outputs(3))
        await cycle(link, inputs)
        assert len(rack.writes) == before + 1 and inputs.plc.quality == Quality.GOOD

    rack_bench(body)


def test_a_rack_that_is_not_heard_is_not_written_to_again() -> None:
    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        inputs = Inputs(3)
        await enabled(link, inputs)

        async def unheard(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
            await rack.script(head, unit, pdu)
            return []

        peer.script = unheard
        for _ in range(3):
            link.write(outputs(3))
            await cycle(link, inputs)
        assert list(inputs.drive_state) == [DriveState.ABSENT] * 3 and inputs.plc.quality == Quality.STALE
        assert link.health.absent == ["drive-1", "drive-2", "drive-3", "cell-1, cell-2, cell-3", "plc"]
        fed = len(rack.writes)
        peer.script = rack.script
        inputs.speed.quality[:] = Quality.STALE
        async with asyncio.timeout(5.0):
            while not inputs.speed.good():
                link.write(outputs(3))
                await cycle(link, inputs, 0.05)
                await asyncio.sleep(0)
        link.write(outputs(3))
        await cycle(link, inputs)
        assert len(rack.writes) == fed and list(inputs.drive_state) == [DriveState.FAULT] * 3
        assert inputs.plc.quality == Quality.STALE and inputs.unwind_speed.good() and inputs.tension.good()
        for power in rack.powers:
            power.statusword = FAULT
        await link.prepare()
        link.write(outputs(3, request=DriveRequest.RESET_FAULT))
        await cycle(link, inputs)
        link.write(outputs(3, request=DriveRequest.RESET_FAULT))
        await cycle(link, inputs)
        assert [power.statusword for power in rack.powers] == [SWITCH_ON_DISABLED] * 3

    rack_bench(body)


def test_what_is_wrong_with_one_device_is_its_own() -> None:
    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        inputs = Inputs(3)
        await enabled(link, inputs)
        rack.powers[1].statusword = FAULT
        rack.registers[15] = 2  # wire break of channel 1
        link.write(outputs(3))
        await cycle(link, inputs)
        assert list(inputs.drive_state) == [DriveState.ENABLED, DriveState.FAULT, DriveState.ENABLED]
        assert list(inputs.tension.quality) == [Quality.BAD, Quality.GOOD, Quality.GOOD]
        assert inputs.plc.quality == Quality.GOOD

    rack_bench(body)


def test_a_rack_with_fewer_axes_is_refused() -> None:
    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        rack.registers[1] = 2
        with pytest.raises(PrepareRefused) as refused:
            await link.prepare()
        assert refused.value.reasons == [
            finding("channel-missing", device="drive-3", channel=3, channels=2),
            finding("channel-missing", device="cell-3", channel=3, channels=2),
        ]

    rack_bench(body)


def test_a_refused_watchdog_undoes_the_other() -> None:
    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        rack.registers[300:302] = [40, 50]
        for refused_at in (300, 301):
            rack.refuses = {refused_at: 3}
            with pytest.raises(PrepareRefused, match="setting-not-set"):
                await link.prepare()
            assert rack.registers[300:302] == [40, 50]

    rack_bench(body)


async def period(link: ModbusLink, inputs: Inputs) -> None:
    """A cycle and the time that is left of its period, in which settings are looked at."""
    end_s = asyncio.get_running_loop().time() + 0.1
    link.write(outputs(inputs.n))
    await cycle(link, inputs)
    await asyncio.sleep(end_s - asyncio.get_running_loop().time())


def test_settings_out_of_reach_are_looked_at_beside_the_cycle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.modbus.looks.LOOK_S", 0.0)

    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        inputs = Inputs(3)
        await link.prepare()
        async with asyncio.timeout(5.0):
            while not (inputs.drive_state == DriveState.ENABLED).all():
                await period(link, inputs)
        for looked in ((300, 300), (301, 301)):
            rack.reads.clear()
            async with asyncio.timeout(5.0):
                while looked not in rack.reads:
                    await period(link, inputs)
        assert (inputs.drive_state == DriveState.ENABLED).all() and inputs.plc.quality == Quality.GOOD
        rack.registers[301] = 1000
        async with asyncio.timeout(5.0):
            while inputs.drive_state[0] != DriveState.FAULT:
                await period(link, inputs)
        assert "watchdog reads 1000, 100 was set" in link.health.last_error
        assert all(power.commands[-1] == (0x00, 0) for power in rack.powers), "told to rest, all of them"
        assert rack.registers[200] == 0 and inputs.plc.quality == Quality.STALE

    rack_bench(body)


@pytest.mark.parametrize(("patience_s", "looks"), [(inf, False), (0.0, True)])
def test_a_slow_rack_gives_up_a_cycle_for_its_settings_only_now_and_then(
    monkeypatch: pytest.MonkeyPatch, patience_s: float, looks: bool
) -> None:
    monkeypatch.setattr("drivers.modbus.looks.LOOK_S", 0.0)
    monkeypatch.setattr("drivers.modbus.looks.LOOK_PATIENCE_S", patience_s)

    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        inputs = Inputs(3)
        await link.prepare()

        async def slow(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
            if pdu[0] == 23:
                await asyncio.sleep(0.05)  # half a period
            return await rack.script(head, unit, pdu)

        peer.script = slow
        rack.reads.clear()
        for _ in range(10):
            await period(link, inputs)
        async with asyncio.timeout(5.0):
            while looks and (300, 300) not in rack.reads:
                await period(link, inputs)
        assert looks or not {(300, 300), (301, 301)} & {*rack.reads}

    rack_bench(body)


# answers that must not be believed; `answer` is the right one, to a function 23


def _frame(head: bytes, pdu: bytes, unit: int = 3) -> list[bytes]:
    return [frame(head, unit, pdu)]


def _resized(answer: bytes, by: int) -> bytes:
    registers = answer[2:] + bytes(2 * by) if by > 0 else answer[2 : len(answer) + 2 * by]
    return bytes((answer[0], len(registers))) + registers


LIES: dict[str, Callable[[bytes, bytes], list[bytes]]] = {
    "function 3": lambda head, answer: _frame(head, b"\x03" + answer[1:]),
    "function 16": lambda head, answer: _frame(head, struct.pack(">BHH", 16, 200, 10)),
    "unit 4": lambda head, answer: _frame(head, answer, unit=4),
    "unit 0": lambda head, answer: _frame(head, answer, unit=0),
    "transaction before": lambda head, answer: _frame(struct.pack(">H", struct.unpack(">H", head)[0] - 1), answer),
    "transaction 0": lambda head, answer: _frame(b"\0\0", answer),
    "one register less": lambda head, answer: _frame(head, _resized(answer, -1)),
    "one register more": lambda head, answer: _frame(head, _resized(answer, 1)),
    "no register": lambda head, answer: _frame(head, answer[:1] + b"\0"),
    "half a register": lambda head, answer: _frame(head, answer[:1] + bytes((answer[1] - 1,)) + answer[2:-1]),
    "exception 2": lambda head, answer: _frame(head, b"\x97\x02"),
    "exception 11": lambda head, answer: _frame(head, b"\x97\x0b"),
    "half a frame": lambda head, answer: [frame(head, 3, answer)[:20]],
    "another protocol": lambda head, answer: [head + b"\0\1" + frame(head, 3, answer)[4:]],
    "nothing": lambda head, answer: [],
}


@pytest.mark.parametrize("lie", LIES.values(), ids=LIES.keys())
def test_a_lie_is_a_lost_cycle_for_the_whole_unit_and_no_more(lie: Callable[[bytes, bytes], list[bytes]]) -> None:
    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        inputs = Inputs(3)
        rack.number(13, ">f", 12.5)
        await enabled(link, inputs)

        async def lies(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
            return lie(head, rack.answer(pdu))

        rack.number(13, ">f", 99.0)
        peer.script = lies
        link.write(outputs(3))
        await cycle(link, inputs)
        assert list(inputs.tension.quality) == [Quality.STALE] * 3 and inputs.tension.value[0] == 12.5
        assert list(inputs.speed.quality) == [Quality.STALE] * 3 and inputs.plc.quality == Quality.STALE
        assert list(inputs.drive_state) == [DriveState.ENABLED] * 3, "one lost cycle is tolerated"
        assert link.health.timeouts == 1 and link.health.last_error
        peer.script = rack.script
        before = link.health.reconnects
        link.write(outputs(3))
        await cycle(link, inputs)
        if inputs.tension.quality[0] != Quality.GOOD:  # the stream could not be trusted any more
            await until(lambda: link.health.reconnects > before)
            link.write(outputs(3))
            await cycle(link, inputs)
        assert inputs.tension.good() and inputs.tension.value[0] == 99.0
        assert list(inputs.drive_state) == [DriveState.ENABLED] * 3 and inputs.plc.quality == Quality.GOOD

    rack_bench(body)


def test_an_answer_that_comes_twice_counts_once() -> None:
    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        inputs = Inputs(3)

        async def twice(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
            return [frame(head, unit, rack.answer(pdu))] * 2

        peer.script = twice
        for tension_n in (1.0, 2.0, 3.0, 4.0):
            rack.number(13, ">f", tension_n)
            await cycle(link, inputs)
            assert inputs.tension.good() and inputs.tension.value[0] == tension_n

    rack_bench(body)


def test_a_late_answer_does_not_answer_the_next_request() -> None:
    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        inputs = Inputs(3)
        await cycle(link, inputs)
        late: list[bytes] = []

        async def late_then_two(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
            answer = frame(head, unit, rack.answer(pdu))
            if not late:
                late.append(answer)
                return []
            return [*late, answer]

        peer.script = late_then_two
        rack.number(13, ">f", 7.0)
        await cycle(link, inputs)
        assert inputs.tension.quality[0] == Quality.STALE
        rack.number(13, ">f", 8.0)
        await cycle(link, inputs)
        assert inputs.tension.good() and inputs.tension.value[0] == 8.0

    rack_bench(body)


def test_attempts_to_connect_become_rarer() -> None:
    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        inputs = Inputs(3)
        await peer.stop()
        begin_s = asyncio.get_running_loop().time()
        attempts: list[float] = []
        for tick in range(600):  # a minute in steps of 0.1 s; the link takes the time from `trigger`
            before = link.health.last_error
            link.health.last_error = ""
            link.trigger(begin_s + 0.1 * tick)
            await link.collect(inputs, begin_s)
            await asyncio.sleep(0.001)
            if "no connection" in link.health.last_error:
                attempts.append(0.1 * tick)
            link.health.last_error = link.health.last_error or before
        assert 20 <= len(attempts) <= 40, "every 2 s in the end"
        assert attempts[1] - attempts[0] <= 0.3, "soon at first"

    rack_bench(body)
