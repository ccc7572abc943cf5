"""The operator's process: what people reach. It talks to the gateway alone, and may end without the line noticing."""

import asyncio
import gc
import logging
import signal
import sys
import time
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import AsyncExitStack
from pathlib import Path

from gateway.core.line import Line
from gateway.core.people import Role
from gateway.core.topics import GATEWAY_FOR_PERSON
from gateway.mailbox.paths import GATEWAY_SOCKET, OPERATOR_DATA
from gateway.mailbox.unix import UnixMailbox
from gateway.operator.access import Access
from gateway.operator.line_side import READ, LineSide
from gateway.operator.opcua.service import OpcUa
from gateway.operator.opcua.trust import CERTIFICATE, PRIVATE_KEY, pki_folder
from gateway.operator.page.app import page_app
from gateway.operator.users import FILE_NAME, UsersFile, UsersRefused
from gateway.operator.ways import OpcUaWay, PageWay, Way
from gateway.tasks.cleanup import end, finish, finish_all

EXIT_OK, EXIT_CANNOT_SERVE = 0, 2
USERS_S = 2.0  #: between two looks whether there are any
LOOK_S, MOST_LOOKS = 0.1, 30  #: until somebody who is a user since a moment ago is known as one


class NothingServed(Exception):
    """The text says why."""


def run_operator(line: Line, run_folder: Path, data_folder: Path) -> int:
    """Serve until SIGTERM or SIGINT. Returns the process's exit code."""
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)  # whatever strangers send would be written down
    try:
        asyncio.run(serve(line, run_folder, data_folder))
    except NothingServed as error:
        print(f"the operator's process cannot start: {error}", file=sys.stderr)
        return EXIT_CANNOT_SERVE
    return EXIT_OK


async def serve(line: Line, run_folder: Path, data_folder: Path) -> None:
    """All of it, in one event loop. Raises NothingServed where neither way in can be opened."""
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    mailbox, saying = UnixMailbox(), UnixMailbox()
    mailbox.connect(READ, run_folder / GATEWAY_SOCKET)
    saying.connect((GATEWAY_FOR_PERSON,), run_folder / GATEWAY_SOCKET)
    own = data_folder / OPERATOR_DATA
    side, users = LineSide(mailbox, saying), UsersFile(own / FILE_NAME)
    check, pki = checked_by(users, _tell), pki_folder(line, own)
    access = Access(side, users, _tell, time.monotonic)
    page_tls = (pki / CERTIFICATE, pki / PRIVATE_KEY) if line.operator.page.startswith("https:") else (None, None)
    served_page = PageWay(
        page_app(line, side, check, users.role_of, time.monotonic, access), line.operator.page, *page_tls
    )
    page = Way(f"page at {line.operator.page}", served_page.begin, served_page.serve, _tell)
    served_opcua = OpcUaWay(OpcUa(line, side, pki, check, users.role_of, _tell, access), lambda: page.trouble)
    opcua = Way(f"OPC UA at {line.operator.opc_ua}", served_opcua.begin, served_opcua.serve, _tell)
    try:
        await access.renew()  # before anybody asks
        ways = [way for way in (page, opcua) if await way.open()]
        if not ways:
            raise NothingServed(f"{page.trouble}; {opcua.trouble}")
        print(f"operator of {line.site}/{line.line}: {', '.join(way.name for way in ways)}", flush=True)
        gc.collect()
        gc.freeze()  # half a million nodes and references that stay: to look through them takes 0.15 s each time
        gc.collect()  # else all generations are looked at only once a quarter of that has been added
        works = [side.watch(), access.run(), page.keep(), opcua.keep()]
        if line.operator.anonymous == "none":
            works.append(_tell_whether_anybody_can_come_in(users))
        await _until_one_ends(*works, stop.wait())
    finally:
        await finish(_close(saying.close, mailbox.close, served_opcua.stop, served_page.stop))


async def _close(*closes: Callable[[], Awaitable[None]]) -> None:
    """The last first; one that fails keeps no other from it."""
    async with AsyncExitStack() as stack:
        for close in closes:
            stack.push_async_callback(close)


async def _tell_whether_anybody_can_come_in(users: UsersFile) -> None:
    """At first only where nobody can; then each time that it changes. Never ends."""
    nobody = False
    while True:
        before, nobody = nobody, not users.known.entries()
        if nobody and not before:
            _tell("nobody can come in yet: `r2rgate users add LINE.toml NAME --role ROLE` lets somebody")
        elif before and not nobody:
            _tell("somebody can come in now")
        await asyncio.sleep(USERS_S)


async def _until_one_ends(*works: Coroutine[object, object, object]) -> None:
    """What has failed is told, and the process started again."""
    tasks = [asyncio.create_task(work) for work in works]
    done: set[asyncio.Task[object]] = set()
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        await finish_all(end(task) for task in tasks if task not in done)
    for task in done:
        task.result()


def checked_by(users: UsersFile, tell: Callable[[str], None]) -> Callable[[str, str], Awaitable[Role | None]]:
    """Names and passwords against the users' file, off the event loop: a guess takes some 50 ms."""

    def checked(name: str, password: str) -> Role | None:
        try:
            return users.current().check(name, password)
        except UsersRefused as refused:
            tell(f"nobody can log in: {refused}")
            return None

    async def check(name: str, password: str) -> Role | None:
        role = await asyncio.to_thread(checked, name, password)
        for _ in range(MOST_LOOKS):
            if role is None or users.role_of(name) is not None:
                break
            await asyncio.sleep(LOOK_S)  # added a moment ago: who is not known yet would be put out at once
        return role

    return check


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
