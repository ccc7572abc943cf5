"""What only a full collection frees, and what malloc keeps of freed memory, is given back, again and again."""

import gc
import subprocess
import sys
import weakref
from collections.abc import Iterator

import pytest

from gateway.supervisor.memory import EVERY_S, UP_S, GivenBack


class Cycle:
    def __init__(self) -> None:
        self.itself = self


@pytest.fixture(autouse=True)
def collector() -> Iterator[None]:
    gc.collect()
    gc.disable()
    yield
    gc.unfreeze()
    gc.enable()


def test_garbage_does_not_live_long_and_what_stays_is_not_looked_through() -> None:
    now_s = 0.0
    memory = GivenBack(lambda: now_s)
    early = weakref.ref(Cycle())
    memory.look()
    assert early() is not None  # nothing is done while the process starts
    now_s = UP_S
    memory.look()
    assert early() is None and gc.get_freeze_count() > 1000
    late = weakref.ref(Cycle())
    now_s += EVERY_S / 2
    memory.look()
    assert late() is not None
    now_s += EVERY_S / 2
    memory.look()
    assert late() is None


#: Blocks of 50 kB between small ones that stay: what is freed lies in pieces, below the heap's top. A process of its
#: own, whose memory nobody else moves.
IN_PIECES = """
from pathlib import Path
from gateway.supervisor.memory import EVERY_S, UP_S, GivenBack

def anonymous_kb():
    rows = Path("/proc/self/status").read_text().splitlines()
    return next(int(row.split()[1]) for row in rows if row.startswith("RssAnon:"))

times = iter([0.0, UP_S, UP_S + EVERY_S])
memory = GivenBack(lambda: next(times))
memory.look()
large, small = [], []
for _ in range(1000):
    large.append(bytes(50_000))
    small.append(bytes(2_000))
large.clear()
before = anonymous_kb()
memory.look()
print(before - anonymous_kb())
"""


def test_what_is_free_in_pieces_goes_back_to_the_kernel() -> None:
    ran = subprocess.run([sys.executable, "-c", IN_PIECES], capture_output=True, text=True, check=True)
    assert int(ran.stdout) > 30_000, ran.stdout  # of 49,000 kB, in whole pages


#: A process of its own: what SQLite holds is told of all connections together.
RECORDED = """
import sys
from pathlib import Path

import apsw

from gateway.core.audit_record import Who
from gateway.supervisor.audit_writer import AuditWriter, Draft

writer, held = AuditWriter(Path(sys.argv[1])), []
for _ in range(2):
    for number in range(400):
        writer.append([Draft("alarm", Who(name="gateway"), {"because": "x" * 600, "number": number})])
    held.append(apsw.memory_used())
writer.close()
print(held[1] - held[0])
"""


def test_what_was_recorded_does_not_stay_in_memory(tmp_path) -> None:
    ran = subprocess.run([sys.executable, "-c", RECORDED, tmp_path], capture_output=True, text=True, check=True)
    assert int(ran.stdout) < 10_000, ran.stdout  # 400 records are 440 kB
