"""The operator's process: what people reach. It talks to the gateway alone, and may end without the line noticing."""

import asyncio
import gc
import logging
import signal
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path

from gateway.core.line import Line
from gateway.core.people import Role
from gateway.mailbox.paths import GATEWAY_SOCKET
from gateway.mailbox.unix import UnixMailbox
from gateway.operator.line_side import TOPICS, LineSide
from gateway.operator.opcua.server import CannotServe
from gateway.operator.opcua.service import OpcUa
from gateway.operator.opcua.trust import pki_folder
from gateway.operator.users import FILE_NAME, UsersFile, UsersRefused

EXIT_OK, EXIT_CANNOT_SERVE = 0, 2


def run_operator(line: Line, run_folder: Path, data_folder: Path) -> int:
    """Serve until SIGTERM or SIGINT. Returns the process's exit code."""
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)  # whatever strangers send would be written down
    try:
        asyncio.run(serve(line, run_folder, data_folder))
    except CannotServe as error:
        print(f"the operator's process cannot start: {error}", file=sys.stderr)
        return EXIT_CANNOT_SERVE
    return EXIT_OK


async def serve(line: Line, run_folder: Path, data_folder: Path) -> None:
    """All of it, in one event loop. Raises CannotServe."""
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    mailbox = UnixMailbox()
    mailbox.connect(TOPICS, run_folder / GATEWAY_SOCKET)
    side = LineSide(mailbox)
    opcua = OpcUa(line, side, pki_folder(line, data_folder), checked_by(data_folder / FILE_NAME, _tell), _tell)
    try:
        await opcua.start()
        print(f"operator of {line.site}/{line.line}: OPC UA on {line.operator.opc_ua}", flush=True)
        gc.collect()
        gc.freeze()  # half a million nodes and references that stay: to look through them takes 0.15 s each time
        tasks = [asyncio.create_task(work) for work in (side.watch(), opcua.run(), stop.wait())]
        done, others = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)
        for task in done:
            task.result()  # what has failed is told, and the process started again
    finally:
        await opcua.stop()
        await mailbox.close()


def checked_by(path: Path, tell: Callable[[str], None]) -> Callable[[str, str], Awaitable[Role | None]]:
    """Names and passwords against the users' file, off the event loop: a guess takes some 50 ms."""
    users = UsersFile(path)

    def checked(name: str, password: str) -> Role | None:
        try:
            return users.current().check(name, password)
        except UsersRefused as refused:
            tell(f"nobody can log in: {refused}")
            return None

    async def check(name: str, password: str) -> Role | None:
        return await asyncio.to_thread(checked, name, password)

    return check


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
