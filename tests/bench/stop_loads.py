"""What bench-stop puts beside a stop.

In processes of their own, `python -m tests.bench.stop_loads KIND ADDRESS...`; each says `ready`, goes on until SIGTERM,
and says at its end what it did:

    silent HOST:PORT...  1,200 connections to each that say nothing, opened anew as the server ends them
    flood SOCKET         eight peers of a mailbox that send the longest messages there are, as fast as it takes them

In the gateway itself, as long as a file of that name is there: `pack`, recordings being packed as those of a verdict
are; `judge`, two judge workers that never wait for a proposal. Each that was done is a byte in `packed` or `judged`.
And a store's file may be held: `beside`. A load that was not there is an error, not a good figure.
"""

import asyncio
import contextlib
import errno
import random
import resource
import selectors
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

import apsw

from gateway.core.decisions import Archive, ShowProposal
from gateway.core.topics import GATEWAY_DECISION, GATEWAY_PROPOSALS
from gateway.mailbox.codec import Envelope, Kind, encode
from gateway.mailbox.paths import GATEWAY_DATA
from gateway.mailbox.port import MAX_PAYLOAD, Unreachable
from gateway.mailbox.unix import UnixMailbox
from tests.bench.operator_windows import Beside

SILENT, PEERS, FROM = 1200, 8, 4  #: connections to each door; peers; addresses that the silent ones come from
OPENED_AT_ONCE, OPENED_PAUSE_S = 20, 0.01
HELD = {"held": ("configurations.sqlite", "models.sqlite"), "writing": ("audit.sqlite",)}
TOLD = {"packing": "pack", "judging": "judge"}  #: files that tell the gateway
BEGUN_S = 120.0  #: until one of each is done: judge workers load and compile
DONE = {"pack": "packed", "judge": "judged"}
CASES = ("quiet", "held", "writing", "packing", "judging", "silent", "flooding", "all")

#: A gateway with work that is never done, while it is told so: `python -c GATEWAY FOLDER RUN_FOLDER`.
GATEWAY = """
import asyncio, sys
from pathlib import Path
import numpy as np
from gateway.core.line_file import load_line
from gateway.core.packed_recording import packed
from gateway.core.proposal import canonical
from gateway.core.recording import recording_of
from gateway.core.telemetry import frame_dtype
from gateway.control.design import design_lqi
from gateway.supervisor.judging import JudgeWorkers
from gateway.supervisor.process import run_gateway
from gateway.supervisor.service import Gateway
from tests.safety.case_support import gains, published

folder, rng, busy, name_of = Path(sys.argv[1]), np.random.default_rng(1), {}, {"pack": "packed", "judge": "judged"}
frames = np.zeros(6000, frame_dtype(60))
frames["time_s"] = 0.01 * np.arange(len(frames))
for name in ("tension_n", "speed_m_per_s", "torque_nm", "torque_actual_nm"):
    frames[name] = rng.normal(100.0, 1.0, frames[name].shape)
recording, of, watch = recording_of(frames, 0.01, "a bench"), published(), Gateway.watch
context = of.context()
proposal, judge = canonical(gains(design_lqi(of.task()), context)), JudgeWorkers(of.line, 2)

async def done(work, name):
    await work
    with (folder / name).open("ab") as told:
        told.write(b".")

def again(name, told, begin):
    if (folder / told).exists() and (name not in busy or busy[name].done()):
        busy[name] = asyncio.ensure_future(done(begin(), name_of[told]))

def watched(self):
    watch(self)
    again("pack", "pack", lambda: asyncio.to_thread(packed, recording))
    for k in range(2):
        again(k, "judge", lambda: judge.judge(proposal, context, [of.recording]))

Gateway.watch = watched
line = load_line((folder / "line.toml").read_text(), "line.toml")
sys.exit(run_gateway(line, Path(sys.argv[2]), folder / "data"))
"""


@asynccontextmanager
async def beside(case: str, folder: Path, run_folder: Path, doors: Sequence[str]) -> AsyncIterator[list[str]]:
    """What goes on meanwhile; the list has at the end what each did. `doors`: HOST:PORT of page and OPC UA."""
    cases = CASES[1:-1] if case == "all" else (case,)
    said, others = list[str](), Beside()
    held = [apsw.Connection(str(folder / "data" / GATEWAY_DATA / name)) for one in cases for name in HELD.get(one, ())]
    told = [folder / TOLD[one] for one in cases if one in TOLD]
    asking = asyncio.create_task(_asking(run_folder)) if held else None
    try:
        for one in held:
            one.set_busy_timeout(10_000)
            one.execute("BEGIN EXCLUSIVE")
        for path in told:
            path.touch()
        if "silent" in cases:
            await asyncio.to_thread(others.begin, "tests.bench.stop_loads", "silent", *doors)
        if "flooding" in cases:
            await asyncio.to_thread(others.begin, "tests.bench.stop_loads", "flood", str(run_folder / "gateway.sock"))
        await _begun([folder / DONE[path.name] for path in told])
        yield said
    finally:
        for path in told:
            path.unlink()
        if asking is not None:
            asking.cancel()
            await asyncio.gather(asking, return_exceptions=True)
        for one in held:
            one.close()
        said += await asyncio.to_thread(others.end)
        for done in (folder / DONE[path.name] for path in told):
            said.append(f"{done.name}: {done.stat().st_size if done.exists() else 0}")
            done.unlink(missing_ok=True)
    if idle := [one for one in said if not one or one.partition(": ")[2].startswith("0")]:
        raise RuntimeError(f"{case}: a load was not there: {idle}")


async def _begun(done: Sequence[Path]) -> None:
    """One of each is. Raises TimeoutError."""
    async with asyncio.timeout(BEGUN_S):
        while not all(path.exists() for path in done):  # noqa: ASYNC110 (another process writes them)
            await asyncio.sleep(0.1)


async def _asking(run_folder: Path) -> None:
    """For what has to wait for the stores that are held."""
    asking = UnixMailbox()
    asking.connect((GATEWAY_DECISION, GATEWAY_PROPOSALS), run_folder / "gateway.sock")
    archive = Archive(configuration="newest", name="phi_stable", because="a bench").model_dump_json().encode()
    show = ShowProposal(proposal="a" * 64).model_dump_json().encode()
    try:
        while True:
            for topic, payload in ((GATEWAY_DECISION, archive), (GATEWAY_PROPOSALS, show)):
                with contextlib.suppress(Unreachable):
                    await asking.request(topic, payload, 0.5)
            await asyncio.sleep(0.1)
    finally:
        await asking.close()


def silent(doors: Sequence[str]) -> None:
    """To each door `SILENT` that are open as far as this side knows; those that are ended are opened anew."""
    at = [(host, int(port)) for host, _, port in (door.rpartition(":") for door in doors)]
    rng, over = random.Random(1), _until_told()
    resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)
    with selectors.DefaultSelector() as selector:
        missing, opened, ready = deque(k for _ in range(SILENT) for k in range(len(at))), 0, False
        while not over():
            for _ in range(min(OPENED_AT_ONCE, len(missing))):
                door = missing.popleft()
                one = socket.socket()
                one.setblocking(False)
                one.bind((f"127.0.0.{2 + rng.randrange(FROM)}", 0))
                if one.connect_ex(at[door]) in (0, errno.EINPROGRESS):
                    selector.register(one, selectors.EVENT_READ, door)
                    opened += 1
                else:
                    one.close()
                    missing.append(door)
            for key, _ in selector.select(OPENED_PAUSE_S):
                selector.unregister(key.fileobj)
                assert isinstance(key.fileobj, socket.socket)
                key.fileobj.close()
                missing.append(key.data)
            if not ready and opened >= SILENT * len(at):
                ready = True
                print("ready", flush=True)
            time.sleep(OPENED_PAUSE_S)
        print(f"silent: {len(selector.get_map())} open, {opened} opened")


def flood(path: str) -> None:
    """Publishes of a topic that is served, each of the longest."""
    longest, over, sent = encode(Envelope(Kind.PUBLISH, "loop/telemetry", 0, b"0" * MAX_PAYLOAD)), _until_told(), 0
    peers = [_peer(path) for _ in range(PEERS)]
    print("ready", flush=True)
    while not over():
        for k, peer in enumerate(peers):
            try:
                peer.send(longest)
                sent += 1
            except BlockingIOError:
                continue
            except OSError:  # it was ended, as who sends such things may be
                peer.close()
                with contextlib.suppress(OSError):
                    peers[k] = _peer(path)
    print(f"flood: {sent} messages of {len(longest)} bytes")


def _peer(path: str) -> socket.socket:
    peer = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2 * MAX_PAYLOAD)
    peer.setblocking(False)
    peer.connect(path)
    return peer


def _until_told():  # noqa: ANN202 (a bench's)
    over = list[int]()
    signal.signal(signal.SIGTERM, lambda number, _: over.append(number))
    return lambda: bool(over)


if __name__ == "__main__":
    if sys.argv[1] == "silent":
        silent(sys.argv[2:])
    else:
        flood(sys.argv[2])
