"""Audits that are damaged in every file at random, and whether anybody is told: by `verify`, or by opening to write.

Nothing is undetected where one of them speaks, or where what is read is what was stored.
"""

import random
import shutil
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from gateway.core.audit_record import Who
from gateway.storage.sqlite_file import open_there
from gateway.supervisor.audit_anchor import FILE_NAME as ANCHOR
from gateway.supervisor.audit_anchor import read_anchor
from gateway.supervisor.audit_file import FILE_NAME, KIND, AuditFile, AuditUnavailable, Row
from gateway.supervisor.audit_verify import verify
from gateway.supervisor.audit_writer import AuditWriter, Draft

JOURNAL = FILE_NAME + "-journal"
RECORDS = 60
WHO = Who(name="a test", uid=1000, pid=1)


@dataclass
class Damages:
    """What became of damaged audits."""

    tried: int = 0
    undetected: int = 0
    by: Counter[str] = field(default_factory=Counter[str])  #: "file, damage: outcome"
    examples: list[str] = field(default_factory=list)


def make_sound(folder: Path) -> None:
    """An audit that was closed in order."""
    writer = AuditWriter(folder)
    writer.append([])
    for k in range(RECORDS):
        writer.append([_draft(k)])
    writer.close()


def make_interrupted(folder: Path) -> None:
    """An audit as a kill leaves it in the middle of a commit: the pages are half written, the journal is there."""
    working = folder.with_name(folder.name + "-working")
    make_sound(working)
    with AuditFile(working, open_there(working / FILE_NAME, KIND)) as file:
        run = file.connection.execute
        run("PRAGMA cache_size = 1")  # so that pages are written before the commit, and the journal before them
        run("BEGIN IMMEDIATE")
        for k in range(30):
            run("INSERT INTO blob (id, content) VALUES (?, ?)", (f"{k:064d}", bytes([k]) * 3000))
        run("INSERT INTO record (sequence, content, head) VALUES (?, ?, ?)", (RECORDS + 2, b"half", "0" * 64))
        folder.mkdir()
        for name in (FILE_NAME, JOURNAL, ANCHOR):
            shutil.copy(working / name, folder / name)
        run("ROLLBACK")
    assert (folder / JOURNAL).stat().st_size > 4096


def damage_one(sound: Path, scratch: Path, rng: random.Random, damages: Damages) -> None:
    """Damage a copy, and look who notices."""
    shutil.rmtree(scratch, ignore_errors=True)
    shutil.copytree(sound, scratch)
    expected = _acknowledged(sound)
    name = rng.choice([path.name for path in sorted(scratch.iterdir()) if path.stat().st_size])
    how = _harm(scratch / name, rng)
    outcome = _outcome(scratch, expected)
    damages.tried += 1
    damages.by[f"{name}, {how.split(' at ')[0]}: {outcome}"] += 1
    if outcome == "UNDETECTED":
        damages.undetected += 1
        damages.examples.append(f"{name}: {how}")


def _harm(path: Path, rng: random.Random) -> str:
    content = bytearray(path.read_bytes())
    at = rng.randrange(len(content))
    kind = rng.choice(("bit flipped", "bit flipped", "bit flipped", "cut off", "zeroed"))
    if kind == "bit flipped":
        content[at] ^= 1 << rng.randrange(8)
    elif kind == "cut off":
        del content[at:]
    else:
        at -= at % 512
        content[at : at + 512] = bytes(len(content[at : at + 512]))
    path.write_bytes(content)
    return f"{kind} at {at}"


def _outcome(folder: Path, expected: tuple[list[Row], dict[str, bytes]]) -> str:
    if not verify(folder).sound:
        return "verify says so"
    writer = AuditWriter(folder)
    try:
        writer.append([])
    except AuditUnavailable:
        return "opening says so"
    finally:
        writer.close()
    return "nothing has changed" if _acknowledged(folder) == expected else "UNDETECTED"


_READ: dict[Path, tuple[list[Row], dict[str, bytes]]] = {}


def _acknowledged(folder: Path) -> tuple[list[Row], dict[str, bytes]]:
    """Every record that somebody was told is stored, and what it refers to, as it is read."""
    if folder in _READ:
        return _READ[folder]
    last = RECORDS + 1
    with AuditFile(folder) as file:
        rows = [row for row in file.rows() if row.sequence <= last]
        ids = {id_ for row in rows for id_ in row.record().blobs.values()}
        return rows, {id_: file.blob(id_) or b"" for id_ in ids}


def campaign(folder: Path, tries: int, seed: int) -> Damages:
    """Half of the tries on an audit that was closed in order, half on one that was interrupted in a commit."""
    rng, damages = random.Random(seed), Damages()
    for name, make in (("sound", make_sound), ("interrupted", make_interrupted)):
        make(folder / name)
        assert read_anchor(folder / name) is not None
        # Reading rolls the journal back: what was acknowledged is read off a copy.
        shutil.copytree(folder / name, folder / f"{name}-read")
        _READ[folder / name] = _acknowledged(folder / f"{name}-read")
        for _ in range(tries // 2):
            damage_one(folder / name, folder / "damaged", rng, damages)
    return damages


def _draft(k: int) -> Draft:
    """Sizes as they come: some of one page, some of several, one blob for several records."""
    blobs = {"controller": b"%d" % (k // 3) * (40 + 37 * k), "verdict": f"verdict {k}".encode() * 20}
    return Draft("proposed", WHO, {"proposal": f"p-{k}", "gains": [0.1 * k, -1.5, None]}, blobs)
