"""Faults of a line that runs, by way of a unix socket: one JSON object a line, one answer to each.

    {"do": "inject", "fault": "load-cell 3 nan for 0.2"}    {"ok": true, "number": 4, "time_s": 12.503}
    {"do": "clear", "number": 4}                            {"ok": true, "numbers": [4], "time_s": 12.6}
    {"do": "clear"}                                         all of them
    {"do": "list"}                                          {"ok": true, "time_s": 12.6, "faults": [{...}]}

What is refused is answered {"ok": false, "reason": "..."}. The socket is the user's alone (0600).
"""

import asyncio
import json
import socket
import stat
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sim_plant.faults.injector import Injector
from sim_plant.faults.parse import FaultRefused, parse_fault

SOCKET_FILE = "control.sock"  #: in the folder of the recording, unless told otherwise
LONGEST_LINE = 4096
MAX_CONNECTIONS = 8
_LONGEST_PATH = 107  #: bytes that the system has room for
_TIMEOUT_S = 3.0

Message = dict[str, Any]


class ControlUnavailable(Exception):
    """The socket cannot be opened, or nobody answers on it. The text says why and what to do."""


class ControlServer:
    """Answers in the running event loop. `clock` gives world time, with the world advanced to it."""

    def __init__(self, injector: Injector, clock: Callable[[], float]) -> None:
        self._injector = injector
        self._clock = clock
        self._path: Path | None = None
        self._server: asyncio.Server | None = None
        self._connections: set[asyncio.StreamWriter] = set()

    async def open(self, path: Path) -> None:
        """Listen on a path; a socket there that nobody listens on is replaced. Raises ControlUnavailable."""
        listening = _listen(path)
        self._path = path
        self._server = await asyncio.start_unix_server(self._serve, sock=listening, limit=LONGEST_LINE)

    async def close(self) -> None:
        """Stop, and take the socket away. Idempotent."""
        server, self._server = self._server, None
        path, self._path = self._path, None
        if server is not None:
            server.close()
            for writer in list(self._connections):
                writer.transport.abort()
        if path is not None:
            path.unlink(missing_ok=True)
        if server is not None:
            await server.wait_closed()

    def answer(self, line: bytes) -> Message:
        """The answer to one line."""
        try:
            request = json.loads(line)
            if not isinstance(request, dict):
                raise FaultRefused("a request is a JSON object")
            return {"ok": True, **self._do(request), "time_s": self._clock()}
        except FaultRefused as refused:
            return {"ok": False, "reason": str(refused)}
        except (ValueError, RecursionError) as error:
            return {"ok": False, "reason": f"that is no JSON: {error}"}

    def _do(self, request: Message) -> Message:
        now_s = self._clock()
        match request:
            case {"do": "inject", "fault": str(text), **rest} if not rest:
                return {"number": self._injector.add(parse_fault(text), now_s)}
            case {"do": "clear", "number": int(number), **rest} if not rest and number is not True:
                return {"numbers": self._injector.clear(number, now_s)}
            case {"do": "clear", **rest} if not rest:
                return {"numbers": self._injector.clear(None, now_s)}
            case {"do": "list", **rest} if not rest:
                return {"faults": [asdict(listed) for listed in self._injector.listed()]}
            case _:
                raise FaultRefused('allowed: "do" with inject (and fault), clear (and number, or all) or list')

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._connections) >= MAX_CONNECTIONS:
            writer.transport.abort()
            return
        self._connections.add(writer)
        try:
            while line := await reader.readline():
                writer.write(json.dumps(self.answer(line)).encode() + b"\n")
                await writer.drain()
        except (ValueError, ConnectionError):  # a line that is too long; a client that has gone
            pass
        finally:
            self._connections.discard(writer)
            writer.transport.abort()


def ask(path: Path, request: Message, timeout_s: float = _TIMEOUT_S) -> Message:
    """Ask a line that runs, and wait for its answer. Raises ControlUnavailable."""
    _check_path(path)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(timeout_s)
        try:
            connection.connect(str(path))
            connection.sendall(json.dumps(request).encode() + b"\n")
            with connection.makefile("rb") as answers:
                line = answers.readline()
        except OSError as error:
            why = error.strerror or str(error)
            raise ControlUnavailable(f"no simulated line answers on {path}: {why}. Is it running?") from error
    try:
        answer = json.loads(line)
    except ValueError as error:
        raise ControlUnavailable(f"what answers on {path} is no simulated line") from error
    if not isinstance(answer, dict) or not isinstance(answer.get("ok"), bool):
        raise ControlUnavailable(f"what answers on {path} is no simulated line")
    return answer


def _listen(path: Path) -> socket.socket:
    """A socket bound there, for this user alone. Raises ControlUnavailable."""
    _check_path(path)
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        _remove_dead(path)
        listening.bind(str(path))
        path.chmod(0o600)  # nobody is let in before it listens
    except OSError as error:
        listening.close()
        raise ControlUnavailable(f"the control socket {path} cannot be opened: {error.strerror or error}") from error
    except ControlUnavailable:
        listening.close()
        raise
    return listening


def _check_path(path: Path) -> None:
    size = len(bytes(path))
    if size > _LONGEST_PATH:
        raise ControlUnavailable(f"the control socket's path has {size} bytes, allowed are {_LONGEST_PATH}: {path}")


def _remove_dead(path: Path) -> None:
    """Take a socket away that nobody listens on. Raises ControlUnavailable for anything else that is there."""
    if not path.exists():
        return
    if not stat.S_ISSOCK(path.stat().st_mode):
        raise ControlUnavailable(f"{path} is there already and is no socket: choose another path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()
            return
        except OSError as error:
            raise ControlUnavailable(f"{path} cannot be used: {error.strerror}") from error
    raise ControlUnavailable(f"a simulated line runs already, with its control on {path}")
