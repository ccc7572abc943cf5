"""The thread beside the loop, as the kernel sees it."""

import json
import os
import subprocess
import sys
from typing import Any

import pytest

#: As the loop begins: the thread, then the loop's priority and processor, then work, and another thread.
LOOP = """
import asyncio, json, os, sys, threading
os.sched_setaffinity(0, set(json.loads(sys.argv[1])))
from gateway.loop.aside import Aside
from gateway.loop.realtime import become_punctual
aside = Aside()
before = sum(thread.name.startswith("aside") for thread in threading.enumerate())
granted = any("real-time" in one for one in become_punctual(None, 60)[0])
def seen():
    return os.sched_getscheduler(0), sorted(os.sched_getaffinity(0))
def put(into):
    into += seen()
async def story():
    later = []
    await asyncio.to_thread(put, later)
    return await aside.do(seen), later
first, later = asyncio.run(story())
own = sorted(os.sched_getaffinity(0))
print(json.dumps({"before": before, "granted": granted, "own": own, "aside": first, "later": later}))
"""


def begun(processors: list[int]) -> dict[str, Any]:
    """What a loop's threads are, of a service that was granted `processors`."""
    command = [sys.executable, "-c", LOOP, json.dumps(processors)]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return json.loads(ran.stdout)


@pytest.mark.wires
def test_on_one_processor_nothing_but_the_loop_has_real_time_priority() -> None:
    only = min(os.sched_getaffinity(0))
    found = begun([only])
    assert (found["before"], found["own"]) == (1, [only])
    assert found["aside"] == [os.SCHED_OTHER, [only]] and found["later"][0] == os.SCHED_OTHER


@pytest.mark.wires
@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="there is one processor")
def test_on_several_it_is_on_those_that_were_granted_and_the_loop_has_left() -> None:
    granted = sorted(os.sched_getaffinity(0))[:2]
    found = begun(granted)
    if not found["granted"]:
        assert found["aside"] == [os.SCHED_OTHER, granted]
        return
    assert found["own"] == granted[1:]
    assert found["aside"] == [os.SCHED_RR, granted[:1]]
    assert found["later"][0] == os.SCHED_OTHER, "a thread that is begun later is no real-time one"
