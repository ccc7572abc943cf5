"""The process that starts the OPC UA processes: `python -m drivers.opcua.spawner FD PARENT PRIORITY PROCESSORS`.

To start a process, a parent waits until its child runs another program, and its threads with it, since the
interpreter's lock is held meanwhile: that is no work for a real-time loop. So this small one is started before the loop
becomes real-time, and whenever a worker is needed, it is sent the worker's end of a socket pair and its generation.
There is one worker at a time: a new one ends the one before, and a message without a socket ends it, too. When the
loop hangs up, the worker may end in order, and the spawner follows. If the loop dies, the kernel ends the spawner, and
so the worker.
"""

import ctypes
import os
import select
import signal
import socket
import sys
from contextlib import suppress

CLOSE_TIMEOUT_S = 1.5  #: for a worker's ordered end
MAX_REQUEST = 64  #: bytes
SOCKET_FD = 3  #: in spawner and worker, their end of a socket pair
#: They go to all processes of a terminal or a service at once. The loop still needs its devices then, to stop the line.
_NOT_FOR_WORKERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_PR_SET_PDEATHSIG = 1


def main(arguments: list[str]) -> int:
    fd, parent = map(int, arguments[:2])
    priority, processors = arguments[2:4]
    die_with(parent)
    with suppress(OSError, ValueError):  # a processor may be gone, or not be ours
        os.sched_setaffinity(0, {int(processor) for processor in processors.split(",")})
    control = socket.socket(fileno=fd)
    worker: int | None = None
    while True:
        request, fds, _, _ = socket.recv_fds(control, MAX_REQUEST, 1, socket.MSG_CMSG_CLOEXEC)
        if worker is not None:
            _end(worker, 0.0 if request else CLOSE_TIMEOUT_S)
            worker = None
        if not request:
            return 0
        for end_of_worker in fds:
            with suppress(OSError):  # the loop is told by the end of the connection, and asks again
                worker = spawn("drivers.opcua.worker", end_of_worker, str(os.getpid()), request.decode(), priority)
            os.close(end_of_worker)


def spawn(module: str, fd: int, *arguments: str) -> int:
    """Start `python -m module SOCKET_FD ARGUMENTS` with `fd` as its SOCKET_FD. Returns its pid. Raises OSError."""
    # Not as a real-time process: from within the loop it would start up at the loop's own priority.
    return os.posix_spawn(
        sys.executable,
        [sys.executable, "-P", "-m", module, str(SOCKET_FD), *arguments],
        os.environ,
        file_actions=[
            (os.POSIX_SPAWN_DUP2, fd, SOCKET_FD),
            *((os.POSIX_SPAWN_OPEN, number, os.devnull, os.O_RDWR, 0) for number in range(3)),
        ],
        setsigmask=_NOT_FOR_WORKERS,
        scheduler=(os.SCHED_OTHER, os.sched_param(0)),
    )


def die_with(parent: int) -> None:
    """Be killed when the parent ends, however it does."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it was gone before that took effect
        os.kill(os.getpid(), signal.SIGKILL)


def kill_child(pid: int) -> None:
    """Whether it runs or has ended by itself, it is gone then. One that is not reaped yet keeps its number."""
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)


def _end(worker: int, patience_s: float) -> None:
    handle = os.pidfd_open(worker)
    select.select([handle], [], [], patience_s)
    os.close(handle)
    kill_child(worker)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
