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
from gateway.core.messages import AskConfiguration, Deploy, Keep, Reply, Stop, command_bytes
from gateway.core.topics import LOOP_COMMAND
from gateway.mailbox.paths import LOOP_SOCKET
from gateway.mailbox.unix import UnixMailbox
from tests.closed_loop.wire import WireLine

pytestmark = pytest.mark.realtime

LEASE_S = 1.0  # longer than a busy test machine stalls
RENEWER = """
import asyncio, sys
from pathlib import Path
from gateway.core.messages import Renew, command_bytes
from gateway.core.topics import LOOP_COMMAND
from gateway.mailbox.unix import UnixMailbox

async def renew():
    mailbox = UnixMailbox()
    mailbox.connect({LOOP_COMMAND}, Path(sys.argv[1]))
    while True:
        answer = await mailbox.request(LOOP_COMMAND, command_bytes(Renew(epoch=1)), 1.0)
        print(answer.decode(), flush=True)
        await asyncio.sleep(0.05)

asyncio.run(renew())
"""


def ask(wire, command):
    """Straight to the loop, as the gateway's deployer does."""

    async def requested():
        mailbox = UnixMailbox()
        mailbox.connect({LOOP_COMMAND}, wire.children.run_folder / LOOP_SOCKET)
        try:
            return Reply.model_validate_json(await mailbox.request(LOOP_COMMAND, command_bytes(command), 5.0))
        finally:
            await mailbox.close()

    return asyncio.run(requested())


def test_the_renewer_is_killed_and_the_loop_goes_back_by_itself_and_what_is_kept_outlives_the_loop(tmp_path):
    with WireLine(tmp_path) as wire:
        wire.run()
        good = ask(wire, AskConfiguration()).in_service
        config = design_lqg(task_of(wire.line))
        given = {"controller": config, "hash": config_hash(config), "lease_s": LEASE_S}
        renewer = subprocess.Popen(
            [sys.executable, "-c", RENEWER, str(wire.children.run_folder / LOOP_SOCKET)], stdout=subprocess.PIPE
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
        wire.wait(lambda status: any(event.kind == "rolled-back" for event in status.events), 5.0)
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
        wire.wait(lambda status: status.loop.running and status.loop.state == "SILENT")
        found = ask(wire, AskConfiguration()).in_service
        assert (found.hash, found.epoch, found.on_probation) == (config_hash(config), 3, False)
        wire.recording()
        assert not any(wire.unsafe().values()), wire.unsafe()
