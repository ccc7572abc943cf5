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


def since_when() -> str:
    """The last commit where something is not committed yet, otherwise the one before."""
    told = subprocess.run(["git", "status", "--porcelain"], capture_output=True, text=True, check=True).stdout
    return "HEAD" if told.strip() else "HEAD^"


def ready(since: str) -> bool:
    """Whether none of them failed in as many rounds as there was time for."""
    tests = changed_tests(since)
    if not tests:
        print(f"no test differs from {since}: nothing shows what the change does")
        return True
    began_s = time.monotonic()
    command = [sys.executable, "-m", "pytest", "-m", "not realtime and not long", *SAME_DRAWS, *tests]
    with ExitStack() as undo:
        for _ in range(BUSY):
            busy = undo.enter_context(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
            undo.callback(busy.kill)
        for number in range(1, TIMES + 1):
            left_s = LIMIT_S - (time.monotonic() - began_s)
            print(f"round {number} of {TIMES}: {len(tests)} files beside {BUSY} busy processes", flush=True)
            try:
                code = subprocess.run(command, check=False, timeout=max(left_s, 1.0)).returncode
            except subprocess.TimeoutExpired:
                print(f"after {number - 1} of {TIMES} rounds no time is left")
                break
            if code not in (0, 5):  # 5: every one of them is of real time, or long
                return False
    print("not run: tests that the change does not touch, real time, long ones and the system: `make landing`")
    return True
