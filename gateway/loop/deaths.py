"""How often an exception has ended a loop, in a row, and under which configuration: so that no start repeats it.

Counted are ends that this process itself has seen, under a configuration that was kept. One on probation is gone with
the process anyway; a kill from outside says nothing of a configuration.
"""

import os
from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationError

from gateway.core.deployment import Hash
from gateway.core.json_problems import problems
from gateway.core.line import Strict
from gateway.files import read_bytes

DEATHS = "deaths.json"
MOST_DEATHS = 2  #: in a row, until a configuration is set aside
MOST_BYTES = 1_000_000  #: of the file
LONGEST_REASON = 500  #: characters


class _Counted(Strict):
    format: Annotated[int, Field(ge=1, le=1)] = 1
    counts: dict[Hash, Annotated[int, Field(ge=1)]]  #: by `kept.fingerprint`
    last_reason: str = ""


class Deaths:
    """The counts in one file. One that cannot be read counts nothing: a start must not depend on it."""

    most = MOST_DEATHS

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def last_reason(self) -> str:
        """What the last one died of."""
        return self._read().last_reason

    def why_unreadable(self) -> str:
        """Why nothing is counted of what the file says; "": it is read, or not there."""
        try:
            _Counted.model_validate_json(read_bytes(self.path, MOST_BYTES))
        except FileNotFoundError:
            return ""
        except OSError as error:
            return f"cannot be read: {error.strerror}"
        except ValidationError as error:
            return f"is not used: {problems(error, _Counted)[0]}"
        return ""

    def too_often(self, fingerprint: str) -> bool:
        """Whether what has this fingerprint has ended the loop `MOST_DEATHS` times without one good end in between."""
        return self._read().counts.get(fingerprint, 0) >= MOST_DEATHS

    def count(self, fingerprint: str, reason: str) -> None:
        """One more. Raises OSError."""
        counted = self._read()
        counts = {**counted.counts, fingerprint: counted.counts.get(fingerprint, 0) + 1}
        self._write(_Counted(counts=counts, last_reason=reason[:LONGEST_REASON]))

    def forgive(self, fingerprint: str) -> None:
        """It has run the line and come to an orderly end. Raises OSError."""
        counted = self._read()
        if fingerprint in counted.counts:
            counts = {one: count for one, count in counted.counts.items() if one != fingerprint}
            self._write(_Counted(counts=counts, last_reason=counted.last_reason))

    def _read(self) -> _Counted:
        try:
            return _Counted.model_validate_json(read_bytes(self.path, MOST_BYTES))
        except (OSError, ValidationError):
            return _Counted(counts={})

    def _write(self, counted: _Counted) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        beside = self.path.with_name(self.path.name + ".part")
        with beside.open("wb") as file:
            file.write(counted.model_dump_json().encode())
            file.flush()
            os.fsync(file.fileno())
        beside.replace(self.path)
