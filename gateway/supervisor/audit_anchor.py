"""The anchor of the audit: the number and the head of its last record, in a file of its own beside the database.

A database that lost its tail is a sound, shorter database: nothing in it tells. The anchor does. It is written after
each commit and before anybody is told that the record is stored, whole or not at all, so that it is never ahead of what
was stored: a database that does not reach the anchor has lost something; one that goes beyond it was interrupted
between the commit and the anchor, and whoever waited for those records was told nothing.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path

from gateway.core.audit_record import BEFORE_FIRST, canonical_json, head_of
from gateway.files import NO_FILE, read_bytes

FILE_NAME = "audit.anchor"
MOST_BYTES = 4096


class AnchorDamaged(Exception):
    """Its content is not what was written."""


@dataclass(frozen=True)
class Anchor:
    sequence: int  #: 0: nothing is stored yet
    head: str


NOTHING_YET = Anchor(0, BEFORE_FIRST)


def encode(anchor: Anchor) -> bytes:
    fields = {"format": 1, "head": anchor.head, "sequence": anchor.sequence}
    return canonical_json({**fields, "check": head_of(canonical_json(fields))}) + b"\n"


def read_anchor(folder: Path) -> Anchor | None:
    """None: there is none. Raises AnchorDamaged and OSError."""
    try:
        content = read_bytes(folder / FILE_NAME, MOST_BYTES)
    except FileNotFoundError:
        return None
    except OSError as error:
        if error.errno in NO_FILE:
            raise AnchorDamaged(
                f"{folder / FILE_NAME} is damaged: {error.strerror}, which was never written"
            ) from error
        raise
    try:
        fields = json.loads(content)
        anchor = Anchor(fields["sequence"], fields["head"])
    except (ValueError, KeyError, TypeError, RecursionError):
        anchor = None
    if anchor is None or encode(anchor) != content:
        raise AnchorDamaged(f"{folder / FILE_NAME} is damaged: its content is not what was written")
    return anchor


def write_anchor(folder: Path, anchor: Anchor) -> None:
    """On the disk when this returns; until then the one before is. Raises OSError."""
    path = folder / FILE_NAME
    part = path.with_name(FILE_NAME + ".part")
    with part.open("wb") as stream:
        stream.write(encode(anchor))
        stream.flush()
        os.fsync(stream.fileno())
    part.replace(path)
    sync_folder(folder)


def sync_folder(folder: Path) -> None:
    """What was renamed, made or removed in it is on the disk when this returns."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
