"""Whether a change will land, in ten minutes: `make ready`. What is new in the tests runs ten times on a busy machine.

`make ready` runs `make check` and `make test-fast` before it. The rest is left to `make landing`, and named.
"""

import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

from tests.landing.stages import SAME_DRAWS

TIMES, BUSY = 10, 4
LIMIT_S = 240.0  #: of all rounds together


def changed_tests(since: str) -> list[str]:
    """Test modules that differ from `since` (a commit) or are new, those of the system stage left out."""
    told: set[str] = set()
    for command in (["git", "diff", "--name-only", since], ["git", "ls-files", "--others", "--exclude-standard"]):
        told |= set(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines())
    return sorted(
        name for name in told
        if Path(name).name.startswith("test_") and name.startswith("tests/") and Path(name).exists()
        and not name.startswith("tests/system/")
    )  # fmt: skip


def ready(since: str) -> bool:
    """Whether none of them failed in as many rounds as there was time for."""
    tests = changed_tests(since)
    if not tests:
        print(f"no test differs from {since}")
        return True
    began_s = time.monotonic()
    with ExitStack() as undo:
        for _ in range(BUSY):
            busy = undo.enter_context(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
            undo.callback(busy.kill)
        for number in range(1, TIMES + 1):
            took_s = time.monotonic() - began_s
            if took_s > LIMIT_S:
                print(f"after {number - 1} of {TIMES} rounds no time is left")
                break
            print(f"round {number} of {TIMES}: {len(tests)} files beside {BUSY} busy processes", flush=True)
            if subprocess.run([sys.executable, "-m", "pytest", *SAME_DRAWS, *tests], check=False).returncode:
                return False
    print("not run: tests that the change does not touch, real time, long ones and the system: `make landing`")
    return True
