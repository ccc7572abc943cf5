"""A listening unix socket on a path, for one process at a time: permissions, single instance, stale files.

The lock is the judge of who lives: the kernel drops it with its process, so a socket file without a lock holder is
left over from a dead one and may be replaced. The lock file itself stays (to delete it would race).
"""

import fcntl
import os
import socket
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from gateway.mailbox.who_serves import owners, unsafe_place
from gateway.wording.catalogue import sentence

MAX_PATH = 107  #: bytes of `sun_path` before its closing zero, unix(7)
BACKLOG = 128  #: that may wait to be taken
AT_ONCE = 4  #: that are taken before everybody else in the event loop has a turn


class CannotListen(Exception):
    """The path cannot be listened on; the text says why and what to do."""


class AlreadyRunning(CannotListen):
    """Another living process listens there."""


class PathTooLong(ValueError):
    """A socket path that the kernel has no room for."""


def check_path(path: Path) -> None:
    """Raises PathTooLong."""
    length = len(os.fsencode(path))
    if length > MAX_PATH:
        raise PathTooLong(
            f"the socket path {path} has {length} bytes, a unix socket has room for {MAX_PATH}:"
            " choose a shorter run folder"
        )


def new_socket() -> socket.socket:
    """A non-blocking SOCK_SEQPACKET socket: datagrams with a connection, so that either side sees the other die."""
    return socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)


def living(path: Path) -> bool:
    """Whether somebody listens on `path`. Never blocks."""
    probe = new_socket()
    try:
        probe.connect(os.fspath(path))
    except BlockingIOError:  # its backlog is full: it lives, though it may be stuck
        return True
    except OSError:
        return False
    finally:
        probe.close()
    return True


class Listener:
    """Raises PathTooLong, AlreadyRunning, CannotListen."""

    def __init__(self, path: Path) -> None:
        check_path(path)
        self.path = path
        self.closed = False
        _private_folder(path.parent)
        self._lock = _lock(path)
        try:
            _remove_stale(path)
            self.socket = _bound(path)
        except BaseException:
            os.close(self._lock)
            raise

    def close(self) -> None:
        self.closed = True
        self.socket.close()
        try:
            self.path.unlink(missing_ok=True)
        finally:
            os.close(self._lock)


def _private_folder(folder: Path) -> None:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        unsafe = unsafe_place(folder, owners(folder))
    except OSError as error:
        raise CannotListen(f"the run folder {folder} cannot be made: {error.strerror}") from error
    if unsafe is not None:
        raise CannotListen(sentence(unsafe))


def _lock(path: Path) -> int:
    name = path.with_name(path.name + ".lock")
    try:
        descriptor = os.open(name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise CannotListen(f"the lock {name} cannot be opened: {error.strerror}") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(descriptor, 20, 0).decode("ascii", "replace").strip() or "unknown"
        os.close(descriptor)
        raise AlreadyRunning(f"{path} is served already, by process {holder}") from None
    note_holder(descriptor)
    return descriptor


def note_holder(descriptor: int) -> None:
    """This process's number into the lock that it holds, for whoever is refused. On a full disk the lock holds too."""
    with suppress(OSError):
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)


def _remove_stale(path: Path) -> None:
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise CannotListen(f"{path} exists and is no socket: move it away")
    if living(path):
        raise AlreadyRunning(f"{path} is served already, by a process that holds no lock")
    path.unlink()


def _bound(path: Path) -> socket.socket:
    listening = new_socket()
    try:
        # Linux gives the file the socket's own mode: it is private from its first instant.
        os.fchmod(listening.fileno(), 0o600)
        listening.bind(os.fspath(path))
        listening.listen(BACKLOG)
    except OSError as error:
        listening.close()
        raise CannotListen(f"{path} cannot be listened on: {error.strerror}") from error
    return listening


def accepted_at_once(listening: socket.socket) -> Iterator[socket.socket]:
    """Some of the connections that wait, without blocking; the others with the next wake-up."""
    for _ in range(AT_ONCE):
        try:
            accepted, _ = listening.accept()
        except OSError:  # none left, or the peer has gone, or no descriptor is free: the next wake-up tries again
            return
        accepted.setblocking(False)
        yield accepted
