"""Which stored version a person means: "newest", a number ("3" or "v3"), or the beginning of an id."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, TypeVar

LEAST_PREFIX = 6  #: letters of an id that may stand for it
LISTED = 12  #: versions that a refusal names one by one


class Version(Protocol):
    """Something that was stored as a version of a line's."""

    @property
    def id(self) -> str: ...
    @property
    def site(self) -> str: ...
    @property
    def line(self) -> str: ...
    @property
    def version(self) -> int: ...


V = TypeVar("V", bound=Version)


def find_version(
    wanted: str, found: Sequence[V], noun: str, path: Path, error: type[Exception], also: str = "or a file"
) -> V:
    """The one of `found`, of which there is at least one. Raises `error` with what is there."""
    by_id = [one for one in found if len(wanted) >= LEAST_PREFIX and one.id.startswith(wanted.lower())]
    by_version = _by_version(wanted, found)
    lines = sorted({f"{one.site}/{one.line}" for one in found})
    if by_version and len(lines) == 1:
        return by_version[0]
    if len(by_id) == 1:
        return by_id[0]
    if by_version:
        raise error(f"{path} has {noun}s of {', '.join(lines)}: name the line with --line, or an id")
    if by_id:
        named = ", ".join(f"{one.id[:16]} (version {one.version})" for one in by_id)
        raise error(f"{wanted} is the beginning of several {noun}s: {named}; give more of it")
    versions = [str(one.version) for one in found]
    listed = ", ".join(versions if len(versions) <= LISTED else [*versions[:3], "...", versions[-1]])
    raise error(
        f"{path} has no {noun} {wanted}; allowed: a version ({listed}), at least {LEAST_PREFIX} letters of an id, "
        f"newest, {also}"
    )


def _by_version(wanted: str, found: Sequence[V]) -> list[V]:
    """Those whose version is wanted, one for each line."""
    if wanted == "newest":
        newest = {(one.site, one.line): one for one in found}
        return list(newest.values())
    number = wanted.removeprefix("v")
    return [one for one in found if number.isdecimal() and one.version == int(number)]
