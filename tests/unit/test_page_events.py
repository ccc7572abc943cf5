"""The stream of ticks, over real sockets: what it tells, that it never queues up, how many may look, and its ends."""

import asyncio
import json
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import httpx
import pytest

from gateway.core.people import Role
from gateway.operator.page import login, serve
from gateway.operator.page.events import MOST_BROWSERS, Ticks
from gateway.operator.page.login import TOKEN_HEADER
from gateway.operator.page.serve import serve_on
from gateway.operator.users import RoleOf
from tests.operator.fake_line import PASSWORD, alarm
from tests.operator.fake_line import role_of as role_of_anybody
from tests.unit.page_support import Page, page
from tests.unit.supervisor_support import until


class Stream:
    """A browser's end of /events, on a socket of its own."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer
        self.status = 0

    async def begin(self) -> "Stream":
        head = await self._reader.readuntil(b"\r\n\r\n")
        self.status = int(head.split()[1])
        return self

    async def next(self) -> tuple[str, dict[str, Any]]:
        """Kind and data. Lines of the chunked encoding lie between those of the events."""
        kind = ""
        while True:
            line = (await self._reader.readuntil(b"\n")).strip()
            if line.startswith(b"event: "):
                kind = line[7:].decode()
            elif line.startswith(b"data: "):
                return kind, json.loads(line[6:])

    async def until(self, kind: str) -> dict[str, Any]:
        while True:
            found, data = await self.next()
            if found == kind:
                return data

    async def close(self) -> None:
        self._writer.close()
        await asyncio.gather(self._writer.wait_closed(), return_exceptions=True)


class Served:
    """A page on a port of its own."""

    def __init__(self, there: Page, listener: socket.socket) -> None:
        self.there = there
        self.port = listener.getsockname()[1]
        self.serving = asyncio.create_task(serve_on(there.app, listener))
        self.cookie = ""
        self.streams: list[Stream] = []

    async def log_in(self) -> httpx.Response:
        base = f"http://127.0.0.1:{self.port}"
        async with httpx.AsyncClient(base_url=base, headers={"origin": base}) as browser:
            answer = await browser.post("/api/login", json={"name": "viewer", "password": PASSWORD})
        self.cookie = answer.headers["set-cookie"].partition(";")[0]
        return answer

    async def log_out(self, token: str) -> None:
        base = f"http://127.0.0.1:{self.port}"
        headers = {"origin": base, "cookie": self.cookie, TOKEN_HEADER: token}
        async with httpx.AsyncClient(base_url=base, headers=headers) as browser:
            assert (await browser.post("/api/logout", json={})).status_code == 200

    async def look(self, receive_bytes: int | None = None, source: str = "127.0.0.1", named: bool = True) -> Stream:
        here = socket.socket()
        here.bind((source, 0))
        if receive_bytes is not None:
            here.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_bytes)
        here.setblocking(False)
        await asyncio.get_running_loop().sock_connect(here, ("127.0.0.1", self.port))
        reader, writer = await asyncio.open_connection(sock=here, limit=65_536)
        cookie = f"cookie: {self.cookie}\r\n" if named else ""
        writer.write(f"GET /events HTTP/1.1\r\nhost: 127.0.0.1\r\n{cookie}\r\n".encode())
        stream = Stream(reader, writer)
        self.streams.append(stream)
        return await stream.begin()


@asynccontextmanager
async def served(
    spans: int = 3, watched: bool = True, role_of: RoleOf = role_of_anybody, **operator: str
) -> AsyncIterator[Served]:
    async with page(spans, watched=watched, role_of=role_of, **operator) as there:
        listener = socket.create_server(("127.0.0.1", 0))
        found = Served(there, listener)
        try:
            await found.log_in()
            yield found
        finally:
            for stream in found.streams:
                await stream.close()
            found.serving.cancel()
            await asyncio.gather(found.serving, return_exceptions=True)


def test_a_tick_tells_what_the_gateway_tells():
    async def story() -> None:
        async with served() as at:
            at.there.gateway.alarms = [alarm()]
            at.there.gateway.off_n[1] = 9.0
            stream = await at.look()
            tick = await stream.until("tick")
            while not tick["alarms"]:
                tick = await stream.until("tick")
            assert tick["loop"]["state"] == "RUN" and tick["alarms"][0]["name"] == "device-absent"
            assert [span[4] for span in tick["spans"]] == ["", "attention", ""]
            assert tick["waiting"] == [at.there.gateway.hash]

    asyncio.run(story())


def test_a_tick_tells_when_proposals_are_others_than_before():
    async def story() -> None:
        async with served() as at:
            stream = await at.look()
            before = await stream.until("tick")
            at.there.gateway.stage = "expired"
            after = await stream.until("tick")
            while after["revision"] == before["revision"]:
                assert after["waiting"] == before["waiting"]
                after = await stream.until("tick")
            assert after["waiting"] == []

    asyncio.run(story())


def test_all_who_look_get_the_same_and_it_goes_on():
    async def story() -> None:
        async with served() as at:
            one, other = await at.look(), await at.look()
            first = await one.until("tick")
            while (second := await other.until("tick"))["wall_s"] < first["wall_s"]:
                pass
            while first["wall_s"] < second["wall_s"]:
                first = await one.until("tick")
            assert first == second
            assert (await one.until("tick"))["wall_s"] > first["wall_s"]

    asyncio.run(story())


@pytest.mark.slow
def test_who_does_not_read_gets_the_newest_later_and_nothing_queues_up():
    ticks = 4000

    async def story() -> None:
        async with served(spans=60, watched=False) as at:
            stream = await at.look(receive_bytes=4096)
            status = at.there.gateway.status()
            for i in range(ticks):
                for tell in at.there.side.on_status:
                    tell(status.model_copy(update={"wall_s": float(i)}))
                await asyncio.sleep(0)
            count, last = 0, -1.0
            while last < ticks - 1:
                data = await stream.until("tick")
                assert data["wall_s"] > last  # some are left out, none comes twice or late
                count, last = count + 1, data["wall_s"]
            assert count < ticks / 2

    asyncio.run(story())


def test_a_browser_that_takes_nothing_any_more_frees_its_place(monkeypatch: pytest.MonkeyPatch):
    """It may never say that it is gone: a tablet that was switched off."""
    monkeypatch.setattr(serve, "UNHEARD_MS", 300)

    async def story() -> None:
        async with served(spans=60) as at:
            stream = await at.look(receive_bytes=4096)
            ticks: Ticks = at.there.app.state.end.__self__
            assert stream.status == 200 and ticks.looking == 1
            await until(lambda: ticks.looking == 0)  # nobody reads the stream: it takes what fits into it, and no more

    asyncio.run(story())


def test_a_gateway_that_is_away_is_told_while_it_is():
    async def story() -> None:
        async with served() as at:
            stream = await at.look()
            await stream.until("tick")
            await at.there.gateway_mailbox.close()
            away = await stream.until("away")
            while not away["trouble"]:
                away = await stream.until("away")
            assert away["age_s"] > 0.0

    asyncio.run(story())


def test_no_more_look_than_can_and_a_place_becomes_free_again():
    async def story() -> None:
        async with served() as at:
            streams = [await at.look() for _ in range(MOST_BROWSERS)]
            assert {stream.status for stream in streams} == {200}
            assert (await at.look()).status == 503
            await streams[0].close()

            async def free() -> bool:
                return (await at.look()).status == 200

            while not await free():
                pass

    asyncio.run(story())


def test_one_place_does_not_keep_those_of_another_from_looking():
    async def story() -> None:
        async with served() as at:
            streams = [await at.look() for _ in range(MOST_BROWSERS)]
            assert (await at.look(source="127.0.0.2")).status == 200
            await streams[0].until("anew")
            assert (await at.look()).status == 503
            assert at.there.app.state.end.__self__.looking == MOST_BROWSERS

    asyncio.run(story())


def test_whoever_has_logged_in_looks_before_those_without_a_name():
    async def story() -> None:
        async with served(anonymous="read") as at:
            streams = [await at.look(named=False) for _ in range(MOST_BROWSERS)]
            assert (await at.look(named=False, source="127.0.0.2")).status == 503  # they would put each other out
            assert (await at.look()).status == 200
            await streams[0].until("anew")

    asyncio.run(story())


@pytest.mark.parametrize("role", [None, "engineer"])
def test_whoever_has_another_role_or_none_loads_the_page_anew(role: Role | None, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(login, "LOOK_UP_S", 0.0)
    roles: dict[str, Role | None] = {"viewer": "viewer"}

    async def story() -> None:
        async with served(role_of=roles.get) as at:
            stream = await at.look()
            await stream.until("tick")
            roles["viewer"] = role
            await stream.until("anew")

    asyncio.run(story())


def test_the_stream_ends_with_the_session():
    async def story() -> None:
        async with served() as at:
            token = (await at.log_in()).json()["token"]
            stream = await at.look()
            await stream.until("tick")
            await at.log_out(token)
            await stream.until("anew")
            assert (await at.look()).status == 401

    asyncio.run(story())


def test_streams_end_with_the_process():
    async def story() -> None:
        async with served() as at:
            stream = await at.look()
            await stream.until("tick")
            at.serving.cancel()
            with pytest.raises(asyncio.IncompleteReadError):
                while True:
                    assert (await stream.next())[0] == "tick"
            await asyncio.gather(at.serving, return_exceptions=True)

    asyncio.run(story())


def test_while_nobody_looks_nothing_is_made():
    async def story() -> None:
        async with served(watched=False) as at:
            for tell in at.there.side.on_status:
                tell(at.there.gateway.status())
            stream = await at.look()
            kind, data = await stream.next()
            assert (kind, data["age_s"]) == ("away", None)

    asyncio.run(story())


def test_a_new_stream_does_not_begin_with_what_was_made_for_others_before():
    async def story() -> None:
        async with served(watched=False) as at:
            before = await at.look()
            assert (await before.next())[0] == "away"
            for tell in at.there.side.on_status:
                tell(at.there.gateway.status())
            await before.until("tick")
            assert (await (await at.look()).next())[0] == "away"

    asyncio.run(story())
