"""Files that are edited, exchanged or put back while the loop is gone; an audit made anew. Points 11, 12 and 16.

What must be so of a loop that is started on them: it runs what was kept, or what the records do not explain no further
than a first configuration; that is told, and not armed.
"""

import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gateway.mailbox.paths import LOOP_DATA
from tests.bench.intrusions_families import Attempt, Family, Site

KEPT, BEFORE, GIVEN = "configuration.json", "configuration-before.json", "started-with.json"
PROOF, CELLS = "wiring-proof.json", "contradicted-cells.json"
GAINS = ("gain_state", "gain_integral", "gain_input", "gain_proportional")

Spoil = Callable[[random.Random, Path, Path], None]  #: dice, the line's folder, an older copy of its data


def _scaled(controller: dict[str, Any], factor: float) -> dict[str, Any]:
    found = dict(controller)
    for name in GAINS:
        if name in found:
            found[name] = [[factor * one for one in row] for row in found[name]]
    return found


def _edited(path: Path, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


def kept_gains(rng: random.Random, folder: Path, older: Path) -> None:
    factor = rng.choice([-3.0, -1.0, 10.0, 1.05, 0.0])
    _edited(
        folder / "data" / LOOP_DATA / KEPT, lambda kept: {**kept, "controller": _scaled(kept["controller"], factor)}
    )


def kept_region(rng: random.Random, folder: Path, older: Path) -> None:
    region = rng.choice([{}, {"speed_max_m_per_s": 0.1}, {"tension_step_max_n": 1e308}])
    _edited(folder / "data" / LOOP_DATA / KEPT, lambda kept: {**kept, "region": region})


def kept_epoch(rng: random.Random, folder: Path, older: Path) -> None:
    epoch = rng.choice([0, 2, 2**31, 2**63])
    _edited(folder / "data" / LOOP_DATA / KEPT, lambda kept: {**kept, "epoch": epoch})


def kept_proof(rng: random.Random, folder: Path, older: Path) -> None:
    def strange(kept: dict[str, Any]) -> dict[str, Any]:
        proof = kept.get("proof")
        if proof is None or rng.random() < 0.5:
            return {**kept, "proof": None, "controller": _scaled(kept["controller"], -1.0)}
        return {**kept, "proof": {**proof, "signature": "0" * 128}}

    _edited(folder / "data" / LOOP_DATA / KEPT, strange)


def kept_back(rng: random.Random, folder: Path, older: Path) -> None:
    """As it was before what is in service was kept."""
    shutil.copy(older / KEPT, folder / "data" / LOOP_DATA / KEPT)


def kept_gone(rng: random.Random, folder: Path, older: Path) -> None:
    for name in rng.choice([(KEPT,), (KEPT, BEFORE), (KEPT, BEFORE, GIVEN)]):
        (folder / "data" / LOOP_DATA / name).unlink(missing_ok=True)


def kept_garbage(rng: random.Random, folder: Path, older: Path) -> None:
    path = folder / "data" / LOOP_DATA / KEPT
    content = path.read_bytes()
    path.write_bytes(
        rng.choice([b"", b"{}", content[: rng.randrange(len(content))], rng.randbytes(500), b"[" * 10_000])
    )


def first_gains(rng: random.Random, folder: Path, older: Path) -> None:
    """Another controller than before is given to the loop, edited by hand."""
    factor = rng.choice([-3.0, -1.0, 10.0])
    _edited(folder / "controller.json", lambda given: _scaled(given, factor))


def first_values(rng: random.Random, folder: Path, older: Path) -> None:
    def edge(given: dict[str, Any]) -> dict[str, Any]:
        feedforward = dict(given["feedforward"])
        feedforward["stiffness_n"] = rng.choice([1e-9, 1e9, 5e-324])
        return {**given, "feedforward": feedforward}

    _edited(folder / "controller.json", edge)


def proof_hash(rng: random.Random, folder: Path, older: Path) -> None:
    """Of another wiring."""
    _edited(folder / "data" / LOOP_DATA / PROOF, lambda proof: {**proof, "wiring": f"{rng.randrange(2**256):064x}"})


def proof_unknown(rng: random.Random, folder: Path, older: Path) -> None:
    """Of this very wiring, and no record has it: an older one, or one that was edited."""
    _edited(
        folder / "data" / LOOP_DATA / PROOF, lambda proof: {**proof, "wall_s": proof["wall_s"] + rng.randint(1, 10**6)}
    )


def cells_garbage(rng: random.Random, folder: Path, older: Path) -> None:
    content = rng.choice([b"", b"{", b"[]", b'{"x": 1}', rng.randbytes(500), b"[" * 10_000])
    (folder / "data" / LOOP_DATA / CELLS).write_bytes(content)


def cells_emptied(rng: random.Random, folder: Path, older: Path) -> None:
    """No load cell is contradicted, which is so here."""
    (folder / "data" / LOOP_DATA / CELLS).write_bytes(b"{}")


WIRING: dict[str, Spoil] = {
    "proof: of another wiring": proof_hash, "proof: one that no record knows": proof_unknown,
    "cells: no JSON": cells_garbage, "cells: emptied": cells_emptied,
}  # fmt: skip
NOT_STARTED = ("proof: of another wiring", "cells: no JSON")  #: what the loop itself refuses to start on
SPOILS: dict[str, Spoil] = {
    "kept: gains": kept_gains, "kept: region": kept_region, "kept: epoch": kept_epoch, "kept: proof": kept_proof,
    "kept: put back": kept_back, "kept: gone": kept_gone, "kept: garbage": kept_garbage,
    "first: gains": first_gains, "first: feed-forward": first_values,
}  # fmt: skip
SPOILS_OF_ALL = SPOILS | WIRING
HARMLESS = ("kept: garbage", "kept: gone")  #: where the records may explain what runs then


def files(rng: random.Random, site: Site) -> Attempt:
    name = rng.choice(sorted(SPOILS))
    return Attempt(name, [{"seed": rng.randrange(2**31)}], spoils=name, of_kept=True)


def wiring(rng: random.Random, site: Site) -> Attempt:
    name = rng.choice(sorted(WIRING))
    return Attempt(name, [{"seed": rng.randrange(2**31)}], spoils=name)


REWRITES = ("a record changed", "a record left out", "the end cut off", "all made anew")


def audit(rng: random.Random, site: Site) -> Attempt:
    name = rng.choice(REWRITES)
    return Attempt(f"audit: {name}", [{"seed": rng.randrange(2**31)}], rewrites=name, of_kept=True)


def rewrite(rng: random.Random, name: str, folder: Path, out: Path) -> None:
    """An audit in `out`, as that in `folder` but for what is rewritten: chain and anchor of one piece."""
    from gateway.supervisor.audit_file import AuditFile
    from gateway.supervisor.audit_writer import AuditWriter, Draft

    with AuditFile(folder) as file:
        drafts = [Draft(one.kind, one.who, one.what) for one in (row.record() for row in file.rows())]
    k = rng.randrange(1, len(drafts))
    if name == "a record changed":
        drafts[k] = Draft(drafts[k].kind, drafts[k].who, {**drafts[k].what, "because": "it was so from the beginning"})
    elif name == "a record left out":
        del drafts[k]
    elif name == "the end cut off":
        del drafts[k:]
    out.mkdir()
    writer = AuditWriter(out)
    for draft in drafts[1:]:  # the first is the writer's own
        writer.append([draft])
    writer.close()


FAMILIES = (Family("files", 12, files, 1), Family("wiring", 12, wiring, 1), Family("audit", 16, audit, 1))
