"""What happens beside the request of a cycle that is under way: other requests, release, an answer without numbers."""

import asyncio
from collections.abc import Sequence
from math import inf

import pytest

from drivers.modbus.link import ModbusLink
from drivers.modbus.plan import Plan
from drivers.port import PrepareRefused
from gateway.core.signals import Inputs, Quality
from tests.protocol.driver_support import PATIENCE_S, Registers, cycle, frame, until
from tests.protocol.modbus_support import Rack
from tests.protocol.test_driver_modbus_rack import enabled, outputs, rack_bench

HALF = 20  #: bytes of an answer


class HalfAnswers:
    """Of every answer to a cycle its first bytes, once `begins` is set; the test sends the rest, or nobody."""

    def __init__(self, rack: Rack, peer: Registers) -> None:
        self.begins = asyncio.Event()
        self.rest = b""
        self._rack, self._peer = rack, peer
        peer.script = self.script

    async def script(self, head: bytes, unit: int, pdu: bytes) -> list[bytes]:
        await self.begins.wait()
        whole = frame(head, unit, self._rack.answer(pdu))
        self.rest = whole[HALF:]
        return [whole[:HALF]]

    def go_on(self) -> None:
        (writer,) = self._peer._writers  # noqa: SLF001
        writer.write(self.rest)
        self._peer.script = self._rack.script


def half_is_there(link: ModbusLink) -> bool:
    client = link._sessions[0]._connection._client  # noqa: SLF001
    return client is not None and len(client.ctx.recv_buffer) == HALF


@pytest.mark.parametrize("half_came_first", [True, False])
def test_half_an_answer_to_a_cycle_is_waited_for_whatever_is_asked_beside_it(
    monkeypatch: pytest.MonkeyPatch, half_came_first: bool
) -> None:
    monkeypatch.setattr("drivers.modbus.session.EXCHANGE_SHARE", 10.0 * PATIENCE_S)

    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        inputs = Inputs(3)
        await cycle(link, inputs)
        await cycle(link, inputs)
        halves = HalfAnswers(rack, peer)
        rack.number(13, ">f", 12.5)
        now_s = asyncio.get_running_loop().time()
        link.trigger(now_s)
        if half_came_first:
            halves.begins.set()
            await until(lambda: half_is_there(link))
        arming = asyncio.create_task(link.prepare())
        await asyncio.sleep(0)
        halves.begins.set()
        with pytest.raises(PrepareRefused, match="unit-not-read"):
            await arming
        assert half_is_there(link)
        halves.go_on()
        await link.collect(inputs, now_s + PATIENCE_S)
        assert inputs.tension.good() and inputs.tension.value[0] == 12.5 and inputs.speed.good()
        await enabled(link, inputs)
        assert link.health.reconnects == 0 and link.health.timeouts == 0

    rack_bench(body)


def test_half_an_answer_that_stays_half_ends_the_connection_and_it_is_made_anew() -> None:
    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        inputs = Inputs(3)
        await cycle(link, inputs)
        halves = HalfAnswers(rack, peer)
        halves.begins.set()
        now_s = asyncio.get_running_loop().time()
        link.trigger(now_s)
        await until(lambda: half_is_there(link) or not link._awaited)  # noqa: SLF001
        with pytest.raises(PrepareRefused):
            await link.prepare()
        await link.collect(inputs, now_s)
        assert list(inputs.speed.quality) == [Quality.STALE] * 3
        peer.script = rack.script
        async with asyncio.timeout(PATIENCE_S):
            while not inputs.speed.good():
                await cycle(link, inputs, 0.05)
                await asyncio.sleep(0)
        assert peer.connections >= 2
        await enabled(link, inputs)

    rack_bench(body)


def test_release_waits_for_the_request_under_way_and_no_look_is_begun_after_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.modbus.session.EXCHANGE_SHARE", 10.0 * PATIENCE_S)

    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        inputs = Inputs(3)
        await enabled(link, inputs)
        asked, goes_on = asyncio.Event(), asyncio.Event()

        async def held(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
            if pdu[0] == 23:
                asked.set()
                await goes_on.wait()
            return await rack.script(head, unit, pdu)

        peer.script = held
        async with asyncio.timeout(PATIENCE_S):
            while not asked.is_set():
                link.write(outputs(3))
                link.trigger(asyncio.get_running_loop().time())
                await asyncio.sleep(0)
        link._sessions[0]._looks.begin(-inf)  # noqa: SLF001 (a look is due)
        peer.requests.clear()
        releasing = asyncio.create_task(link.release())
        await asyncio.sleep(0)
        goes_on.set()
        await releasing
        assert peer.requests[0][1][0] == 23, "the command to rest, before anything else"
        assert [power.commands[-1] for power in rack.powers] == [(0, 0)] * 3

    rack_bench(body)


def test_an_answer_without_numbers_is_a_lost_cycle_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    async def body(link: ModbusLink, rack: Rack, peer: Registers) -> None:
        inputs = Inputs(3)
        await cycle(link, inputs)  # the first one takes a task, and proves

        def no_numbers(plan: Plan, answers: Sequence[bytes]) -> list[list[float]]:
            raise ValueError("no numbers")

        with monkeypatch.context() as patched:
            patched.setattr(Plan, "decode_bytes", no_numbers)
            await cycle(link, inputs, PATIENCE_S)
        assert link.health.malformed == 1 and "no numbers" in link.health.last_error
        assert list(inputs.speed.quality) == [Quality.STALE] * 3
        await cycle(link, inputs, PATIENCE_S)
        assert inputs.speed.good() and link.health.reconnects == 0 and peer.connections == 1

    rack_bench(body)
