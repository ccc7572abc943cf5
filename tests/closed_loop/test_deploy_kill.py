"""The process that renews a lease, killed for real: the loop goes back by itself. And a loop that comes back."""

import asyncio
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from gateway.control.design import design_lqg, task_of
from gateway.core.controller import config_hash
from gateway.core.deployment import Deployment
from gateway.core.messages import AskConfiguration, Deploy, Keep, Stop
from gateway.mailbox.paths import LOOP_SOCKET
from gateway.mailbox.port import Unreachable
from tests.closed_loop.wire import WireLine
from tests.support.gateway_key import as_gateway
from tests.support.recorder import require_safe

pytestmark = pytest.mark.realtime

NAMES = ("line.toml", "data")
LEASE_S = 1.0  # longer than a busy test machine stalls
RENEWER = """
import asyncio, sys
from pathlib import Path
from gateway.core.line_file import load_line
from gateway.core.messages import Renew
from tests.support.gateway_key import as_gateway

async def renew(socket, line, data):
    while True:
        answer = await as_gateway(socket, line, data, Renew(epoch=1), 1.0)
        print(answer.model_dump_json(), flush=True)
        await asyncio.sleep(0.05)

socket, line, data = map(Path, sys.argv[1:])
asyncio.run(renew(socket, load_line(line.read_text(), "line.toml"), data))
"""


def ask(wire, command):
    """Straight to the loop, as the gateway's deployer does, with its key."""
    socket = wire.children.run_folder / LOOP_SOCKET
    return asyncio.run(as_gateway(socket, wire.line, wire.folder / "data", command, 5.0))


def until(holds):
    deadline_s = time.monotonic() + 30.0
    while not holds():
        assert time.monotonic() < deadline_s
        time.sleep(0.05)  # between two looks


def is_up(wire):
    try:
        return ask(wire, AskConfiguration()).state == "SILENT"
    except Unreachable:
        return False


def test_the_renewer_is_killed_and_the_loop_goes_back_by_itself_and_what_is_kept_outlives_the_loop(tmp_path):
    with WireLine(tmp_path) as wire:
        wire.run()
        wire.children.end("gateway")  # it would take back what no record of it explains
        good = ask(wire, AskConfiguration()).in_service
        config = design_lqg(task_of(wire.line))
        given = {"controller": config, "hash": config_hash(config), "lease_s": LEASE_S}
        renewer = subprocess.Popen(
            [sys.executable, "-c", RENEWER, wire.children.run_folder / LOOP_SOCKET, *map(tmp_path.joinpath, NAMES)],
            stdout=subprocess.PIPE,
        )
        try:
            assert not json.loads(renewer.stdout.readline())["ok"]  # it is there, and nothing is on probation
            reply = ask(wire, Deploy(deployment=Deployment(**given, epoch=1)))
            assert reply.ok and reply.in_service.on_probation, reply
            deployed_s = time.monotonic()
            while time.monotonic() < deployed_s + 2.5 * LEASE_S:  # longer than a lease it is renewed, and stays
                renewer.stdout.readline()
            assert ask(wire, AskConfiguration()).in_service.hash == config_hash(config)
        finally:
            os.kill(renewer.pid, signal.SIGKILL)
            killed_s = time.monotonic()
            renewer.wait(10.0)
            renewer.stdout.close()
        until(lambda: not ask(wire, AskConfiguration()).in_service.on_probation)
        assert time.monotonic() - killed_s < LEASE_S + 3.0
        found = ask(wire, AskConfiguration()).in_service
        assert found.hash == good.hash and "lease" in found.why and found.epoch == 1
        # Kept, it is what the loop starts with again; on probation it is not.
        assert ask(wire, Deploy(deployment=Deployment(**given, epoch=2))).ok
        assert ask(wire, Keep(epoch=2)).ok
        other = config.model_copy(update={"gain_state": [[0.9 * g for g in row] for row in config.gain_state]})
        again = Deployment(controller=other, hash=config_hash(other), lease_s=30.0, epoch=3)
        assert ask(wire, Deploy(deployment=again)).ok
        assert wire.order(Stop()).ok
        wire.kill("loop")
        wire.children.end("loop")
        wire.start_loop()
        until(lambda: is_up(wire))
        found = ask(wire, AskConfiguration()).in_service
        assert (found.hash, found.epoch, found.on_probation) == (config_hash(config), 3, False)
        wire.recording()
        require_safe(wire.unsafe())
