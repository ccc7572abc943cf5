"""Cleanup that a cancellation cannot cut: to its end, whoever waits is cancelled, and only then is told."""

import asyncio
import gc
import weakref

import pytest

from gateway.tasks.cleanup import end, finish, finish_all


class Work:
    """Cleanup in steps; each waits until it is let go on."""

    def __init__(self, steps: int = 3, failure: Exception | None = None) -> None:
        self.done, self._steps, self._failure = 0, steps, failure
        self.gate = asyncio.Event()

    async def run(self) -> str:
        for _ in range(self._steps):
            await self.gate.wait()
            await asyncio.sleep(0)
            self.done += 1
        if self._failure is not None:
            raise self._failure
        return "all"


async def _turns(count: int = 3) -> None:
    for _ in range(count):
        await asyncio.sleep(0)


def _others() -> set[asyncio.Task]:
    return asyncio.all_tasks() - {asyncio.current_task()}


def test_the_result_of_the_work_is_returned_and_its_exception_raised():
    async def story():
        work = Work()
        work.gate.set()
        assert await finish(work.run()) == "all"
        broken = Work(failure=OSError("gone"))
        broken.gate.set()
        with pytest.raises(OSError, match="gone"):
            await finish(broken.run())
        assert not _others()

    asyncio.run(story())


@pytest.mark.parametrize("times", [1, 2, 3, 10])
def test_however_often_it_is_cancelled_the_work_comes_to_its_end_and_then_the_cancellation_is_raised(times):
    async def story():
        work = Work()
        waiter = asyncio.create_task(finish(work.run()))
        await _turns()
        for _ in range(times):
            waiter.cancel()
            await _turns()
            assert not waiter.done() and work.done == 0
        work.gate.set()
        with pytest.raises(asyncio.CancelledError):
            await waiter
        assert work.done == 3 and not _others()

    asyncio.run(story())


@pytest.mark.parametrize("step", range(12))
@pytest.mark.parametrize("apart", [0, 1, 2])
def test_at_whichever_step_two_cancellations_come_nothing_is_cut(step, apart):
    async def story():
        work = Work()
        work.gate.set()
        waiter = asyncio.create_task(finish(work.run()))
        await _turns(step)
        first = waiter.cancel()
        await _turns(apart)
        waiter.cancel()
        await asyncio.wait([waiter])
        if _others():  # cancelled before its own first step nobody waits, and the work runs all the same
            await asyncio.wait(_others())
        assert work.done == 3 and waiter.cancelled() == first

    asyncio.run(story())


def test_a_task_whose_cancellation_is_still_to_come_runs_the_work_all_the_same():
    async def story():
        work = Work()
        work.gate.set()

        async def cancelled_and_cleaning():
            asyncio.current_task().cancel()
            await finish(work.run())

        with pytest.raises(asyncio.CancelledError):
            await asyncio.create_task(cancelled_and_cleaning())
        assert work.done == 3 and not _others()

    asyncio.run(story())


def test_whoever_is_cancelled_before_its_first_step_has_started_the_work_and_it_is_not_collected_on_the_way():
    async def story():
        work = Work()
        waiter = asyncio.create_task(finish(work.run()))
        waiter.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiter
        del waiter
        gc.collect()
        work.gate.set()
        await asyncio.wait(_others())
        assert work.done == 3

    asyncio.run(story())


def test_an_exception_of_work_that_was_to_be_cut_is_the_cause_of_the_cancellation():
    async def story():
        work = Work(failure=OSError("gone"))
        waiter = asyncio.create_task(finish(work.run()))
        await _turns()
        waiter.cancel()
        await _turns()
        work.gate.set()
        with pytest.raises(asyncio.CancelledError) as told:
            await waiter
        assert repr(told.value.__cause__) == "OSError('gone')" and work.done == 3

    asyncio.run(story())


@pytest.mark.parametrize("cancellations", [0, 1])
def test_what_is_raised_is_freed_without_the_garbage_collector(cancellations):
    seen = []

    class Gone(OSError):
        pass

    async def work():
        await _turns()
        error = Gone()
        seen.append(weakref.ref(error))
        try:
            raise error
        finally:
            del error

    async def story():
        waiter = asyncio.create_task(finish(work()))
        await _turns(1)
        for _ in range(cancellations):
            waiter.cancel()
        with pytest.raises(asyncio.CancelledError if cancellations else Gone):
            await waiter
        del waiter
        await _turns()
        return [error() for error in seen]

    gc.collect()
    gc.disable()
    try:
        assert asyncio.run(story()) == [None]
    finally:
        gc.enable()


def test_a_timeout_around_it_is_told_when_the_work_is_over_and_one_inside_it_works():
    async def story():
        work = Work()

        async def bounded():
            try:
                async with asyncio.timeout(0.001):
                    await asyncio.Event().wait()
            except TimeoutError:
                work.gate.set()
            return await work.run()

        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0):
                await finish(bounded())
        assert work.done == 3 and asyncio.current_task().cancelling() == 0
        await asyncio.sleep(0)  # not cancelled any more

    asyncio.run(story())


def test_work_that_is_cancelled_itself_leaves_no_one_waiting():
    async def story():
        work = Work()
        waiter = asyncio.create_task(finish(work.run()))
        await _turns()
        (inner,) = _others() - {waiter}
        inner.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiter
        assert not _others()

    asyncio.run(story())


def test_a_loop_that_closes_leaves_no_task_behind():
    ended = []

    async def work():
        try:
            await asyncio.Event().wait()
        finally:
            ended.append("work")

    async def waiting():
        try:
            await finish(work())
        finally:
            ended.append("waiter")

    async def story():
        waiter = asyncio.create_task(waiting())
        await _turns()
        assert not waiter.done()
        return waiter, *_others()

    left = asyncio.run(story())
    assert sorted(ended) == ["waiter", "work"] and all(task.done() for task in left)


def test_of_several_works_each_comes_to_its_end_and_the_failures_are_returned_in_order():
    async def story():
        first, broken, slow, worse = Work(), Work(1, OSError("one")), Work(9), Work(2, ValueError("two"))
        for work in (first, broken, slow, worse):
            work.gate.set()
        failures = await finish_all(work.run() for work in (first, broken, slow, worse))
        assert [repr(failure) for failure in failures] == ["OSError('one')", "ValueError('two')"]
        assert (first.done, broken.done, slow.done, worse.done) == (3, 1, 9, 2) and not _others()
        assert await finish_all([]) == []

    asyncio.run(story())


def test_several_works_run_side_by_side_and_no_cancellation_cuts_one():
    async def story():
        works = [Work(steps) for steps in (1, 3, 2)] + [Work(1, OSError("gone"))]
        waiter = asyncio.create_task(finish_all(work.run() for work in works))
        await _turns()
        for work in reversed(works):
            waiter.cancel()
            await _turns(9)
            assert not waiter.done()
            work.gate.set()  # each by itself: none waits for another
            await _turns(9)
            assert work.done > 0
        with pytest.raises(asyncio.CancelledError) as told:
            await waiter
        assert [work.done for work in works] == [1, 3, 2, 1] and not _others()
        assert [repr(failure) for failure in told.value.__cause__.exceptions] == ["OSError('gone')"]

    asyncio.run(story())


def test_of_several_works_one_that_somebody_else_cancels_is_told_when_all_are_over():
    async def story():
        works = [Work(), Work()]
        waiter = asyncio.create_task(finish_all(work.run() for work in works))
        await _turns()
        inner = next(iter(_others() - {waiter}))
        inner.cancel()
        await _turns()
        assert not waiter.done()
        for work in works:
            work.gate.set()
        with pytest.raises(asyncio.CancelledError):
            await waiter
        assert sorted(work.done for work in works) == [0, 3] and not _others()

    asyncio.run(story())


def test_a_task_is_ended_once_and_its_cleanup_is_cut_by_no_second_cancellation():
    async def story():
        work, started = Work(), asyncio.Event()

        async def task():
            try:
                started.set()
                await asyncio.Event().wait()
            finally:
                await work.run()  # one cancellation more would cut it
                raise OSError("gone")

        ended = asyncio.create_task(task())
        await started.wait()
        waiter = asyncio.create_task(end(ended))
        for _ in range(3):
            await _turns()
            waiter.cancel()
        await _turns()
        assert not waiter.done() and not ended.done()
        work.gate.set()
        with pytest.raises(asyncio.CancelledError):
            await waiter
        assert work.done == 3 and ended.done() and not _others()
        await end(ended)  # once more is no harm
        with pytest.raises(OSError, match="gone"):
            await ended

    asyncio.run(story())
