"""The stand-in on a socket: HTTP/1.1, a chunk for each line, connections kept; no more of HTTP than is needed."""

import asyncio
import socket
from http import HTTPStatus
from types import TracebackType
from typing import Self

from tests.stand_in.engine import Engine, HangUp, Response


class StandIn:
    """`async with StandIn(engine) as server`: `server.url` answers until the end of the block. Port 0: a free one."""

    def __init__(self, engine: Engine, host: str = "127.0.0.1", port: int = 0) -> None:
        self.engine = engine
        self._address = (host, port)
        self._serving: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._connected, *self._address)
        self.port = int(self._server.sockets[0].getsockname()[1])
        self.url = f"http://{self._address[0]}:{self.port}"
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Raises what went wrong in the stand-in itself."""
        self._server.close()
        for task in self._serving:
            task.cancel()
        for ended in await asyncio.gather(*self._serving, return_exceptions=True):
            if isinstance(ended, Exception):
                raise ended

    def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._serving.append(asyncio.get_running_loop().create_task(self._serve(reader, writer)))

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # Without this each small line waits for the peer to acknowledge the one before.
        writer.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            while (request := await _request(reader)) is not None:
                await _respond(writer, self.engine.handle(*request))
        except HangUp:
            writer.transport.abort()
        except ConnectionError:
            pass  # the client went
        finally:
            writer.close()


async def _request(reader: asyncio.StreamReader) -> tuple[str, str, bytes] | None:
    """Method, path and body; None where the peer has nothing more to ask."""
    try:
        head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").split("\r\n")
    except (asyncio.IncompleteReadError, ConnectionError):
        return None
    method, path, _ = head[0].split(" ", 2)
    headers = dict(line.lower().split(": ", 1) for line in head[1:] if line)
    body = await reader.readexactly(int(headers.get("content-length", "0")))
    return method, path, body


async def _respond(writer: asyncio.StreamWriter, response: Response) -> None:
    status = HTTPStatus(response.status)
    head = f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Type: {response.content_type}\r\n"
    writer.write(f"{head}Transfer-Encoding: chunked\r\n\r\n".encode())
    async for part in response.parts:
        writer.write(b"%x\r\n%b\r\n" % (len(part), part))
        await writer.drain()
    writer.write(b"0\r\n\r\n")
    await writer.drain()
