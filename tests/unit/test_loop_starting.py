"""A loop whose buses take their time to open: it shows who it is, and says that it is starting."""

import asyncio
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gateway.control.design import design_lqi, task_of
from gateway.core.controller import canonical
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.messages import Arm, Reply
from gateway.core.topics import LOOP_SHOWN
from gateway.mailbox.keys import private_key
from gateway.mailbox.loop_proof import KEY_FILE, AskShown, LoopShown, Unproven, new_challenge, proven, read_key
from gateway.mailbox.paths import GATEWAY_DATA, LOOP_SOCKET
from gateway.mailbox.port import ANSWERED
from gateway.mailbox.unix import UnixMailbox
from tests.support.gateway_key import as_gateway
from tests.support.ports import free_port
from tests.unit.supervisor_support import child, short_folder

pytestmark = pytest.mark.wires

#: A loop whose buses open once there is the file "open".
LOOP = """
import asyncio, sys
from pathlib import Path
from gateway.core.controller import parse_controller
from gateway.core.line_file import load_line
from gateway.loop import process

folder = Path(sys.argv[1])
build = process.build_links

class Slow:
    def __init__(self, link):
        self._link = link

    def __getattr__(self, name):
        return getattr(self._link, name)

    async def open(self):
        print("opening", flush=True)
        while not (folder / "open").exists():
            await asyncio.sleep(0.01)
        await self._link.open()

process.build_links = lambda line: [Slow(link) for link in build(line)]
line = load_line((folder / "line.toml").read_text(), "line.toml")
config = parse_controller((folder / "controller.json").read_bytes())
say = lambda text: print(text, file=sys.stderr, flush=True)
process.run_loop(line, config, folder, say, folder / "data")
"""


@contextmanager
def starting(key: bytes | None = None) -> Iterator[Path]:
    """The folder of such a loop. `key`: what lies there as its key before."""
    with short_folder() as folder:
        if key is not None:
            (folder / KEY_FILE).touch(0o600)
            (folder / KEY_FILE).write_bytes(key)
        text = line_template(2, "line.toml").replace("port = 43113", f"port = {free_port()}")
        (folder / "line.toml").write_text(text)
        controller = design_lqi(task_of(load_line(text, "line.toml")))
        (folder / "controller.json").write_bytes(canonical(controller))
        with child(LOOP, folder) as (process, said):
            assert said == "opening\n", process.communicate()
            yield folder


async def shown(folder: Path) -> LoopShown:
    """Who the loop shows that it is. Raises what speaks against it."""
    mailbox, challenge = UnixMailbox(), new_challenge()
    mailbox.connect({LOOP_SHOWN}, folder / LOOP_SOCKET)
    try:
        asked = AskShown(challenge=challenge).model_dump_json().encode()
        answer = await mailbox.request(LOOP_SHOWN, asked, 10.0)
        return proven(read_key(folder), challenge, answer, ANSWERED.get())
    finally:
        await mailbox.close()


def test_a_loop_that_opens_its_buses_shows_who_it_is_and_takes_no_command_before_they_are_open() -> None:
    with starting() as folder:
        line = load_line((folder / "line.toml").read_text(), "line.toml")
        private_key(folder / "data" / GATEWAY_DATA)

        def arm() -> Reply:
            return asyncio.run(as_gateway(folder / LOOP_SOCKET, line, folder / "data", Arm()))

        found = asyncio.run(shown(folder))
        assert (found.state, found.phase) == ("SILENT", "SILENT") and found.pid != os.getpid()
        assert [one.code for one in arm().findings] == ["loop-starting"]
        (folder / "open").touch()
        reply = arm()
        while "loop-starting" in {one.code for one in reply.findings}:
            reply = arm()
        assert not reply.ok  # no drive is there
        assert asyncio.run(shown(folder)).start == found.start


@pytest.mark.parametrize("spoil", ["deleted", "damaged", "replaced"])
def test_a_loop_puts_its_key_back_where_somebody_has_spoilt_it(spoil: str) -> None:
    with starting() as folder:
        found, key = asyncio.run(shown(folder)), read_key(folder)
        path = folder / KEY_FILE
        if spoil == "deleted":
            path.unlink()
        else:
            path.write_bytes(b"short" if spoil == "damaged" else b"x" * 32)
        while True:  # each asks once more
            try:
                assert asyncio.run(shown(folder)).start == found.start
            except Unproven:
                continue
            break
        assert read_key(folder) == key


def test_a_loop_starts_over_a_damaged_key() -> None:
    with starting(key=b"short") as folder:
        assert asyncio.run(shown(folder)).state == "SILENT" and len(read_key(folder)) == 32
