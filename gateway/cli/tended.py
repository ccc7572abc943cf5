"""A child of `run`: started again when it ends, with growing pauses; what it said last is kept for the screen."""

import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from signal import Signals

from gateway.cli.lifetime import end, start
from gateway.core.line_problem import printable

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 10.0
LAST_LINES = 8
_LONGEST_TAIL_BYTES = 20_000
#: Exit codes that starting again cannot mend: refused, and already running.
FINAL = (2, 3)


@dataclass(frozen=True, slots=True)
class Exit:
    """How a child ended, in words that stand on their own."""

    name: str
    code: int
    count: int  #: how often it has ended by now
    at_s: float  #: monotonic
    log: Path
    tail: list[str]  #: the last lines that it wrote
    is_needed: bool = True  #: False: the line does without it, whatever it is refused

    @property
    def is_final(self) -> bool:
        return self.is_needed and self.code in FINAL

    def lines(self) -> list[str]:
        """The headline and the last words, one line each."""
        return [self.headline(), f"  the end of {self.log}:", *(f"    {text}" for text in self.tail)]

    def headline(self) -> str:
        """Its name and exit code."""
        how = f"was killed by {Signals(-self.code).name}" if self.code < 0 else f"has ended with exit code {self.code}"
        often = f", {self.count} times by now" if self.count > 1 else ""
        again = "" if self.is_final else "; it is started again"
        return f"{self.name} {how}{often}{again}"


@dataclass(slots=True)
class Child:
    """One process and when it may be started (again)."""

    name: str
    arguments: Callable[[], list[str]]  #: asked for at every start
    log: Path
    is_needed: bool = True
    ended: int = 0
    _process: subprocess.Popen[str] | None = None
    _pause_s: float = FIRST_PAUSE_S
    _due_s: float = 0.0
    _log_start: int = 0  #: where in the log the words of this start begin

    def tend(self, now_s: float) -> Exit | None:
        """Start it when it is due. Returns its exit once, when it has ended."""
        if self._process is not None:
            code = self._process.poll()
            if code is None:
                if now_s - self._due_s > LONGEST_PAUSE_S:
                    self._pause_s = FIRST_PAUSE_S
                return None
            self._process = None
            self._due_s = now_s + self._pause_s
            self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)
            self.ended += 1
            return Exit(self.name, code, self.ended, now_s, self.log, self.said()[-LAST_LINES:], self.is_needed)
        if now_s >= self._due_s:
            self._due_s = now_s
            self._log_start = self.log.stat().st_size if self.log.exists() else 0
            self._process = start([self.name, *self.arguments()], self.log)
        return None

    def said(self) -> list[str]:
        """The complete lines that it has written since its last start, or the last of very many."""
        if not self.log.exists():
            return []
        with self.log.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(self._log_start, size - _LONGEST_TAIL_BYTES))
            text = file.read().decode("utf-8", "replace")
        return [printable(line.replace("\t", "    ")) for line in text.split("\n")[:-1] if line.strip()]

    def end(self, patience_s: float) -> None:
        """SIGTERM, and SIGKILL after `patience_s`."""
        if self._process is not None:
            end(self._process, patience_s)
