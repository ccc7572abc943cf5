"""What the operating system can do for punctuality, and an honest line about what it did not."""

import ctypes
import gc
import os
import struct

# Current and future pages, each from its first use on: locking what is only reserved would treble the memory.
_MCL_USED = 1 | 2 | 4
_LATENCY_REQUEST = "/dev/cpu_dma_latency"


def become_punctual(cpu: int | None, priority: int) -> tuple[list[str], list[str]]:
    """Ask for real-time priority, an own processor and locked memory. Returns what was granted and what was not."""
    granted: list[str] = []
    refused: list[str] = []
    try:
        # For this thread alone: threads and processes that it starts from now on have no such priority.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
        granted.append(f"real-time priority {priority} (SCHED_FIFO)")
    except PermissionError:
        # Pinned without priority it would only queue behind whatever else runs on that processor.
        refused.append("no real-time priority: needs CAP_SYS_NICE or an rtprio limit (ulimit -r) for this user")
    else:
        processors = sorted(os.sched_getaffinity(0))
        wanted = processors[-1] if cpu is None else cpu
        try:
            os.sched_setaffinity(0, {wanted})
            granted.append(f"pinned to processor {wanted}")
        except OSError:
            refused.append(f"not pinned: processor {wanted} is not among {processors}")
    if ctypes.CDLL(None).mlockall(_MCL_USED) == 0:
        granted.append("memory locked")
    else:
        refused.append("memory not locked: needs CAP_IPC_LOCK or a higher memlock limit (ulimit -l)")
    return granted, refused


def stay_awake() -> str:
    """Keep every processor out of sleep states that it takes time to wake from; returns why not, or nothing.

    Linux, PM quality of service: the request holds while the descriptor is open, that is until this process ends. On
    a virtual machine a processor that never halts need not wait for its host either.
    """
    try:
        request = os.open(_LATENCY_REQUEST, os.O_WRONLY)
        os.write(request, struct.pack("i", 0))  # microseconds
    except OSError as error:
        return f"processors may sleep between periods: {_LATENCY_REQUEST}: {error.strerror}"
    return ""


def freeze_collector() -> None:
    """Take everything that lives after start-up out of garbage collection: a pause of 43 ms becomes none.

    What is made from now on is collected. The collection after freezing finds next to nothing, and notes so: without
    it, all generations are looked at only once a quarter of what was frozen has been added, some 26,000 objects.
    """
    gc.collect()
    gc.freeze()
    gc.collect()
