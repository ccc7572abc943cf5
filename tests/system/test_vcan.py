"""A line on a real CAN kernel: on the host where its kernel has CAN, otherwise in a guest kernel."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.system.uml import LINKS, GuestFailed, Outcome, run_in_guest

LIMIT_S = 1800.0  #: a boot and three lines; three to five minutes, three times that on a slow machine
FOLDER = Path("out/system/vcan")  #: what it left, for whoever must find out why
TEST = "tests/system/on_vcan.py"


def host_has_vcan() -> bool:
    """Whether the host's own kernel gives us a CAN bus. Leaves nothing behind."""
    if os.geteuid() != 0:
        return False
    if shutil.which("modprobe"):
        subprocess.run(["modprobe", "-a", "vcan", "can_raw"], capture_output=True, check=False)
    made = subprocess.run(["ip", "link", "add", "vcan9", "type", "vcan"], capture_output=True, check=False)
    if made.returncode == 0:
        subprocess.run(["ip", "link", "delete", "vcan9"], check=True)
    return made.returncode == 0


def run(command: list[str], environment: dict[str, str]) -> Outcome:
    if not host_has_vcan():
        return run_in_guest(command, FOLDER, LIMIT_S, environment)
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=LIMIT_S, env=os.environ | environment, check=False
    )
    return Outcome(done.returncode, done.stdout + done.stderr)


@pytest.mark.timeout(LIMIT_S + 60)
def test_a_line_on_a_real_can_kernel() -> None:
    folder = FOLDER.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    # Compiled kernels are kept: a guest takes a minute for them.
    environment = {"PYTHONDONTWRITEBYTECODE": "1", "NUMBA_CACHE_DIR": str(folder / "numba")}
    words = ["-m", "pytest", "-p", "no:cacheprovider", "--durations=0", "--basetemp", str(folder / "tests"), TEST]
    outcome = run([sys.executable, *words], environment)
    print(outcome.output)
    assert outcome.code == 0, outcome.output[-20_000:]


def test_the_guest_hands_back_output_and_exit_code_and_leaves_no_process(tmp_path: Path) -> None:
    outcome = run_in_guest(["sh", "-c", "uname -r; ip -brief link show lo; echo said >&2; exit 7"], tmp_path, 60.0)
    assert outcome.code == 7
    assert "said" in outcome.output and "lo " in outcome.output
    assert not guests()


def test_a_guest_that_hangs_is_ended(tmp_path: Path) -> None:
    with pytest.raises(GuestFailed, match="longer than 8 s"):
        run_in_guest(["sleep", "1000"], tmp_path, 8.0)
    assert not guests()


def guests() -> list[str]:
    """Command lines of processes that belong to a guest of ours."""
    found: list[str] = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:  # it has ended meanwhile
            continue
        if f"/{LINKS}-{os.getpid()}-" in words:
            found.append(words)
    return found
