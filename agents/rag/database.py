"""SQLite as it is used here: through apsw, which can load sqlite-vec whatever this Python was built with."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol, cast

import apsw
import sqlite_vec  # pyright: ignore[reportMissingTypeStubs]

from gateway.storage.sqlite_file import FileKind, begin, open_to_read

DatabaseError = apsw.Error


class Database(Protocol):
    """What of a connection is used; the types that apsw itself gives are partly unknown."""

    def execute(self, statements: str, bindings: Sequence[Any] | None = None) -> Any: ...

    def executemany(self, statements: str, sequenceofbindings: Iterable[Sequence[Any]]) -> Any: ...

    def close(self) -> None: ...


def begin_database(path: Path, kind: FileKind) -> Database:
    """A new file. Raises `kind.error`."""
    return _with_vectors(begin(path, kind))


def open_database(path: Path, kind: FileKind) -> Database:
    """For reading. Raises `kind.error`."""
    return _with_vectors(open_to_read(path, kind))


def _with_vectors(connection: apsw.Connection) -> Database:
    connection.enable_load_extension(True)
    connection.load_extension(sqlite_vec.loadable_path())
    connection.enable_load_extension(False)
    return cast(Database, connection)
