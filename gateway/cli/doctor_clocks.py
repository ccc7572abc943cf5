"""The clocks: the monotonic one, which everything counts on, and the wall clock, which only dates what happened."""

import ctypes
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from gateway.cli.doctor_check import Check

ROOT = Path("/")
WANTED_STEP_S = 1e-5  #: of the monotonic clock; a timer's lateness is tens of microseconds
_READINGS = 2000
_GROUP = "clocks"
_TIME_ERROR = 5  #: adjtimex(2): the clock is not synchronised


class _Timex(ctypes.Structure):
    """struct timex of adjtimex(2). `modes` 0: only asked."""

    _fields_ = [
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * 256),
    ]


def clocks(root: Path = ROOT, adjtimex: Callable[[], tuple[int, int]] | None = None) -> Iterator[Check]:
    """`adjtimex` gives the state of the wall clock and its greatest error in us; the kernel's where it is left out."""
    yield _monotonic(root)
    state, greatest_us = (adjtimex or _adjtimex)()
    if state < 0:
        yield Check(_GROUP, "wall clock", "", "skipped", "the kernel does not say whether it is synchronised")
    elif state == _TIME_ERROR:
        todo = "start chrony or systemd-timesyncd: history and audit are dated by it; control does not use it"
        yield Check(_GROUP, "wall clock", "", "warning", "not synchronised", "synchronised", todo)
    else:
        measured = f"synchronised, off by at most {greatest_us / 1e3:.1f} ms"
        yield Check(_GROUP, "wall clock", "", "OK", measured, "synchronised")


def _monotonic(root: Path) -> Check:
    resolution_s = time.clock_getres(time.CLOCK_MONOTONIC)
    readings = [time.monotonic_ns() for _ in range(_READINGS)]
    steps = [later - before for before, later in zip(readings, readings[1:], strict=False) if later > before]
    step_s = 1e-9 * min(steps) if steps else float("inf")
    try:
        source = (root / "sys/devices/system/clocksource/clocksource0/current_clocksource").read_text().strip()
    except OSError:
        source = "unknown"
    measured = f"step {1e6 * step_s:.2f} us, resolution {1e9 * resolution_s:g} ns, source {source}"
    wanted = f"step below {1e6 * WANTED_STEP_S:g} us"
    if any(later < before for before, later in zip(readings, readings[1:], strict=False)):
        return Check(_GROUP, "monotonic clock", "", "FAIL", "it goes backwards", "never", "use another clock source")
    if max(step_s, resolution_s) > WANTED_STEP_S:
        todo = "a coarse clock source: see `clocksource=` of the kernel's command line (tsc where it is stable)"
        return Check(_GROUP, "monotonic clock", "", "FAIL", measured, wanted, todo)
    return Check(_GROUP, "monotonic clock", "", "OK", measured, wanted)


def _adjtimex() -> tuple[int, int]:
    timex = _Timex(modes=0)
    state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    return state, timex.maxerror
