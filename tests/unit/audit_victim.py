"""Children that write an audit and are killed at random instants; what each was told, to be held against the files."""

import asyncio
import json
import os
import random
import shutil
import signal
import struct
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from gateway.core.audit_record import Who
from gateway.supervisor.audit import Audit
from gateway.supervisor.audit_anchor import Anchor
from gateway.supervisor.audit_file import AuditFile
from gateway.supervisor.audit_verify import verify
from gateway.supervisor.audit_writer import NOT_DONE

TASKS = 4  #: that append at the same time, so that commits of several are hit too
FIRST_S, LATER_S = 0.03, 0.012  #: at most: after the fork, after the acknowledgement that is waited for
SAME_FOLDER = 25  #: kills until a folder is begun anew, so that beginnings are hit too
TOLD = struct.Struct("<Q64s")


def append_for_ever(folder: Path, told: int) -> None:
    """Say on `told` what was said to be stored, as soon as it was said."""
    audit = Audit(folder)
    audit.start()

    async def one(task: int) -> None:
        for k in range(1_000_000):
            # Some are large enough for several pages, and some blobs come twice.
            blobs = {"verdict": bytes([k % 7]) * (200 if task else 9000)}
            at = await audit.append("proposed", Who(name=f"task-{task}", pid=os.getpid()), {"k": k}, blobs)
            os.write(told, TOLD.pack(at.sequence, at.head.encode()))

    async def all_() -> None:
        await asyncio.gather(*map(one, range(TASKS)))

    asyncio.run(all_())


def killed(folder: Path, acknowledged: int, wait_s: float) -> list[Anchor]:
    """Kill a child `wait_s` after so many acknowledgements. Returns all that it was told."""
    hear, told = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            os.close(hear)
            append_for_ever(folder, told)
        finally:
            os._exit(1)
    os.close(told)
    said = bytearray()
    while len(said) < acknowledged * TOLD.size and (part := os.read(hear, TOLD.size)):
        said += part
    time.sleep(wait_s)  # the random instant itself
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    while part := os.read(hear, 65536):
        said += part
    os.close(hear)
    whole = len(said) // TOLD.size * TOLD.size
    return [Anchor(sequence, head.decode()) for sequence, head in TOLD.iter_unpack(said[:whole])]


@dataclass
class Tally:
    kills: int = 0
    told: int = 0  #: records that were said to be stored
    lost: int = 0  #: of these, not there or another one in their place
    denied: int = 0  #: of these, called not done
    unsound: int = 0  #: kills after which the chain does not verify
    unnamed: int = 0  #: records beyond the anchor at a kill that are not called not done afterwards
    interrupted: int = 0  #: kills between commit and anchor
    problems: str = ""


def campaign(folder: Path, kills: int, seed: int) -> Tally:
    rng, tally, told, owed = random.Random(seed), Tally(), dict[int, str](), set[int]()
    for k in range(kills):
        if k % SAME_FOLDER == 0:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            told.clear()
            owed.clear()
        acknowledged = rng.choice((0, rng.randint(1, 12)))
        new = killed(folder, acknowledged, rng.uniform(0.0, LATER_S if acknowledged else FIRST_S))
        told |= {at.sequence: at.head for at in new}
        tally.kills += 1
        tally.told += len(new)
        if (folder / "audit.anchor").exists() and (folder / "audit.sqlite").exists():
            _judge(folder, told, owed, tally)
        else:  # nothing can have been said
            tally.lost += len(told)
    return tally


def _judge(folder: Path, told: dict[int, str], owed: set[int], tally: Tally) -> None:
    found = verify(folder)
    if found.anchor is not None and found.anchor.sequence == 0 and not told:
        return  # killed while it was begun: there is nothing yet
    if not found.sound:
        tally.unsound += 1
        tally.problems = tally.problems or "; ".join(found.problems)
    tally.interrupted += found.beyond_anchor > 0
    with AuditFile(folder) as file:
        rows = list(file.rows())
    anchored = found.anchor.sequence if found.anchor else 0
    heads = {row.sequence: row.head for row in rows}
    notes = [row for row in rows if row.record().kind == NOT_DONE]
    denied = {n for row in notes for n in row.record().what["sequences"]}
    # The next child opens, or is killed before it has: what is anchored by then must be named.
    tally.unnamed += len({n for n in owed if n <= anchored} - denied)
    owed -= {n for n in owed if n <= anchored}
    owed |= {row.sequence for row in rows if row.sequence > anchored} - {row.sequence for row in notes}
    tally.lost += sum(heads.get(sequence) != head for sequence, head in told.items())
    tally.denied += len(denied & told.keys())


if __name__ == "__main__":
    print(json.dumps(asdict(campaign(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])))))
