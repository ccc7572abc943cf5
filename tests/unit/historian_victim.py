"""A program that has children store history and kills them at random instants; run by test_historian_faults.

For each of ROUNDS children it prints the largest number of frames that the child had said were stored.
"""

import os
import random
import select
import signal
import struct
import sys
import time
from pathlib import Path

from gateway.supervisor import historian as module
from gateway.supervisor.historian import Historian
from tests.unit.supervisor_support import frame_of

ROUNDS = 20
ROUND_S = 100.0  # of frame time between two children
COUNT = struct.Struct("<Q")


def store_for_ever(folder: Path, number: int, told: int) -> None:
    module.FLUSH_S = 0.002
    module.BLOB_S = 0.05  # so that gathering, too, is hit by kills
    historian = Historian(folder, "site", "line", 6)
    historian.start()
    sequence = stored = 0
    while True:
        for _ in range(5):
            historian.frame(frame_of(sequence, number * ROUND_S + sequence * 0.001))
            sequence += 1
        if historian.health().frames_stored != stored:
            stored = historian.health().frames_stored
            os.write(told, COUNT.pack(stored))
        time.sleep(0.0005)


def round_of(folder: Path, number: int, wait_s: float) -> int:
    hear, told = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            store_for_ever(folder, number, told)
        finally:
            os._exit(1)
    os.close(told)
    select.select([hear], [], [], 10.0)  # the first acknowledgement; then a random while
    time.sleep(wait_s)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    said = bytearray()
    while part := os.read(hear, 65536):
        said += part
    os.close(hear)
    return COUNT.unpack_from(said, len(said) - COUNT.size)[0]


if __name__ == "__main__":
    rng = random.Random(int(sys.argv[2]))
    for k in range(ROUNDS):
        print(round_of(Path(sys.argv[1]), k, rng.uniform(0.0, 0.15)), flush=True)
