"""Files where somebody else may have put something: read as a regular file, whole, within a bound; made anew, whole.

A folder can hold anything under a good name: a directory, a pipe that nobody writes to, a device that never ends, a
link to nowhere, a disk's worth of zeros. Each is an OSError here whose `strerror` says so in words, so that whoever
handles a file that cannot be opened handles these too.
"""

import errno
import os
import stat
import sys
from contextlib import suppress
from pathlib import Path

MOST_BYTES = 64 * 2**20  #: of a file that has no smaller bound of its own

#: Error numbers of what lies under a file's name and is none: a folder, a pipe, a link to nowhere, too much. Waiting
#: does not help, as it may where a disk is away or a right is missing.
NO_FILE = frozenset((errno.EISDIR, errno.EINVAL, errno.ENOLINK, errno.ELOOP, errno.EFBIG))

_KINDS = (
    (stat.S_ISDIR, errno.EISDIR, os.strerror(errno.EISDIR)),
    (stat.S_ISFIFO, errno.EINVAL, "is a pipe, not a file"),
    (stat.S_ISSOCK, errno.EINVAL, "is a socket, not a file"),
    (stat.S_ISCHR, errno.EINVAL, "is a device, not a file"),
    (stat.S_ISBLK, errno.EINVAL, "is a device, not a file"),
)


class NotText(ValueError):
    """A file holds no text; the words say where, and what to do."""

    def __init__(self, line: int) -> None:
        super().__init__(f"line {line} is not UTF-8: save the file as UTF-8")
        self.line = line  #: 1-based


def read_bytes(path: Path, most_bytes: int) -> bytes:
    """All of the regular file at `path`, which may be a link to one.

    Raises FileNotFoundError only where nothing of that name is there; OSError for all else that is no regular file,
    may not be read or has more than `most_bytes`.
    """
    content = _read(path, most_bytes + 1, most_bytes)
    if len(content) > most_bytes:  # it grows, or lies about its size as /proc does
        raise _too_large(path, most_bytes)
    return content


def read_beginning(path: Path, bytes_: int) -> bytes:
    """The first `bytes_` of the regular file at `path`, all of it where it has fewer. Raises as `read_bytes`."""
    return _read(path, bytes_, sys.maxsize)


def _read(path: Path, bytes_: int, most_bytes: int) -> bytes:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        if path.is_symlink():
            raise OSError(errno.ENOLINK, "is a link to what is not there", str(path)) from None
        raise
    except ValueError as error:  # a null character in the name
        raise OSError(errno.EINVAL, "has a name that no file can have", str(path)) from error
    except OSError as error:
        if error.errno == errno.ENXIO:
            raise OSError(errno.EINVAL, "is a socket, not a file", str(path)) from None
        raise
    try:
        _require_regular(os.fstat(descriptor), path, most_bytes)
        with os.fdopen(descriptor, "rb", closefd=False) as stream:
            return stream.read(bytes_)
    finally:
        os.close(descriptor)


def read_text(path: Path, most_bytes: int) -> str:
    """As `read_bytes`, decoded from UTF-8, without a byte order mark. Raises OSError, NotText."""
    content = read_bytes(path, most_bytes)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise NotText(content.count(b"\n", 0, error.start) + 1) from None


def written_beside(path: Path, content: bytes, mode: int) -> Path:
    """A new file beside `path`, to take its place: on the disk when this returns, whatever was there under its name.

    Raises OSError; nothing is left behind then.
    """
    beside = path.with_name(f"{path.name}.{os.getpid()}.part")
    beside.unlink(missing_ok=True)
    descriptor = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode & 0o600)
    try:
        with os.fdopen(descriptor, "wb") as stream:
            os.fchmod(descriptor, mode)
            stream.write(content)
            stream.flush()
            os.fsync(descriptor)
    except BaseException:
        with suppress(OSError):
            beside.unlink()
        raise
    return beside


def what_is_there(path: Path) -> str:
    """Why what lies at `path` is no file, in words that follow its name; "" for a file, and for nothing."""
    if not os.path.lexists(path):
        return ""
    try:
        _require_regular(path.stat(), path, sys.maxsize)
    except FileNotFoundError:
        return "is a link to what is not there"
    except OSError as error:
        if error.errno == errno.ENOTDIR:  # what should be a folder above it is told by whoever opens it
            return ""
        words = {errno.EISDIR: "is a folder, not a file", errno.ELOOP: "is a link that leads nowhere"}
        return words.get(error.errno or 0, str(error.strerror)) if error.errno in NO_FILE else ""
    return ""


def _require_regular(status: os.stat_result, path: Path, most_bytes: int) -> None:
    for is_kind, number, words in _KINDS:
        if is_kind(status.st_mode):
            raise OSError(number, words, str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "is not a regular file", str(path))
    if status.st_size > most_bytes:
        raise _too_large(path, most_bytes)


def _too_large(path: Path, most_bytes: int) -> OSError:
    return OSError(errno.EFBIG, f"has more than {most_bytes} bytes", str(path))
