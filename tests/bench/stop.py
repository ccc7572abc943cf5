"""`make bench-stop`: how long a stop takes from a person to the loop, beside disks that hang and work that is heavy.

A real gateway and a real operator's process; the loop is one that answers at once and tells when each stop came. Stops
come from the page, over OPC UA and from the terminal's way, in turns, each while something else goes on: nothing
(`quiet`); the stores of configurations and models held by another program, with archives and looks at proposals that
wait for them (`held`); the audit's thread held in its write, with decisions that wait for it (`writing`); recordings
being packed in the gateway as those of a verdict are (`packing`). A stop that is not answered as done is refused.

Writes out/bench/stop.json.
"""

import argparse
import asyncio
import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import ExitStack, asynccontextmanager
from pathlib import Path

import apsw
import httpx
import numpy as np
from asyncua import ua

from gateway.cli.stop_line import stop_line
from gateway.core.decisions import Archive, ShowProposal
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.messages import Reply
from gateway.core.states import LoopState, Phase
from gateway.core.topics import (
    GATEWAY_DECISION,
    GATEWAY_PROPOSALS,
    LOOP_COMMAND,
    LOOP_SHOWN,
    LOOP_TELEMETRY,
)
from gateway.mailbox.port import Unreachable
from gateway.mailbox.unix import UnixMailbox
from gateway.operator.page.login import TOKEN_HEADER
from gateway.operator.users import FILE_NAME as USERS_FILE
from gateway.operator.users import Users
from tests.bench.figures import Bench
from tests.bench.operator_clients import connected, node
from tests.operator.names import PANEL, PASSWORD
from tests.support.ports import free_port
from tests.unit.supervisor_support import ShowsWho, frame_of

SPANS, PERIOD_S = 6, 0.01
STOPS = 100  #: of each way in each case
PAUSE_S = 0.02  #: between two
CASES = ("quiet", "held", "writing", "packing")
PACK = "pack"  #: the file that has the gateway pack
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
HELD = {"held": ("configurations.sqlite", "models.sqlite"), "writing": ("audit.sqlite",)}

#: A gateway that packs the recordings of a verdict, in a thread as that does, again and again while it is told to.
GATEWAY = f"""
import asyncio, sys
from pathlib import Path
import numpy as np
from gateway.core.line_file import load_line
from gateway.core.packed_recording import packed
from gateway.core.recording import recording_of
from gateway.core.telemetry import frame_dtype
from gateway.supervisor.process import run_gateway
from gateway.supervisor.service import Gateway

folder, rng, packing = Path(sys.argv[1]), np.random.default_rng(1), []
frames = np.zeros(6000, frame_dtype(60))
frames["time_s"] = 0.01 * np.arange(len(frames))
for name in ("tension_n", "speed_m_per_s", "torque_nm", "torque_actual_nm"):
    frames[name] = rng.normal(100.0, 1.0, frames[name].shape)
recording, watch = recording_of(frames, 0.01, "a bench"), Gateway.watch

def watched(self):
    watch(self)
    if (folder / "{PACK}").exists() and not any(not one.done() for one in packing):
        packing[:] = [asyncio.ensure_future(asyncio.to_thread(packed, recording))]

Gateway.watch = watched
sys.exit(run_gateway(load_line((folder / "line.toml").read_text(), "line.toml"), folder, folder / "data"))
"""


class Loop:
    """Stops whenever it is asked, and knows when it was asked last."""

    def __init__(self, folder: Path) -> None:
        self.came_s: list[float] = []
        self._folder = folder
        self._mailbox = UnixMailbox()

    async def run(self) -> None:
        mailbox = self._mailbox
        mailbox.serve(LOOP_COMMAND, self._answer)
        mailbox.serve(LOOP_SHOWN, ShowsWho(self._folder, Phase.OFF).answer)
        await mailbox.listen(self._folder / "loop.sock")
        mailbox.connect({LOOP_TELEMETRY}, self._folder / "gateway.sock")
        sequence = 0
        try:
            while True:
                sequence += 1
                stands = {"state": LoopState.STOP, "phase": Phase.OFF}
                mailbox.publish(LOOP_TELEMETRY, frame_of(sequence, time.monotonic(), SPANS, **stands))
                await asyncio.sleep(PERIOD_S)
        finally:
            await mailbox.close()

    async def _answer(self, payload: bytes) -> bytes:
        if b"stop" in payload:
            self.came_s.append(time.monotonic())
        return Reply(ok=True, state="STOP", text="stopping").model_dump_json().encode()


Press = Callable[[], Awaitable[bool]]


@asynccontextmanager
async def ways_of(folder: Path, line_page: str, line_opcua: str) -> AsyncIterator[dict[str, Press]]:
    """By name how a stop is pressed, and whether it was answered as done."""
    client = await connected(line_opcua, folder / "data" / "pki", "otto")
    async with httpx.AsyncClient(base_url=line_page, headers={"origin": line_page}) as browser:
        login = await browser.post("/api/login", json={"name": "otto", "password": PASSWORD})
        browser.headers[TOKEN_HEADER] = login.json()["token"]

        async def on_page() -> bool:
            return (await browser.post("/api/stop")).status_code == 200

        async def over_opcua() -> bool:
            request = ua.CallMethodRequest(node("Line"), node("Line.Stop"), [])
            (result,) = await client.uaclient.call([request])
            return bool(result.OutputArguments and result.OutputArguments[0].Value)

        async def at_terminal() -> bool:
            with contextlib.suppress(Unreachable):
                return (await stop_line(folder, 1.0)).ok
            return False

        try:
            yield {"page": on_page, "opc-ua": over_opcua, "terminal": at_terminal}
        finally:
            await client.disconnect()


async def beside(case: str, folder: Path) -> None:
    """What goes on meanwhile, until it is cancelled."""
    held = [apsw.Connection(str(folder / "data" / name)) for name in HELD.get(case, ())]
    for one in held:
        one.set_busy_timeout(10_000)
        one.execute("BEGIN EXCLUSIVE")
    asking = UnixMailbox()
    asking.connect((GATEWAY_DECISION, GATEWAY_PROPOSALS), folder / "gateway.sock")
    archive = Archive(configuration="newest", name="phi_stable", because="a bench").model_dump_json().encode()
    show = ShowProposal(proposal="a" * 64).model_dump_json().encode()
    try:
        if case == "packing":
            (folder / PACK).touch()
        while True:
            for topic, payload in ((GATEWAY_DECISION, archive), (GATEWAY_PROPOSALS, show)) if held else ():
                with contextlib.suppress(Unreachable):
                    await asking.request(topic, payload, 0.5)
            await asyncio.sleep(0.1)
    finally:
        (folder / PACK).unlink(missing_ok=True)
        for one in held:
            one.close()
        await asking.close()


async def measured(bench: Bench, folder: Path, page: str, opcua: str, stops: int) -> None:
    loop = Loop(folder)
    running = asyncio.create_task(loop.run())
    refused, all_ms = 0, dict[str, list[float]]()
    async with ways_of(folder, page, opcua) as ways:
        await asyncio.sleep(2.0)  # for the gateway to know the loop
        for case in CASES:
            going_on = asyncio.create_task(beside(case, folder))
            await asyncio.sleep(1.0)
            for name, press in ways.items():
                took_ms, row = list[float](), all_ms.setdefault(case, [])
                for _ in range(stops):
                    loop.came_s.clear()
                    pressed_s = time.monotonic()
                    refused += not await press()
                    took_ms.append(1e3 * (loop.came_s[0] - pressed_s) if loop.came_s else float("inf"))
                    await asyncio.sleep(PAUSE_S)
                bench.figure(f"{case}_{name}_p99_ms", float(np.percentile(took_ms, 99.0)), "ms", len(took_ms))
                row += took_ms
            going_on.cancel()
            await asyncio.gather(going_on, return_exceptions=True)
    for case, row in all_ms.items():
        bench.figure(f"{case}_p99_ms", float(np.percentile(row, 99.0)), "ms", len(row))
    bench.figure("refused", refused, "stops", sum(len(row) for row in all_ms.values()))
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


def _started(stack: ExitStack, folder: Path, *words: str) -> None:
    """A process of the line, once it has said its first line."""
    process = stack.enter_context(
        subprocess.Popen([sys.executable, *words], cwd=folder, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True)
    )
    stack.callback(process.kill)
    assert process.stdout is not None
    print(process.stdout.readline(), end="", file=sys.stderr)


def _set_up(folder: Path) -> tuple[str, str]:
    """A line's file, certificates and a user. Returns the addresses of page and OPC UA."""
    text, found = line_template(SPANS), list[str]()
    for key, address in (("page", "http://127.0.0.1:8480"), ("opc_ua", "opc.tcp://127.0.0.1:4840")):
        found.append(f"{address.rpartition(':')[0]}:{free_port()}")
        text = text.replace(f'# {key} = "{address}"', f'{key} = "{found[-1]}"')
    (folder / "line.toml").write_text(text, encoding="utf-8")
    load_line(text, "line.toml")
    words = ["pki", "init", "--line", "line.toml", "--client", PANEL, "--data-dir", "data"]
    subprocess.run(
        [sys.executable, "-m", "gateway.cli", *words], cwd=folder, env=ENVIRONMENT, check=True, capture_output=True
    )
    Users.nobody().with_user("otto", PASSWORD, "operator").write(folder / "data" / USERS_FILE)
    return found[0], found[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stops", type=int, default=STOPS, help="of each way in each case")
    asked = parser.parse_args()
    bench = Bench("stop", libraries=("numpy", "apsw", "asyncua", "uvicorn"))
    with tempfile.TemporaryDirectory(prefix="r2r-", dir="/tmp") as name, ExitStack() as stack:
        folder = Path(name)
        page, opcua = _set_up(folder)
        _started(stack, folder, "-c", GATEWAY, name)
        _started(stack, folder, "-m", "gateway.cli", "operator", "line.toml", "--run-dir", name, "--data-dir", "data")
        asyncio.run(measured(bench, folder, page, opcua, asked.stops))
    bench.finish()


if __name__ == "__main__":
    main()
