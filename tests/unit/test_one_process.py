"""One process of a kind for a line: what holds the lock is the process, not what is written into it."""

from pathlib import Path

import pytest

from gateway.mailbox.listener import AlreadyRunning, Listener
from gateway.mailbox.one_process import hold_alone
from tests.unit.supervisor_support import child, short_folder

pytestmark = pytest.mark.wires

#: Holds both locks where not one byte can be written, as on a full disk.
ON_A_FULL_DISK = """
import resource, sys, time
from pathlib import Path
from gateway.mailbox.listener import Listener
from gateway.mailbox.one_process import hold_alone

resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
folder, said = Path(sys.argv[1]), []
listener = Listener(folder / "loop.sock")
alone = hold_alone(folder / "data", "loop", said.append)
print("holds", said, flush=True)
time.sleep(3600)
"""


def test_a_full_disk_keeps_no_loop_from_starting_and_lets_in_no_second_one() -> None:
    with short_folder() as folder, child(ON_A_FULL_DISK, folder) as (process, said):
        assert said == "holds []\n", process.communicate()
        refuse_a_second(folder)


def refuse_a_second(folder: Path) -> None:
    with pytest.raises(AlreadyRunning, match="is served already, by process unknown"):
        Listener(folder / "loop.sock")
    with pytest.raises(AlreadyRunning, match="process unknown is the loop of the line"):
        hold_alone(folder / "data", "loop", print)
