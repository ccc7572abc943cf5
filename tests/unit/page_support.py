"""A page with a fake gateway behind a real mailbox, and a browser of sorts before it."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

import httpx
from starlette.applications import Starlette

from gateway.core.line import Line
from gateway.mailbox.unix import UnixMailbox
from gateway.operator.line_side import TOPICS, LineSide
from gateway.operator.page.app import page_app
from gateway.operator.page.login import TOKEN_HEADER
from gateway.operator.users import RoleOf
from tests.operator.fake_line import PASSWORD, FakeGateway, check
from tests.operator.fake_line import role_of as role_of_anybody
from tests.unit.supervisor_support import line_of, short_folder, until

HERE = "http://127.0.0.1:8480"


@dataclass
class Page:
    line: Line
    gateway: FakeGateway
    gateway_mailbox: UnixMailbox
    side: LineSide
    app: Starlette
    browser: httpx.AsyncClient

    async def log_in(self, name: str = "operator") -> httpx.Response:
        """The browser carries the session's token from then on."""
        answer = await self.browser.post("/api/login", json={"name": name, "password": PASSWORD})
        assert answer.status_code == 200, answer.text
        self.browser.headers[TOKEN_HEADER] = answer.json()["token"]
        return answer

    async def say(self, command: str, **parts: object) -> httpx.Response:
        return await self.browser.post("/api/say", json={"command": command, **parts})


@asynccontextmanager
async def page(
    spans: int = 3,
    clock: Callable[[], float] = time.monotonic,
    watched: bool = True,
    role_of: RoleOf = role_of_anybody,
    **operator: str,
) -> AsyncIterator[Page]:
    """`operator`: keys of that table of the line's file."""
    line = line_of(spans)
    line = line.model_copy(update={"operator": line.operator.model_copy(update=operator)})
    base = line.operator.page
    with short_folder() as folder:
        served, asked = UnixMailbox(), UnixMailbox()
        gateway = FakeGateway(line, served)
        await served.listen(folder / "gateway.sock")
        asked.connect(TOPICS, folder / "gateway.sock")
        side = LineSide(asked)
        app = page_app(line, side, check, role_of, clock)
        watching = asyncio.create_task(side.watch()) if watched else None
        try:
            if watched:
                await until(lambda: side.status is not None and side.proposals is not None)
            transport = httpx.ASGITransport(app)
            async with httpx.AsyncClient(transport=transport, base_url=base, headers={"origin": base}) as browser:
                yield Page(line, gateway, served, side, app, browser)
        finally:
            if watching is not None:
                watching.cancel()
                await asyncio.gather(watching, return_exceptions=True)
            await asked.close()
            await served.close()
