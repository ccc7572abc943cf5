"""Agents that mean no good, each in a process of its own: `python -m tests.bench.agents_bad flood|garbage RUN_FOLDER`.

Each prints "up" once it has begun, and ends after `--most-s` by itself.
"""

import argparse
import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path

from gateway.core.topics import AGENT_DECIDE, AGENT_NAMES, AGENT_TOPICS, Topic
from gateway.mailbox.bus import client_settings, open_session
from gateway.mailbox.paths import BUS_SOCKET
from gateway.mailbox.port import Unreachable
from gateway.mailbox.zenoh_mailbox import ZenohMailbox

SITE, LINE = "demo", "line-1"
FORBIDDEN = ("loop/command", "gateway/command", "gateway/decision", "ask/sysid/status", "news")
AT_ONCE = 16  #: requests of each topic
GARBAGE = (b"", b"\xff\xfe", b"{" * 1000, b'{"format": 1}', b"[]", bytes(200_000))
PAUSE_S = 0.2  #: of the one that talks nonsense, on each topic


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.agents_bad", description=__doc__)
    parser.add_argument("how", choices=["flood", "garbage"])
    parser.add_argument("run_folder", type=Path)
    parser.add_argument("--most-s", type=float, default=120.0)
    given = parser.parse_args()
    asyncio.run(_for_a_while({"flood": flood, "garbage": garbage}[given.how], given.run_folder, given.most_s))


async def _for_a_while(how: Callable[[ZenohMailbox, Callable[[str], None]], Awaitable[None]], folder: Path,
                       most_s: float) -> None:  # fmt: skip
    session = await asyncio.to_thread(open_session, client_settings(f"unixsock-stream/{folder / BUS_SOCKET}"))
    mailbox = ZenohMailbox(session, SITE, LINE)

    def put(name: str) -> None:
        session.put(f"{SITE}/{LINE}/{name}", b"forged" * 100)

    print("up", flush=True)
    with suppress(TimeoutError):
        async with asyncio.timeout(most_s):
            await how(mailbox, put)


async def flood(mailbox: ZenohMailbox, put: Callable[[str], None]) -> None:
    """As fast as it goes: every topic there is, and messages on keys that no row of the table allows."""

    async def ask(topic: Topic) -> None:
        while True:
            with suppress(Unreachable):
                await mailbox.request(topic, b"x" * 1000, 1.0)
            await asyncio.sleep(0.0)

    async def forge() -> None:
        while True:
            for name in FORBIDDEN:
                put(name)
            await asyncio.sleep(0.0)

    topics = [row.of(agent) for row in AGENT_TOPICS for agent in AGENT_NAMES]
    await asyncio.gather(forge(), *(ask(topic) for topic in topics for _ in range(AT_ONCE)))


async def garbage(mailbox: ZenohMailbox, _: Callable[[str], None]) -> None:
    """Serves every agent's questions with bytes that are no answer, and sends such bytes itself."""
    count = 0

    async def answer(_: bytes) -> bytes:
        nonlocal count
        count += 1
        return GARBAGE[count % len(GARBAGE)]

    for agent in AGENT_NAMES:
        mailbox.serve(AGENT_DECIDE.of(agent), answer)

    async def send(topic: Topic) -> None:
        for number in range(1_000_000):
            with suppress(Unreachable):
                await mailbox.request(topic, GARBAGE[number % len(GARBAGE)], 1.0)
            await asyncio.sleep(PAUSE_S)

    asked = [row.of(agent) for row in AGENT_TOPICS if row is not AGENT_DECIDE for agent in AGENT_NAMES]
    await asyncio.gather(*map(send, asked))


if __name__ == "__main__":
    main()
