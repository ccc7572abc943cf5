"""`make bench-stop`: how long a stop takes from a person to the loop, beside disks that hang and work that is heavy.

`stops`: a real gateway and a real operator's process; the loop is one that answers at once and tells when each stop
came. Stops come from the page, over OPC UA and from a terminal through the gateway, in turns, each while something else
goes on: nothing (`quiet`); the stores of configurations and models held by another program, with archives and looks at
proposals that wait for them (`held`); the audit's thread held in its write (`writing`); recordings being packed as
those of a verdict are (`packing`); two judge workers at full load (`judging`); 1,200 silent connections to page and
OPC UA each (`silent`); eight flooding peers of the mailbox (`flooding`); all of it at once (`all`). A stop that is not
answered as done is refused.

`lease`: a simulated line in its processes runs a change on probation beside all of it for ten minutes. A lease that is
not renewed in time puts the loop back by itself.

Writes out/bench/stop.json.
"""

import argparse
import asyncio
import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import ExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from asyncua import ua

from gateway.cli.stop_line import stop_line
from gateway.control.design import design_lqg, task_of
from gateway.core.controller import config_hash
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.messages import Reply, Stop, command_bytes
from gateway.core.states import LoopState, Phase
from gateway.core.topics import (
    GATEWAY_COMMAND,
    LOOP_COMMAND,
    LOOP_SHOWN,
    LOOP_TELEMETRY,
)
from gateway.mailbox.paths import OPERATOR_DATA
from gateway.mailbox.port import Unreachable
from gateway.mailbox.unix import UnixMailbox
from gateway.operator.page.login import TOKEN_HEADER
from gateway.operator.users import FILE_NAME as USERS_FILE
from gateway.operator.users import Users
from tests.bench.figures import Bench
from tests.bench.operator_clients import connected, node
from tests.bench.stop_loads import CASES, GATEWAY, beside
from tests.operator.names import PANEL, PASSWORD
from tests.operator.real_line import OperatorLine
from tests.support.ports import free_port
from tests.support.proved import record_proof
from tests.unit.supervisor_support import ShowsWho, frame_of

SPANS, PERIOD_S = 6, 0.01
STOPS = 100  #: of each way in each case
PAUSE_S = 0.02  #: between two
SETTLED_S = 1.0  #: beside what goes on, before the first
LEASE_S = 600.0  #: that a change is on probation beside everything
LOOK_S = 1.0  #: between two looks at what the loop runs
PARTS = ("stops", "lease")
ROOT = Path(__file__).parents[2]


class Loop:
    """Stops whenever it is asked, and knows when it was asked last."""

    def __init__(self, folder: Path) -> None:
        self.came_s: list[float] = []
        self.known = asyncio.Event()  #: the gateway has asked who it is
        self._folder = folder
        self._mailbox = UnixMailbox()

    async def run(self) -> None:
        mailbox = self._mailbox
        mailbox.serve(LOOP_COMMAND, self._answer)
        shown = ShowsWho(self._folder, Phase.OFF)

        async def show(challenge: bytes) -> bytes:
            self.known.set()
            return await shown.answer(challenge)

        mailbox.serve(LOOP_SHOWN, show)
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
    client = await connected(line_opcua, folder / "data" / OPERATOR_DATA / "pki", "otto")
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

        terminal = UnixMailbox()
        terminal.connect({GATEWAY_COMMAND}, folder / "gateway.sock")

        async def through_gateway() -> bool:
            with contextlib.suppress(Unreachable):
                answer = await terminal.request(GATEWAY_COMMAND, command_bytes(Stop()), 1.0)
                return Reply.model_validate_json(answer).ok
            return False

        try:
            yield {"page": on_page, "opc-ua": over_opcua, "terminal": at_terminal, "through": through_gateway}
        finally:
            await terminal.close()
            await client.disconnect()


async def stops(bench: Bench, folder: Path, page: str, opcua: str, count: int) -> None:
    loop, doors = Loop(folder), [one.partition("://")[2] for one in (page, opcua)]
    running = asyncio.create_task(loop.run())
    refused, all_ms = 0, dict[str, list[float]]()
    async with ways_of(folder, page, opcua) as ways:
        await loop.known.wait()
        for case in CASES:
            async with beside(case, folder, folder, doors) as said:
                await asyncio.sleep(SETTLED_S)
                took_ms: dict[str, list[float]] = {name: [] for name in ways}
                for _ in range(count):  # in turns: a client that says nothing for 10 s has no session any more
                    for name, press in ways.items():
                        loop.came_s.clear()
                        pressed_s = time.monotonic()
                        refused += not await press()
                        took_ms[name].append(1e3 * (loop.came_s[0] - pressed_s) if loop.came_s else float("inf"))
                        await asyncio.sleep(PAUSE_S)
                for name, row in took_ms.items():
                    bench.figure(f"{case}_{name}_p99_ms", float(np.percentile(row, 99.0)), "ms", len(row))
                all_ms[case] = [one for row in took_ms.values() for one in row]
            print(f"{case}: {'; '.join(said)}", file=sys.stderr)
    for case, row in all_ms.items():
        bench.figure(f"{case}_p99_ms", float(np.percentile(row, 99.0)), "ms", len(row))
    bench.figure("refused", refused, "stops", sum(len(row) for row in all_ms.values()))
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


class BesideWork(OperatorLine):
    """Its gateway has work that is never done."""

    def start_gateway(self, *, proved: bool = True) -> None:
        record_proof(self.line, self.data)
        self.gateway = subprocess.Popen(
            [sys.executable, "-c", GATEWAY, str(self.folder), str(self.children.run_folder)], cwd=ROOT,
            stdout=(self.folder / "gateway.out").open("w"), stderr=subprocess.STDOUT,
        )  # fmt: skip

    def __exit__(self, *error: Any) -> None:
        self.gateway.terminate()
        super().__exit__(*error)


def lease(bench: Bench, folder: Path, for_s: float) -> None:
    with BesideWork(folder, probation_s=for_s + 120.0) as line:
        line.run()
        line.operate()
        better = design_lqg(task_of(line.line))
        proposal = line.approved(better)
        doors = [one.partition("://")[2] for one in (line.page, line.endpoint)]
        runs_s, state = asyncio.run(_runs(line, config_hash(better), doors, for_s))
        found = line.shown(proposal)
        print(f"{found.stage} {found.why}, the line is in {state}", file=sys.stderr)
        bench.figure("lease_held_s", runs_s, "s", 1)
        bench.figure("leases_lost", float(line.in_service() != config_hash(better)), "of 1", 1)


async def _runs(line: OperatorLine, wanted: str, doors: list[str], for_s: float) -> tuple[float, str]:
    """For how long it is in service beside all of it, by the loop's own word; and the state of the line then."""
    began_s = time.monotonic()
    async with beside("all", line.folder, line.children.run_folder, doors) as said:
        while (held_s := time.monotonic() - began_s) < for_s:
            if await asyncio.to_thread(line.in_service) != wanted:
                break
            await asyncio.sleep(LOOK_S)
    print(f"lease: {'; '.join(said)}", file=sys.stderr)
    status = await asyncio.to_thread(line.status)
    return held_s, "" if status is None else status.loop.state


def _started(stack: ExitStack, *words: str) -> None:
    """A process of the line, once it has said its first line."""
    process = stack.enter_context(
        subprocess.Popen([sys.executable, *words], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    )
    stack.callback(process.kill)
    assert process.stdout is not None and (said := process.stdout.readline()), words[:3]
    print(said, end="", file=sys.stderr)


def _set_up(folder: Path) -> tuple[str, str]:
    """A line's file, certificates and a user. Returns the addresses of page and OPC UA."""
    text, found = line_template(SPANS), list[str]()
    for key, address in (("page", "http://127.0.0.1:8480"), ("opc_ua", "opc.tcp://127.0.0.1:4840")):
        found.append(f"{address.rpartition(':')[0]}:{free_port()}")
        text = text.replace(f'# {key} = "{address}"', f'{key} = "{found[-1]}"')
    (folder / "line.toml").write_text(text, encoding="utf-8")
    load_line(text, "line.toml")
    words = ["pki", "init", "--line", folder / "line.toml", "--client", PANEL, "--data-dir", folder / "data"]
    subprocess.run([sys.executable, "-m", "gateway.cli", *words], cwd=ROOT, check=True, capture_output=True)
    Users.nobody().with_user("otto", PASSWORD, "operator").write(folder / "data" / OPERATOR_DATA / USERS_FILE)
    return found[0], found[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stops", type=int, default=STOPS, help="of each way in each case")
    parser.add_argument("--lease", type=float, default=LEASE_S, help="seconds on probation")
    parser.add_argument("--parts", default=",".join(PARTS), help="of these")
    asked = parser.parse_args()
    bench = Bench("stop", libraries=("numpy", "apsw", "asyncua", "uvicorn"))
    with tempfile.TemporaryDirectory(prefix="r2r-", dir="/tmp") as name, ExitStack() as stack:
        folder = Path(name)
        if "stops" in asked.parts:
            page, opcua = _set_up(folder)
            _started(stack, "-c", GATEWAY, name, name)
            words = ("operator", str(folder / "line.toml"), "--run-dir", name, "--data-dir", str(folder / "data"))
            _started(stack, "-m", "gateway.cli", *words)
            asyncio.run(stops(bench, folder, page, opcua, asked.stops))
        if "lease" in asked.parts:
            stack.close()  # its processes take none of the time of those of the line
            (folder / "line").mkdir()
            lease(bench, folder / "line", asked.lease)
    bench.finish()


if __name__ == "__main__":
    main()
