"""Processes of the line's own user that go past the gateway, for real: refused, told, on record, the line unchanged."""

import asyncio
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from gateway.control.design import design_lqg, task_of
from gateway.core.controller import config_hash
from gateway.core.deployment import Deployment, Region, first_region
from gateway.core.messages import AskConfiguration, Deploy, Hold, Keep, Reply, Stop, command_bytes
from gateway.core.topics import LOOP_COMMAND
from gateway.loop.kept import FILE, SET_ASIDE
from gateway.mailbox.keys import private_key
from gateway.mailbox.paths import LOOP_DATA, LOOP_SOCKET
from gateway.mailbox.unix import UnixMailbox
from tests.closed_loop.gate_line import GateLine
from tests.support.gateway_key import as_gateway
from tests.support.recorder import require_safe

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(180)]

#: Says everything that there is to say, straight to the loop, and prints what it answers.
INTRUDER = """
import asyncio, json, sys
from pathlib import Path
from gateway.control.design import design_lqg, task_of
from gateway.core.controller import config_hash
from gateway.core.deployment import Deployment, Region
from gateway.core.line_file import load_line
from gateway.core.messages import *
from gateway.core.messages import command_bytes
from gateway.core.topics import LOOP_COMMAND
from gateway.mailbox.unix import UnixMailbox

async def main():
    config = design_lqg(task_of(load_line(Path(sys.argv[2]).read_text(), "line.toml")))
    deployment = Deployment(controller=config, hash=config_hash(config), epoch=1, lease_s=60.0)
    mailbox = UnixMailbox()
    mailbox.connect({LOOP_COMMAND}, Path(sys.argv[1]))
    said = (Deploy(deployment=deployment), Keep(epoch=1), Narrow(region=Region()), Renew(epoch=1), Arm(), Start(),
            SetTension(span=1, tension_n=30.0), SetSpeed(speed_m_per_s=0.05), Rollback(reason="x"), AbortExperiment(),
            Hold(), Stop())
    for command in said:
        reply = json.loads(await mailbox.request(LOOP_COMMAND, command_bytes(command), 10.0))
        print(json.dumps([command.command, reply["ok"], [one["code"] for one in reply["findings"]]]))
    await mailbox.close()

asyncio.run(main())
"""
#: Opens so many connections, again and again, and asks on each without end.
FLOOD = """
import json, os, socket, sys, time
from gateway.mailbox.codec import Envelope, Kind, encode
asked = encode(Envelope(Kind.REQUEST, "loop/command", 1, b'{"command": "configuration"}'))
held, processes, most, mine, began_by = [], int(sys.argv[2]), int(sys.argv[3]), os.getpid(), os.getppid()
for _ in range(processes - 1):
    if os.fork() == 0:
        break
if os.getpid() == mine:
    print("floods", flush=True)
while os.getppid() == (began_by if os.getpid() == mine else mine):  # it outlives nobody
    time.sleep(0.0 if processes == 1 else 0.02)  # a machine of two processors has the line to run, too
    peer = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
    try:
        peer.connect(sys.argv[1])
        peer.send(asked)
    except OSError:
        peer.close()
    else:
        held.append(peer)
    for peer in held:
        try:
            peer.send(asked)
        except OSError:
            pass
    if len(held) > most:
        held.pop(0).close()
"""
TAKEN_WITHIN_S = 1.0
FLOODED_S = 3.0  #: of a flood, before anything is ordered


@pytest.fixture
def line(tmp_path):
    with GateLine(tmp_path) as line:
        yield line


def began(line: GateLine) -> None:
    line.start_gateway()
    line.start_loop()
    line.wait(lambda status: status.loop.running)
    line.look_on(line.listed, lambda found: found is not None and found.in_service is not None)


def test_whoever_speaks_to_the_loop_past_the_gateway_is_refused_told_and_on_record(line):
    began(line)
    before = line.configuration()
    arguments = [sys.executable, "-c", INTRUDER, line.children.run_folder / LOOP_SOCKET, line.folder / "line.toml"]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as intruder:
        said = [json.loads(row) for row in intruder.communicate(timeout=60.0)[0].splitlines()]
    assert len(said) == 12
    for command, ok, codes in said:
        # Anybody may stop and hold; but a line that stands still is not held.
        assert codes == {"stop": [], "hold": ["needs-running"]}.get(command, ["no-proof"]), command
        assert ok == (command == "stop"), command
    after = line.configuration()
    assert (after.hash, after.epoch, after.region, after.on_probation) == (
        before.hash, before.epoch, before.region, before.on_probation,
    )  # fmt: skip
    status = line.wait(lambda status: any(one.name == "unexplained-change" for one in status.alarms))
    assert {one.code for one in status.unexplained} == {"refused-at-the-door"}
    assert {one.parameters["pid"] for one in status.unexplained} == {intruder.pid}
    assert any(event.kind == "refused-at-the-door" for event in status.events)
    line.look_on(lambda: line.audit("show"), lambda shown: "refused-at-loop" in shown)


@contextmanager
def flooded(line: GateLine, crowd: list[str]) -> Iterator[None]:
    arguments = [sys.executable, "-c", FLOOD, line.children.run_folder / LOOP_SOCKET, *crowd]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None and process.stdout.readline()
            yield
        finally:
            process.kill()


@pytest.mark.parametrize(
    "crowd", [["1", "1000"], ["32", "1"]], ids=["one process with all it can open", "32 processes"]
)
def test_no_flood_keeps_hold_or_stop_waiting_for_a_second_and_nothing_unsafe_comes_of_it(line, crowd):
    """How much of each period a flood takes at most is counted in test_mailbox_turns; here it takes the machine, too.

    One that has no processor left for the line stops it: then it is not held any more, and stop is taken all the same.
    """
    line.run()
    with flooded(line, crowd):
        time.sleep(FLOODED_S)
        status = line.wait(lambda _: True)
        print(f"{status.loop.state} under a flood: {status.timing}")
        take(line)
    line.recording()
    require_safe(line.unsafe())


def take(line: GateLine) -> None:
    """Hold and stop, each twice, past the gateway, answered in time."""
    took_s: dict[str, list[float]] = {}
    for command in (Hold(), Hold(), Stop(), Stop()):
        began_s = time.monotonic()
        reply = straight(line.children.run_folder / LOOP_SOCKET, command)
        took_s.setdefault(command.command, []).append(time.monotonic() - began_s)
        assert reply.ok or command.command == "hold", reply
    line.wait_at_rest()
    print("under a flood they took", took_s)
    assert max(max(took_s["hold"]), max(took_s["stop"])) < TAKEN_WITHIN_S, took_s


def straight(socket, command) -> Reply:
    """The loop's own answer, as to any process that is there."""

    async def ask() -> bytes:
        mailbox = UnixMailbox()
        mailbox.connect({LOOP_COMMAND}, socket)
        try:
            return await mailbox.request(LOOP_COMMAND, command_bytes(command), 10.0)
        finally:
            await mailbox.close()

    return Reply.model_validate_json(asyncio.run(ask()))


def test_a_kept_configuration_outlives_the_loop_and_one_that_was_edited_is_not_used(line):
    given, config = config_hash(line.first), design_lqg(task_of(line.line))
    private_key(line.gateway_data)
    line.start_loop()
    line.look_on(lambda: is_up(line), bool)
    region = Region(speed_max_m_per_s=0.05)
    deployment = Deployment(controller=config, hash=config_hash(config), epoch=1, lease_s=60.0, region=region)
    for command in (Deploy(deployment=deployment), Keep(epoch=1)):
        reply = say(line, command)
        assert reply.ok, reply
    again(line)
    found = line.configuration()
    assert (found.hash, found.epoch, found.region) == (config_hash(config), 1, region)
    path = line.data / LOOP_DATA / FILE
    kept = json.loads(path.read_text())
    kept["controller"]["gain_state"] = [[1.05 * gain for gain in row] for row in kept["controller"]["gain_state"]]
    path.write_text(json.dumps(kept))
    again(line)
    found = line.configuration()
    assert (found.hash, found.region, found.epoch) == (given, first_region(line.line), 1)
    assert json.loads((line.data / LOOP_DATA / SET_ASIDE).read_text()) == kept
    assert "without the gateway's signature" in line.children.log("loop").read_text()


def say(line, command):
    """Once the loop has opened its buses."""
    return line.look_on(
        lambda: _say(line, command), lambda reply: "loop-starting" not in [f.code for f in reply.findings]
    )


def _say(line, command):
    return asyncio.run(as_gateway(line.children.run_folder / LOOP_SOCKET, line.line, line.data, command))


def is_up(line) -> bool:
    try:
        return _say(line, AskConfiguration()).ok
    except Exception:  # not yet
        return False


def again(line) -> None:
    line.kill("loop")
    line.children.end("loop")
    line.start_loop()
    line.look_on(lambda: is_up(line), bool)
