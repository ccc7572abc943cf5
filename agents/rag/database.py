"""SQLite as it is used here: through apsw, which can load sqlite-vec whatever this Python was built with."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol, cast

import apsw
import sqlite_vec  # pyright: ignore[reportMissingTypeStubs]

DatabaseError = apsw.Error


class Database(Protocol):
    """What of a connection is used; the types that apsw itself gives are partly unknown."""

    def execute(self, statements: str, bindings: Sequence[Any] | None = None) -> Any: ...

    def executemany(self, statements: str, sequenceofbindings: Iterable[Sequence[Any]]) -> Any: ...

    def close(self) -> None: ...


def created(path: Path) -> Database:
    """A new file. Raises DatabaseError."""
    return _with_vectors(apsw.Connection(os.fspath(path)))


def opened_for_reading(path: Path) -> Database:
    """Raises DatabaseError."""
    return _with_vectors(apsw.Connection(os.fspath(path), flags=apsw.SQLITE_OPEN_READONLY))


def _with_vectors(connection: apsw.Connection) -> Database:
    connection.enable_load_extension(True)
    connection.load_extension(sqlite_vec.loadable_path())
    connection.enable_load_extension(False)
    return cast(Database, connection)
