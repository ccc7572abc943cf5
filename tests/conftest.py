"""For all tests: what is about the wall clock says so by its mark, no property fails because it took long, and the
gateway's event loops wait for nothing.
"""

import gc
import os
import sys
from collections.abc import Iterator

import pytest

from tests.support.alone import MARKS, alone

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the commands: on small matrices threads wait on each other

from hypothesis import HealthCheck, settings

from tests.support import event_loop_guard

event_loop_guard.begin()
settings.register_profile(
    "any machine", deadline=None, derandomize=False, max_examples=100, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile(
    "landing", settings.get_profile("any machine"), derandomize=True, database=None, max_examples=40
)
settings.register_profile("fast", settings.get_profile("landing"), max_examples=25)
settings.load_profile("any machine")


@pytest.fixture(autouse=True, scope="module")
def _leaves_nothing_behind() -> Iterator[None]:
    """What a module leaks is told in it, not in the next one; nor do its thread switching and its umask stay."""
    before_s, umask = sys.getswitchinterval(), os.umask(0o022)
    os.umask(umask)
    yield
    sys.setswitchinterval(before_s)
    os.umask(umask)
    gc.collect()


@pytest.fixture(autouse=True)
def _event_loops_wait_for_nothing() -> Iterator[None]:
    """Of the gateway's: no store, no zip, no long hash and no look-up of a user in their own thread."""
    yield
    assert event_loop_guard.taken() == []


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Fixtures of a module are of the clock of the test that asks for them first: a mark is of a whole file."""
    if any(item.get_closest_marker(mark) for mark in MARKS) or "system" in item.path.parts:
        return (yield)
    with alone():
        return (yield)
