"""A second reader of the gateway, as fast as it can be: `python -m tests.bench.reader RUN_FOLDER`.

What the gateway offers of the telemetry is its status, on request: as many requests are kept under way as it answers
at once for one peer. At SIGTERM it prints how many answers it has had, and ends.
"""

import asyncio
import signal
import sys
from pathlib import Path

from gateway.core.topics import GATEWAY_STATUS
from gateway.mailbox.paths import GATEWAY_SOCKET
from gateway.mailbox.places import MAX_IN_FLIGHT
from gateway.mailbox.unix import UnixMailbox


async def read(run_folder: Path) -> int:
    """Answers had until SIGTERM. Raises Unreachable when there is no gateway."""
    mailbox = UnixMailbox()
    mailbox.connect({GATEWAY_STATUS}, run_folder / GATEWAY_SOCKET)
    ending = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ending.set)
    answers = 0

    async def ask() -> None:
        nonlocal answers
        while not ending.is_set():
            await mailbox.request(GATEWAY_STATUS, b"", 5.0)
            answers += 1

    try:
        await asyncio.gather(*(ask() for _ in range(MAX_IN_FLIGHT)))
    finally:
        await mailbox.close()
    return answers


if __name__ == "__main__":
    print(asyncio.run(read(Path(sys.argv[1]))))
