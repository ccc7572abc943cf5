"""The agents' bus for tests: a router in this process, agents in this and others, and certificates of their own."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import zenoh

from gateway.cli import certificates
from gateway.core.line import Line, Network
from gateway.core.topics import AGENT_DECIDE, ASK_STATUS, Topic
from gateway.mailbox.bus import TlsEndpoint, connect, open_router, open_session, router_settings
from gateway.mailbox.paths import BUS_SOCKET
from gateway.mailbox.port import Unreachable
from gateway.mailbox.zenoh_mailbox import ZenohMailbox
from tests.support.patience import PATIENCE_S
from tests.support.ports import free_port
from tests.unit.supervisor_support import line_of, short_folder, until

LINE = line_of(1)

#: An agent: it answers what it is asked, or sleeps on it; what it has to say at first is "up".
AGENT = """
import asyncio, sys
from pathlib import Path
from gateway.core.topics import AGENT_DECIDE
from gateway.mailbox.bus import connect

async def answer(payload):
    if payload == b"sleep":
        print("asleep", flush=True)
        await asyncio.sleep(1000.0)
    return b"chosen: " + payload

async def main():
    mailbox = await connect(Path(sys.argv[1]), "demo", "line-1")
    mailbox.serve(AGENT_DECIDE.of("sysid"), answer)
    print("up", flush=True)
    await asyncio.sleep(1000.0)

asyncio.run(main())
"""


DECIDE, STATUS = AGENT_DECIDE.of("sysid"), ASK_STATUS.of("sysid")
LONG_S = 30.0  #: that a test would notice, had it to wait for it


async def echo(payload: bytes) -> bytes:
    return b"echo " + payload


async def answer_of(mailbox: ZenohMailbox, topic: Topic, payload: bytes, within_s: float) -> bytes:
    """Once it is known on the other side that somebody answers there, which is a moment after they say so."""
    async with asyncio.timeout(within_s):
        while True:
            try:
                return await mailbox.request(topic, payload, within_s)
            except Unreachable as error:
                if "nobody answers" not in str(error):
                    raise


async def never(_: bytes) -> bytes:
    await asyncio.sleep(1000.0)
    return b""


def unguarded(folder: Path) -> dict[str, Any]:
    """A router without access rules, for what the mailbox itself promises."""
    settings = router_settings(LINE, folder / BUS_SOCKET)
    return {key: value for key, value in settings.items() if key not in ("access_control", "low_pass_filter")}


def run(story: Callable[[Path], Coroutine[Any, Any, None]]) -> None:
    async def bounded(folder: Path) -> None:
        async with asyncio.timeout(PATIENCE_S):
            await story(folder)

    with short_folder() as folder:
        asyncio.run(bounded(folder))


def session_of(mailbox: ZenohMailbox) -> zenoh.Session:
    """Its own, for what a forger or a spy does beside the mailbox."""
    return mailbox._session  # noqa: SLF001 - no product code may have it


@asynccontextmanager
async def router(folder: Path, line: Line = LINE) -> AsyncIterator[ZenohMailbox]:
    mailbox = await open_router(line, folder)
    try:
        yield mailbox
    finally:
        await mailbox.close()


@asynccontextmanager
async def client(where: Path | TlsEndpoint, site: str = "demo", line: str = "line-1") -> AsyncIterator[ZenohMailbox]:
    mailbox = await connect(where, site, line)
    try:
        yield mailbox
    finally:
        await mailbox.close()


async def opened(settings: dict[str, Any], clock: Callable[[], float] = time.monotonic) -> ZenohMailbox:
    """A mailbox over a session with settings of a test's own."""
    return ZenohMailbox(await asyncio.to_thread(open_session, settings), "demo", "line-1", clock)


async def raw_answers(mailbox: ZenohMailbox, key: str, payload: bytes) -> list[str]:
    """What is answered to a request that no mailbox has looked at before it was sent; refusals as they are worded."""
    session = session_of(mailbox)
    replies = await asyncio.to_thread(lambda: list(session.get(key, payload=payload, timeout=0.5)))
    return [bytes((reply.ok or reply.err).payload).decode() for reply in replies]


async def is_here(mailbox: ZenohMailbox, topic: Topic) -> None:
    """Until somebody serves it, as this side sees it."""
    here: list[bool] = []
    mailbox.watch(topic, here.append)
    await until(lambda: here[-1:] == [True])


class Authority:
    """Signs certificates into a folder, as `r2rgate pki init` does."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder = folder
        self.file = folder / f"{name}.pem"
        self._signing = certificates.Authority.begin(name, datetime.now(UTC))
        self.file.write_bytes(self._signing.pair.certificate)

    def certificate(self, name: str, now: datetime | None = None) -> tuple[Path, Path]:
        """Files of a certificate for 127.0.0.1, signed `now`, and its key."""
        purpose = "server" if name == "gateway" else "client"
        pair = self._signing.sign(name, purpose, ["127.0.0.1"], now or datetime.now(UTC))
        file, key_file = self.folder / f"{self.file.stem}-{name}.pem", self.folder / f"{self.file.stem}-{name}.key.pem"
        file.write_bytes(pair.certificate)
        key_file.write_bytes(pair.private_key)
        return file, key_file


def on_network(authority: Authority, names: list[str]) -> tuple[Line, str]:
    """The line with a table [network], and the address on which its gateway will listen."""
    file, key = authority.certificate("gateway")
    address = f"127.0.0.1:{free_port()}"
    network = Network(
        listen=f"tls/{address}", certificate=str(file), private_key=str(key), authority=str(authority.file),
        names=names,
    )  # fmt: skip
    return LINE.model_copy(update={"network": network}), address


def endpoint(address: str, own: Authority, name: str, theirs: Authority) -> TlsEndpoint:
    certificate, key = own.certificate(name)
    return TlsEndpoint(address, certificate, key, theirs.file)
