"""The processes of a demonstration: simulated line, gateway, loop, agents, operator; started and ended in order."""

import json
import shutil
import socket
import subprocess
import tempfile
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from gateway.cli.lifetime import end, start, uninterrupted

IN_ORDER = ("loop", "operator", "agents", "gateway", "sim")  #: in which they are ended
STOP_TIME_S = 15.0  #: for the loop's controlled stop


class ChildFailed(Exception):
    """A process that ended or did not become ready; the text holds the end of its log."""


class Children:
    """A context: whatever happens inside, no process and no socket folder is left behind."""

    def __init__(self, logs: Path, sockets: Path | None = None) -> None:
        """`sockets`: the folder in which that of the sockets is made; None: one where no command looks by itself."""
        self.logs = logs
        # Socket paths are limited to 107 bytes, wherever the output folder lies.
        self.run_folder = Path(tempfile.mkdtemp(prefix="r2rgate-", dir=sockets))
        self._running: dict[str, subprocess.Popen[str]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with uninterrupted(), ExitStack() as ends:  # each, though ending another fails
            ends.callback(shutil.rmtree, self.run_folder, ignore_errors=True)
            for name in reversed(IN_ORDER):
                ends.callback(self.end, name)

    def start(self, name: str, *arguments: str | Path) -> None:
        self._running[name] = start([name, *map(str, arguments)], self.log(name))

    def start_sim(self, *arguments: str | Path) -> dict[str, Any]:
        """Start the simulated line and wait until its wires are open. Returns what it says of itself."""
        child = start(["sim", *map(str, arguments)], self.log("sim"), stdout=subprocess.PIPE)
        self._running["sim"] = child
        assert child.stdout is not None
        line = child.stdout.readline()
        if not line:
            child.wait()
            raise ChildFailed(self.story("sim"))
        return json.loads(line)

    def check(self) -> None:
        """Raises ChildFailed when one has ended."""
        for name, child in self._running.items():
            if child.poll() is not None:
                raise ChildFailed(self.story(name))

    def end(self, name: str) -> int:
        """End it in order: the loop stops the line first. Returns its exit code; 0 when it was never started."""
        child = self._running.get(name)
        if child is None:
            return 0
        code = end(child, STOP_TIME_S)
        del self._running[name]  # now: an end that was interrupted is made up for
        if child.stdout is not None:
            child.stdout.close()
        return code

    def pid(self, name: str) -> int:
        return self._running[name].pid

    def log(self, name: str) -> Path:
        return self.logs / f"{name}.log"

    def story(self, name: str) -> str:
        child = self._running.get(name)
        code = child.returncode if child is not None else "unknown"
        tail = "\n".join("    " + text for text in self.log(name).read_text(errors="replace").splitlines()[-12:])
        return f"{name} has ended with exit code {code}; the end of {self.log(name)}:\n{tail}"


def free_tcp_ports(count: int) -> list[int]:
    """Ports of this machine's loopback on which nobody listens now."""
    with ExitStack() as probes:
        return [probes.enter_context(socket.create_server(("127.0.0.1", 0))).getsockname()[1] for _ in range(count)]


def free_udp_port() -> int:
    """A UDP port that nobody on this machine uses now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return probe.getsockname()[1]
