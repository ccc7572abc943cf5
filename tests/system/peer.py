"""Programs in JavaScript on foreign protocol stacks, and the test's own wire into them."""

import json
import os
import select
import subprocess
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from tests.bench.live import SIM_PRIORITY

FOLDER = Path(__file__).parent / "peers"
ANSWER_S = 60.0  #: node-opcua takes a while to start, the longer on a machine that has just installed it


class PeerFailed(Exception):
    """The peer has ended, or does not answer; the text holds the end of what it said."""


class Spoken:
    """A context: `peer("state")` asks, `peer("fault", 1, "freeze")` commands. See the script's own list of deeds."""

    def __init__(self, script: str, *arguments: object, log: Path) -> None:
        self._log = log
        with log.open("wb") as sink:
            self._process = subprocess.Popen(
                ["node", FOLDER / script, *map(str, arguments)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=sink, bufsize=0,
            )  # fmt: skip
        self._received = b""
        self.ready: dict[str, Any] = {}

    def __enter__(self) -> Self:
        try:
            self.begin()
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def __call__(self, deed: str, *arguments: object) -> Any:
        """Do it; returns what the peer answers. Raises PeerFailed."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps([deed, *arguments]).encode() + b"\n")
        return self._answer()

    def begin(self) -> None:
        """Wait until it says that it is ready."""
        self.ready = self._answer()

    @property
    def pid(self) -> int:
        return self._process.pid

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        while b"\n" not in self._received:
            readable, _, _ = select.select([self._process.stdout], [], [], ANSWER_S)
            piece = os.read(self._process.stdout.fileno(), 65536) if readable else b""
            if not piece:
                tail = self._log.read_text(errors="replace")[-2000:]
                raise PeerFailed(f"the peer {'has ended' if readable else 'does not answer'}:\n{tail}")
            self._received += piece
        line, _, self._received = self._received.partition(b"\n")
        return json.loads(line)

    def _end(self) -> None:
        """It ends with its standard input; if not, it is ended."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()


class Peer(Spoken):
    """A server in place of devices."""

    def begin(self) -> None:
        """Devices do not wait for a busy computer. Below the loop, as the simulated line."""
        super().begin()
        for thread in Path(f"/proc/{self.pid}/task").iterdir():
            os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(SIM_PRIORITY))
