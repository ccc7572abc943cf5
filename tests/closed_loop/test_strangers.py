"""Strangers of the line's own user beside a real line: a flood of proposals, and a process that took the loop's socket.

The recorder in the simulated line judges whether the line has stopped.
"""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gateway.control.design import design_lqg, task_of
from gateway.core.controller import canonical
from gateway.core.messages import Stop
from gateway.mailbox.paths import GATEWAY_SOCKET, LOOP_SOCKET
from tests.closed_loop.gate_line import GateLine
from tests.closed_loop.wire import at_rest
from tests.support.recorder import require_safe

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(400)]

FLOOD_S = 12.0
#: Proposals of the one that is given, each with another reason, as fast as they are answered, over four connections.
FLOOD = """
import asyncio, json, sys, time
from pathlib import Path
from gateway.core.topics import GATEWAY_PROPOSE
from gateway.mailbox.unix import UnixMailbox

async def main():
    document, until_s = json.loads(Path(sys.argv[2]).read_text()), time.monotonic() + float(sys.argv[3])
    asked, taken, codes = 0, 0, {}

    async def one(k):
        nonlocal asked, taken
        mailbox = UnixMailbox()
        mailbox.connect({GATEWAY_PROPOSE}, Path(sys.argv[1]))
        while time.monotonic() < until_s:
            asked += 1
            payload = json.dumps({**document, "reason": f"forged {k} {asked}"}).encode()
            reply = json.loads(await mailbox.request(GATEWAY_PROPOSE, payload, 20.0))
            taken += reply["ok"]
            for found in reply["findings"]:
                codes[found["code"]] = codes.get(found["code"], 0) + 1
        await mailbox.close()

    print("floods", flush=True)
    await asyncio.gather(*(one(k) for k in range(4)))
    print(json.dumps([asked, taken, codes]), flush=True)

asyncio.run(main())
"""
#: Takes the loop's socket away from it, and answers every command with success.
THIEF = """
import asyncio, sys
from pathlib import Path
from gateway.core.messages import Reply
from gateway.core.topics import LOOP_COMMAND
from gateway.mailbox.unix import UnixMailbox

async def main():
    path = Path(sys.argv[1])
    path.unlink()
    path.with_name(path.name + ".lock").unlink()
    box = UnixMailbox()

    async def answer(_):
        return Reply(ok=True, state="STOP", text="done (says the thief)").model_dump_json().encode()

    box.serve(LOOP_COMMAND, answer)
    await box.listen(path)
    print("took it", flush=True)
    await asyncio.Event().wait()

asyncio.run(main())
"""


@contextmanager
def process(program: str, *arguments: object) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-c", program, *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        try:
            assert child.stdout is not None and child.stdout.readline()
            yield child
        finally:
            child.kill()


@pytest.fixture
def line(tmp_path: Path) -> Iterator[GateLine]:
    with GateLine(tmp_path) as line:
        line.run()
        yield line


def test_a_flood_of_proposals_is_bounded_and_a_real_one_does_not_wait_behind_it(line: GateLine) -> None:
    mine = design_lqg(task_of(line.line))
    first = line.propose(mine, reason="a model for the flood")
    line.until(first, "waiting", 180.0)
    template = line.folder / "template.json"
    template.write_text(line.shown(first).proposal.model_dump_json())
    (line.folder / "better.json").write_bytes(canonical(mine))
    with process(FLOOD, line.children.run_folder / GATEWAY_SOCKET, template, FLOOD_S) as flood:
        began_s = time.monotonic()
        said = line.command("propose", line.folder / "better.json", "--reason", "the engineer's", "--json")
        took_s = time.monotonic() - began_s
        assert json.loads(said)["verdict"]["accepted"]
        out, _ = flood.communicate(timeout=60.0)
    asked, taken, codes = json.loads(out)
    assert asked > 100 and taken <= FLOOD_S + 2.0 and codes.get("inbox-rate", 0) >= asked - taken - 20
    assert took_s < FLOOD_S + 20.0
    status = line.status()
    assert status is not None and status.loop.state == "RUN"
    assert "refused-proposal" in line.audit("show", "--kind", "refused-proposal")
    assert line.order(Stop()).ok
    line.wait(at_rest)


def test_a_stop_reaches_the_loop_though_another_process_took_its_socket(line: GateLine) -> None:
    with process(THIEF, line.children.run_folder / LOOP_SOCKET):
        reply = line.order(Stop())
        assert reply.ok and {one.code for one in reply.findings} == {"false-loop-mute"}
        line.wait(at_rest)
        line.wait_at_rest()
    line.recording()
    require_safe(line.unsafe())
