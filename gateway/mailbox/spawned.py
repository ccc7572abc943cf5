"""What every process needs that another one of the program has spawned to compute for it."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import parent_process
from multiprocessing.connection import wait
from threading import Lock, Thread

_environment = Lock()
SINGLE = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@contextmanager
def interrupt_later() -> Iterator[None]:
    """A process that is started here never sees Ctrl-C, which is for the one that starts it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """What begins here computes in one thread: the loop has the other processors. One at a time, of all threads."""
    with _environment:
        before = {name: os.environ.get(name) for name in SINGLE}
        os.environ.update(dict.fromkeys(SINGLE, "1"))
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value


def end_with_parent() -> None:
    """In the spawned process: be gone when the one that has spawned it is, however that ends; at once where it has.

    Left to itself it would wait for work for ever, or go on working for nobody. The kernel's own way
    (PR_SET_PDEATHSIG) is no help: it comes when the thread ends that has spawned, and not at all when the parent is
    gone before it is asked for.
    """
    parent = parent_process()
    assert parent is not None
    Thread(target=_follow, args=(parent.sentinel,), daemon=True, name="follows parent").start()


def _follow(sentinel: int) -> None:
    wait([sentinel])
    os.kill(os.getpid(), signal.SIGKILL)
