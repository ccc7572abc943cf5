"""Live progress of the demonstration: one line that moves on a terminal, a line every few seconds elsewhere."""

import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.text import Text

from gateway.core.status import GatewayStatus

PLAIN_EVERY_S = 5.0


class Progress:
    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
        self._step = ""
        self._began_s = time.monotonic()
        self._step_began_s = self._began_s
        self._case_s = 0.0  #: length of the case that runs; 0 when none does
        self._plain_due_s = 0.0

    def __enter__(self) -> Self:
        if self._live:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live:
            self._live.stop()

    def step(self, text: str) -> None:
        """What is done from now on."""
        self._begin(text, 0.0)

    def case(self, title: str, duration_s: float) -> None:
        self._begin(title, duration_s)

    def show(self, status: GatewayStatus) -> None:
        line = self._line(status)
        if self._live:
            self._live.update(Text(line, no_wrap=True, overflow="ellipsis"), refresh=True)
        elif time.monotonic() >= self._plain_due_s and self._case_s:
            self._plain_due_s = time.monotonic() + PLAIN_EVERY_S
            self._console.print(line, markup=False, soft_wrap=True)

    def _begin(self, text: str, duration_s: float) -> None:
        now_s = time.monotonic()
        self._step, self._step_began_s, self._case_s = text, now_s, duration_s
        self._plain_due_s = now_s + PLAIN_EVERY_S
        self._console.print(f"[{now_s - self._began_s:5.1f} s] {text}", markup=False, soft_wrap=True)

    def _line(self, status: GatewayStatus) -> str:
        elapsed_s = time.monotonic() - self._step_began_s
        where = f"{min(elapsed_s, self._case_s):4.1f}/{self._case_s:g} s" if self._case_s else f"{elapsed_s:4.1f} s"
        tensions = " ".join("   --" if s.tension_n is None else f"{s.tension_n:5.1f}" for s in status.spans)
        speed = status.unwind_speed_m_per_s
        moving = "" if speed is None else f"  v0 {speed:.3f} m/s"
        return f"          {where:>9}  {status.loop.state:<6} T {tensions} N{moving}"
