"""What can lie under the name of a file that a program looks for: each kind of file that is none, made at a path."""

import os
import socket
from collections.abc import Callable
from pathlib import Path

HUGE_BYTES = 8 * 2**30  #: sparse: it takes nothing of the disk


def _socket(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # a socket's path has at most 107 bytes
    try:
        with socket.socket(socket.AF_UNIX) as one:
            one.bind(path.name)
    finally:
        os.chdir(here)


def _huge(path: Path) -> None:
    with path.open("wb") as stream:
        stream.truncate(HUGE_BYTES)


#: Each makes what its name says at a path where nothing is yet. A link to itself stands for what may not be read: it
#: is so for root, too.
BAD_FILES: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.touch(),
    "not UTF-8": lambda path: path.write_bytes(b"\xff\xfe\x00name\x00"),
    "half written": lambda path: path.write_bytes(b'{"format": 1, "users": [{"name": "a'),
    "of the wrong type": lambda path: path.write_bytes(b"[1, 2, 3]\n"),
    "nested deeply": lambda path: path.write_bytes(b"a = " + 100_000 * b"["),
    "nested deeply as JSON": lambda path: path.write_bytes(100_000 * b'{"a":'),
    "a number of many digits": lambda path: path.write_bytes(b"format = " + 10_000 * b"9"),
    "zeros": lambda path: path.write_bytes(4096 * b"\0"),
    "a folder": lambda path: path.mkdir(),
    "a pipe": lambda path: os.mkfifo(path),
    "a socket": _socket,
    "a link to nowhere": lambda path: path.symlink_to("nowhere"),
    "a link to itself": lambda path: path.symlink_to(path.name),
    "a link to a device": lambda path: path.symlink_to("/dev/zero"),
    "huge": _huge,
}


def put(path: Path, kind: str) -> None:
    """What `kind` says, at `path`, in place of what was there."""
    if path.is_symlink() or path.exists():
        path.unlink()
    BAD_FILES[kind](path)
