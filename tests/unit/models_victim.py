"""A program that has children store models and kills them at random instants; run by test_models.

Each of ROUNDS children begins with a copy of the file of an older schema, which it migrates, stores models in it and
marks them. For each one line is printed: the file, then what the child had said was stored and marked.
"""

import os
import random
import shutil
import signal
import sys
import time
from pathlib import Path

from gateway.supervisor.models import begin_repository
from tests.unit.model_support import model

ROUNDS = 30
FIRST_S, LATER_S = 0.05, 0.01  #: at most, after the beginning and after the acknowledgement that is waited for


def store_for_ever(path: Path, told: int) -> None:
    with begin_repository(path) as models:
        os.write(told, b"o")
        while True:
            for k in range(1, 1_000_000):
                entry = models.store(model(2, 1.0 + 1e-5 * k), float(k))
                os.write(told, b"s")
                models.mark(entry.id, "rejected", float(k), "a test")
                os.write(told, b"m")


def round_of(path: Path, acknowledged: int, wait_s: float) -> str:
    """Kill a child `wait_s` after so many acknowledgements. Returns all that it gave: opened, stored, marked, ..."""
    hear, told = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            store_for_ever(path, told)
        finally:
            os._exit(1)
    os.close(told)
    said = bytearray()
    while len(said) < acknowledged:
        said += os.read(hear, 1)
    time.sleep(wait_s)  # the random instant itself
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    while part := os.read(hear, 65536):
        said += part
    os.close(hear)
    return said.decode()


if __name__ == "__main__":
    folder, older, rng = Path(sys.argv[1]), Path(sys.argv[2]), random.Random(int(sys.argv[3]))
    for k in range(ROUNDS):
        path = folder / f"{k}.sqlite"
        if k % 2:
            shutil.copy(older, path)
        acknowledged = rng.randint(1, 12) if k >= ROUNDS // 2 else 0
        wait_s = rng.uniform(0.0, LATER_S if acknowledged else FIRST_S)
        print(path.name, round_of(path, acknowledged, wait_s), flush=True)
