"""Long tasks that raise: told once a kind, gone on with, and no fault any more once they are steady."""

import asyncio

import pytest

from gateway.tasks.supervisor import LONGEST_TURN_S, LONGEST_WAIT_S, STEADY_S, Supervisor, TaskFault


class Bench:
    def __init__(self, longest_turn_s: float = LONGEST_TURN_S) -> None:
        self.now_s = 0.0
        self.told: list[tuple[str, str]] = []
        self.heard: asyncio.Event | None = None
        self.supervisor = Supervisor(self._tell, lambda: self.now_s, longest_turn_s)

    def _tell(self, fault: TaskFault, error: BaseException | None) -> None:
        if self.heard is not None:
            self.heard.set()
        self.told.append((fault.task, "mended" if error is None else type(error).__name__))

    def turn(self, error: Exception | None = None) -> None:
        def one() -> None:
            if error is not None:
                raise error

        self.supervisor.turn("look", one)


def test_each_type_of_exception_is_told_once_until_the_task_is_steady_again() -> None:
    bench = Bench()
    for _ in range(10):
        bench.turn(KeyError("x"))
        bench.turn(OSError("y"))
        bench.turn()
        bench.now_s += 1.0
    assert bench.told == [("look", "KeyError"), ("look", "OSError")]
    (fault,) = bench.supervisor.faults
    assert (fault.error, fault.text, fault.times, fault.in_a_row) == ("OSError", "y", 20, 0)
    bench.now_s += STEADY_S
    bench.turn()
    assert bench.told[2:] == [("look", "mended")] and bench.supervisor.faults == []
    bench.turn(KeyError("x"))
    assert bench.told[3:] == [("look", "KeyError")]


def test_a_turn_that_fails_is_taken_again_later_each_time_and_never_later_than_a_second() -> None:
    bench, waits = Bench(), []
    for _ in range(40):
        bench.turn(ValueError("always"))
        waits.append(bench.supervisor.wait_s("look", 0.1))
    assert waits[:4] == [0.1, 0.2, 0.4, 0.8] and set(waits[4:]) == {LONGEST_WAIT_S}
    assert bench.supervisor.wait_s("look", 5.0) == 5.0
    bench.turn()
    assert bench.supervisor.wait_s("look", 0.1) == 0.1


def test_a_task_goes_on_after_what_it_raises_and_ends_when_it_is_told_to() -> None:
    bench = Bench()

    async def story() -> None:
        stop, turns = asyncio.Event(), 0

        async def turn() -> None:
            nonlocal turns
            turns += 1
            if turns == 2:
                raise RuntimeError("once")
            if turns == 4:
                stop.set()

        await bench.supervisor.repeat("look", turn, 0.0, stop)
        assert turns == 4

    asyncio.run(story())
    assert bench.told == [("look", "RuntimeError")]


def test_cancellation_passes_and_is_no_fault() -> None:
    bench = Bench()

    async def story() -> None:
        async def turn() -> None:
            await asyncio.Event().wait()

        for task in (
            asyncio.create_task(bench.supervisor.repeat("look", turn, 0.0)), bench.supervisor.begin("once", turn())
        ):  # fmt: skip
            await asyncio.sleep(0)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task

    asyncio.run(story())
    assert bench.told == [] and bench.supervisor.faults == []


def test_a_turn_that_takes_long_is_told_while_it_goes_on_and_is_not_cancelled() -> None:
    bench = Bench(longest_turn_s=0.0)

    async def story() -> None:
        told, go_on = asyncio.Event(), asyncio.Event()
        bench.heard = told

        async def turn() -> None:
            await go_on.wait()

        stop = asyncio.Event()
        repeated = asyncio.create_task(bench.supervisor.repeat("look", turn, 0.0, stop))
        await told.wait()
        (fault,) = bench.supervisor.faults
        assert fault.error == "TakesLong" and "goes on" in fault.text and not repeated.done()
        stop.set()
        go_on.set()
        await repeated

    asyncio.run(story())
    assert bench.told == [("look", "TakesLong")]


def test_every_step_of_an_end_is_taken_whatever_the_one_before_raised() -> None:
    bench, done = Bench(), []

    def step(name: str, error: Exception | None = None):
        async def taken() -> None:
            done.append(name)
            if error is not None:
                raise error

        return taken

    steps = {"bus": step("bus", OSError("gone")), "gate": step("gate", KeyError("x")), "disk": step("disk")}
    asyncio.run(bench.supervisor.end(steps))
    assert done == list(steps) and bench.told == [("bus", "OSError"), ("gate", "KeyError")]


def test_work_that_nobody_awaits_is_told_too_and_is_cancelled_at_the_end() -> None:
    bench = Bench()

    async def story() -> None:
        async def work() -> None:
            raise ZeroDivisionError

        async def endless() -> None:
            await asyncio.Event().wait()

        await bench.supervisor.begin("once", work())
        left = bench.supervisor.begin("endless", endless())
        await asyncio.sleep(0)
        await bench.supervisor.close()
        assert left.cancelled()

    asyncio.run(story())
    assert bench.told == [("once", "ZeroDivisionError")]
