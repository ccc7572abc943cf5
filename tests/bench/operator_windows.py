"""What bench-operator runs beside a line, and what it has seen of it."""

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gateway.cli.children import ChildFailed
from gateway.cli.lifetime import end
from tests.bench.slices import TICKS_PER_S, cpu_s, memory_mb

SAMPLE_S = 0.25  #: between two looks at the memory


class Beside:
    """Other processes beside the line."""

    def __init__(self) -> None:
        self._running: list[subprocess.Popen[str]] = []

    def begin(self, *words: str, told: Path | None = None) -> None:
        """`python -m WORDS`, once it says that it is ready; the rest of what it says to `told`."""
        child = subprocess.Popen(
            [sys.executable, "-m", *words], text=True,
            stdout=subprocess.PIPE if told is None else told.open("w", encoding="utf-8"),
        )  # fmt: skip
        self._running.append(child)
        if told is not None:
            while not told.read_text(encoding="utf-8"):
                time.sleep(0.05)  # between two looks
                assert child.poll() is None, f"{words} has ended"
        elif child.stdout is not None and not child.stdout.readline():
            raise ChildFailed(f"{words} has ended with exit code {child.wait()}")

    def used_s(self) -> float:
        """Of processors, by all of them and by what they have started and seen end."""
        return sum(cpu_s(child.pid) + _of_children_s(child.pid) for child in self._running)

    def end(self) -> list[str]:
        """What each has said at its end."""
        for child in self._running:
            child.terminate()
        told: list[str] = []
        for child in self._running:
            end(child, 20.0)
            if child.stdout is not None:
                told.append(child.stdout.read().strip())
                child.stdout.close()
        self._running.clear()
        return told


@dataclass
class Turn:
    """Monotonic times; shares of one processor."""

    case: str
    begin_s: float
    end_s: float
    others_share: float  #: of those who attack
    operator_share: float
    told: list[str]  #: by those who attack


@dataclass
class Found:
    turns: list[Turn] = field(default_factory=list[Turn])
    memory: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])  #: monotonic time, MB
    deeds: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])  #: of the honest client
    state: str = ""  #: of the line at the end
    why: list[str] = field(default_factory=list[str])  #: what has happened to it last

    def of(self, case: str) -> list[Turn]:
        return [turn for turn in self.turns if turn.case == case]

    def took_s(self, case: str, kind: str) -> list[float]:
        """By the honest client's deeds of that kind in that case; what failed took for ever."""
        return [
            one["took_s"] if not one["why"] else float("inf")
            for one in self.deeds
            if one["kind"] == kind and any(turn.begin_s <= one["at_s"] < turn.end_s for turn in self.of(case))
        ]


@contextmanager
def memory_watched(pid: int, into: list[tuple[float, float]]) -> Iterator[None]:
    """Within, `into` gets monotonic time and MB."""
    over = threading.Event()

    def watch() -> None:
        while not over.wait(SAMPLE_S):
            into.append((time.monotonic(), memory_mb(pid, "VmRSS")))

    into.append((time.monotonic(), memory_mb(pid, "VmRSS")))
    watching = threading.Thread(target=watch)
    watching.start()
    try:
        yield
    finally:
        over.set()
        watching.join()


def _of_children_s(pid: int) -> float:
    """Of processors, by children that have ended and were waited for."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[13:15]
    return (int(user) + int(system)) / TICKS_PER_S
