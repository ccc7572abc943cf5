"""Threads of a command beside its main one, which waits: Ctrl-C reaches that one, whatever it waits for."""

from collections.abc import Callable
from threading import Thread

from gateway.mailbox.spawned import interrupt_later


def in_background(work: Callable[[], object]) -> Thread:
    """Begun, and gone with the command.

    The kernel gives SIGINT to any thread that takes it. Python notes it there and wakes nobody: a main thread that
    waits for a lock without end would not hear of it until somebody frees the lock.
    """
    thread = Thread(target=work, daemon=True)
    with interrupt_later():  # a thread keeps the mask of the one that starts it
        thread.start()
    return thread
