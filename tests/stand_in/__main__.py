"""A server that speaks Ollama's HTTP API and has no model: `python -m tests.stand_in --persona perfect`."""

import argparse
import asyncio
import signal
import sys

from tests.stand_in.engine import MODEL, Engine
from tests.stand_in.personas import PERSONAS
from tests.stand_in.server import StandIn


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.stand_in", description=__doc__)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=0, help="0: a free one, which is printed")
    parser.add_argument("--persona", choices=sorted(PERSONAS), default="perfect")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--model", action="append", help=f"that it has; again for more; without: {MODEL}")
    parser.add_argument("--pace", type=float, default=1.0, help="times every delay; 0: none")
    parser.add_argument("--load-s", type=float, default=0.0, help="for a model to be loaded")
    given = parser.parse_args()
    engine = Engine(PERSONAS[given.persona], given.seed, given.model or (MODEL,), given.pace, given.load_s)
    asyncio.run(_serve(engine, given.host, given.port))


async def _serve(engine: Engine, host: str, port: int) -> None:
    """Until SIGTERM or SIGINT. The first line that is printed is the URL."""
    ended = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)
    async with StandIn(engine, host, port) as server:
        print(server.url)
        sys.stdout.flush()
        await ended.wait()


if __name__ == "__main__":
    main()
