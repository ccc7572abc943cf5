"""What the gateway could not do is tried again, later each time, and told once: stores, and the agents' bus."""

import asyncio
from pathlib import Path

import pytest

from gateway.mailbox.bus import BusUnavailable
from gateway.mailbox.inprocess import Hub, InProcessMailbox
from gateway.mailbox.port import Counters, Unreachable
from gateway.supervisor.agents_bus import AgentsBus
from gateway.supervisor.agents_cases import AgentsCases
from gateway.supervisor.configurations import ConfigurationsError
from gateway.supervisor.gate import Gate
from gateway.supervisor.patience import FIRST_WAIT_S, LONGEST_WAIT_S, Patience
from gateway.supervisor.store_writer import StoreWriter
from tests.support.gateway_key import to_loop_over
from tests.unit.deployer_support import LINE, Death, FakeJudge, FakeLoop, FakeSurroundings

LOOK_S, NOW_S = 0.25, 1_795_000_000.0


class Bench:
    """A clock, and what was told."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.told: list[str] = []
        self.codes: list[object] = []

    def note(self, kind: str, text: str, **data: object) -> None:
        self.told.append(text)
        self.codes.append(data.get("code"))

    def clock(self) -> float:
        return self.now_s


def test_what_fails_is_due_later_each_time_and_its_first_failure_and_its_end_are_told() -> None:
    bench = Bench()
    patience, waits = Patience(bench.clock), []
    assert patience.is_due() and not patience.succeeded()
    for nth in range(10):
        assert patience.failed() == (nth == 0)
        began_s = bench.now_s
        while not patience.is_due():
            bench.now_s += 1.0
        waits.append(bench.now_s - began_s)
    assert waits[:4] == [FIRST_WAIT_S * 2.0**k for k in range(4)] and waits[-1] == LONGEST_WAIT_S
    assert patience.succeeded() and not patience.succeeded() and patience.is_due()


def test_a_store_that_could_not_be_reached_is_told_later_what_the_loop_was_started_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, tries, locked = Bench(), [], False

    async def store_given(_: StoreWriter) -> None:
        tries.append(bench.now_s)
        if locked:
            raise ConfigurationsError("the database is locked")

    monkeypatch.setattr(StoreWriter, "store_given", store_given)

    async def story() -> None:
        nonlocal locked
        gate = Gate(
            LINE, InProcessMailbox(Hub()), to_loop_over(InProcessMailbox(Hub()), LINE), tmp_path, FakeJudge(),
            lambda configurations, models: FakeSurroundings(FakeLoop(Death())), bench.note, bench.clock, lambda: NOW_S,
        )  # fmt: skip
        try:
            while gate.deployer is None:
                await gate.look()

            async def pass_time(seconds: float) -> int:
                before = len(tries)
                for _ in range(round(seconds / LOOK_S)):
                    bench.now_s += LOOK_S
                    await gate.look()
                return len(tries) - before

            gate.deployer.book.in_service, locked = "1" * 64, True
            assert 4 <= await pass_time(100.0) <= 6
            assert bench.codes.count("given-not-stored") == 1
            gate.deployer.book.in_service = "2" * 64  # another one is tried at once
            assert await pass_time(2.0 * LOOK_S) == 1
            locked = False
            assert await pass_time(LONGEST_WAIT_S) == 1
            assert bench.codes[-1] == "given-stored"
        finally:
            await gate.close()

    asyncio.run(story())


def test_nothing_is_armed_while_the_gate_is_shut_and_an_arming_waits_for_it_to_open(tmp_path: Path) -> None:
    bench = Bench()

    async def story() -> None:
        gate = Gate(
            LINE, InProcessMailbox(Hub()), to_loop_over(InProcessMailbox(Hub()), LINE), tmp_path, FakeJudge(),
            lambda configurations, models: FakeSurroundings(FakeLoop(Death())), bench.note, bench.clock, lambda: NOW_S,
        )  # fmt: skip
        try:
            assert [one.code for one in await gate.hold_against_records()] == ["configuration-not-looked-at"]
            waits = asyncio.create_task(gate.hold_against_records())
            while gate.deployer is None:
                await gate.look()
            with pytest.raises(Unreachable):  # it has asked the loop, and there is none
                await waits
        finally:
            await gate.close()

    asyncio.run(story())


class FakeBus:
    """A session on which nobody asks."""

    counters = Counters()

    def watch(self, *_: object) -> None: ...

    async def close(self) -> None: ...


def test_a_bus_that_cannot_be_opened_is_tried_again_until_it_can(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, tries, in_the_way = Bench(), [], True

    async def open_router(*_: object) -> FakeBus:
        tries.append(bench.now_s)
        if in_the_way:
            raise BusUnavailable("somebody else listens there")
        return FakeBus()

    monkeypatch.setattr("gateway.supervisor.agents_bus.open_router", open_router)

    async def append(*_: object) -> None: ...

    async def story() -> None:
        nonlocal in_the_way
        bus = AgentsBus(LINE, tmp_path, (), bench.note, AgentsCases(append, bench.clock), bench.clock)

        async def pass_time(seconds: float) -> None:
            for _ in range(round(seconds / LOOK_S)):
                bench.now_s += LOOK_S
                await bus.keep_open()

        await pass_time(100.0)
        assert 4 <= len(tries) <= 6 and not bus.status().open and "somebody else" in bus.status().text
        in_the_way = False
        await pass_time(LONGEST_WAIT_S)
        assert bus.status().open and bus.status().text == ""
        so_far = len(tries)
        await pass_time(LONGEST_WAIT_S)
        assert len(tries) == so_far
        assert bench.told == ["the agents' bus is closed: somebody else listens there", "the agents' bus is open"]
        await bus.close()

    asyncio.run(story())
