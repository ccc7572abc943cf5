"""What may block must not be called by gateway or operator in an event loop's own thread: stores, zip, hashes, users.

By thread, not by time: a disk is quick on the machine that tests, and hangs on the one that does not. Stores and the
vocabulary do what they are asked; whoever asks is looked at. What tests and commands call themselves is their own.
"""

import asyncio
import hashlib
import pwd
import sys
import threading
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import apsw

from gateway.core.recording import Recording
from gateway.tasks.threads import SMALL_BYTES

ROOT = Path(__file__).parents[2]
ROOMS = ("gateway/supervisor", "gateway/mailbox", "gateway/operator")
ASKED = (
    "gateway/core", "gateway/storage", "gateway/operator/users.py", "gateway/supervisor/knowledge",
    "tests/support/event_loop_guard.py",
) + tuple(
    f"gateway/supervisor/{name}.py"
    for name in (
        "audit_anchor", "audit_begin", "audit_file", "audit_verify", "audit_writer", "baselines", "blobs", "book_file",
        "configurations", "dating", "experiments", "find_version", "history", "history_recording", "interactions",
        "lifecycle", "model_store", "models", "past_tensions", "retention", "store", "tail", "writer",
    )
)  # fmt: skip

_found: list[str] = []
_guarding = threading.Lock()


class Blocks(AssertionError):
    """The event loop would wait for it."""


def taken() -> list[str]:
    """What was called where it must not be since the last time, and by whom."""
    with _guarding:
        found = list(_found)
        _found.clear()
    return found


def begin() -> None:
    """Once in a process, before what is to be looked at is imported."""
    apsw.connection_hooks.append(_watch)
    hashlib.sha256 = _of_many_bytes(hashlib.sha256, "a hash")  # pyright: ignore[reportAttributeAccessIssue]
    hashlib.scrypt = _checked(hashlib.scrypt, "a password's hash")  # pyright: ignore[reportAttributeAccessIssue]
    zlib.compress = _of_many_bytes(zlib.compress, "zlib")
    zlib.decompressobj = _checked(zlib.decompressobj, "zlib")
    zipfile.ZipFile.__init__ = _checked(zipfile.ZipFile.__init__, "zip")  # pyright: ignore[reportAttributeAccessIssue]
    Recording.digest = _checked(Recording.digest, "a recording's hash")
    pwd.getpwuid = _checked(pwd.getpwuid, "a look-up of users")
    pwd.getpwnam = _checked(pwd.getpwnam, "a look-up of users")


def _watch(connection: apsw.Connection) -> None:
    _check("a store that is opened")
    connection.exec_trace = lambda _, sql, __: _check(f"a store: {sql[:60]}")


def _checked(work: Callable[..., Any], what: str) -> Callable[..., Any]:
    def checked(*arguments: Any, **named: Any) -> Any:
        _check(what)
        return work(*arguments, **named)

    return checked


def _of_many_bytes(work: Callable[..., Any], what: str) -> Callable[..., Any]:
    def checked(content: Any = b"", *arguments: Any, **named: Any) -> Any:
        if len(content) > SMALL_BYTES:
            _check(f"{what} of {len(content)} bytes")
        return work(content, *arguments, **named)

    return checked


def _check(what: str) -> bool:
    """Raises Blocks."""
    if asyncio._get_running_loop() is not None and (who := _caller()):  # noqa: SLF001 # pyright: ignore
        with _guarding:
            _found.append(f"{what}: {who}")
        raise Blocks(_found[-1])
    return True


def _caller() -> str:
    """Who of the gateway's rooms has asked, by file and function; empty: somebody else."""
    frame = sys._getframe(1)  # noqa: SLF001 # pyright: ignore[reportPrivateUsage]
    while frame is not None:
        name = frame.f_code.co_filename
        place = name.removeprefix(f"{ROOT}/")
        if place != name and not place.startswith((".venv", *ASKED)):
            return f"{place}, {frame.f_code.co_name}" if place.startswith(ROOMS) else ""
        frame = frame.f_back
    return ""
