"""One loop and one gateway for a folder of data, also where a second one was given another run folder."""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

from gateway.mailbox.listener import AlreadyRunning, note_holder


class Alone:
    """Held until `close`, or until the process ends."""

    def __init__(self, descriptor: int | None) -> None:
        self._descriptor = descriptor

    def close(self) -> None:
        """Idempotent."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def hold_alone(data_folder: Path, name: str, say: Callable[[str], None]) -> Alone:
    """The lock of this process's kind in the line's data. Raises AlreadyRunning where another process has it.

    A folder in which no lock can be made is told of and held without: the disk's trouble stops no loop.
    """
    path = data_folder / f"{name}.lock"
    try:
        data_folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        say(f"whether a second {name} uses {data_folder} cannot be seen: {path.name}: {error.strerror}")
        return Alone(None)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(descriptor, 20, 0).decode("ascii", "replace").strip() or "unknown"
        os.close(descriptor)
        raise AlreadyRunning(
            f"process {holder} is the {name} of the line whose data lie in {data_folder}: one line has one {name}, "
            "whatever its run folder"
        ) from None
    except OSError as error:  # a file system without locks
        os.close(descriptor)
        say(f"whether a second {name} uses {data_folder} cannot be seen: {path.name}: {error.strerror}")
        return Alone(None)
    note_holder(descriptor)
    return Alone(descriptor)
