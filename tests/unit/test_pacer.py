"""The pacer: periods in order, never early, missed ones skipped. Real time, because it is about time."""

import asyncio
import time

import pytest

from gateway.loop.pacer import TimerPacer

pytestmark = pytest.mark.wires

PERIOD_S = 0.01


def ticks(count: int, busy_s: float = 0.0):
    """So many ticks; the work after the first takes `busy_s`."""

    async def story():
        pacer = TimerPacer(PERIOD_S)
        try:
            found = [await pacer.wait()]
            end_s = time.monotonic() + busy_s
            while time.monotonic() < end_s:
                pass
            return found + [await pacer.wait() for _ in range(count - 1)]
        finally:
            pacer.close()

    return asyncio.run(story())


def test_no_period_begins_early_and_they_are_evenly_due():
    found = ticks(30)
    for before, tick in zip(found, found[1:], strict=False):
        assert tick.now_s >= tick.due_s
        assert tick.due_s - before.due_s == pytest.approx(PERIOD_S * (1 + tick.skipped), abs=1e-9)


def test_work_up_to_the_last_moment_skips_nothing_and_the_next_period_is_not_early():
    first, second, *_ = ticks(3, busy_s=0.99 * PERIOD_S)
    assert second.due_s - first.due_s == pytest.approx(PERIOD_S * (1 + second.skipped), abs=1e-9)
    assert second.now_s >= second.due_s


@pytest.mark.parametrize("busy_periods", [2.5, 7.5])
def test_missed_periods_are_counted_and_skipped_never_caught_up(busy_periods: float):
    first, second, third = ticks(3, busy_s=busy_periods * PERIOD_S)
    assert second.skipped >= int(busy_periods) - 1
    assert second.due_s - first.due_s == pytest.approx(PERIOD_S * (1 + second.skipped), abs=1e-9)
    assert third.due_s > second.due_s and third.now_s >= third.due_s
