"""The thread beside the loop, as the kernel sees it."""

import subprocess
import sys

import pytest

#: On one processor, as the loop begins: the thread, then the loop's priority, then work.
LOOP = """
import asyncio, os, threading
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from gateway.loop.aside import Aside
from gateway.loop.realtime import become_punctual
aside = Aside()
before = sum(thread.name.startswith("aside") for thread in threading.enumerate())
granted = any("real-time" in one for one in become_punctual(None, 60)[0])
async def story():
    return await aside.do(lambda: os.sched_getscheduler(0))
print(before, granted, asyncio.run(story()) == (os.SCHED_RR if granted else os.SCHED_OTHER))
"""


@pytest.mark.wires
def test_it_runs_before_the_loop_takes_its_priority_and_is_behind_it_from_then_on() -> None:
    ran = subprocess.run([sys.executable, "-c", LOOP], capture_output=True, text=True, timeout=120, check=True)
    before, _, stands_back = ran.stdout.split()
    assert (before, stands_back) == ("1", "True")
