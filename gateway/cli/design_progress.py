"""Phase 1 while it works: a bar per architecture, with the cost of the best so far."""

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn
from rich.progress import Progress as Bars

from gateway.commissioning.decisions import RULES
from gateway.commissioning.records import Attempt, DecisionRecord
from gateway.core.line_problem import printable

BESIDE_A_BAR = 48  #: characters


class Progress:
    """Lines of plain text where the output is no terminal; nothing at all when quiet."""

    def __init__(self, names: list[str], iterations: int, quiet: bool) -> None:
        console = Console(stderr=True, quiet=quiet, highlight=False)
        self._console = console
        self._bars = Bars(
            TextColumn("{task.fields[law]:4}"), BarColumn(24), MofNCompleteColumn(), TextColumn("{task.fields[told]}"),
            console=console, disable=not console.is_terminal,
        )  # fmt: skip
        self._tasks: dict[str, TaskID] = {
            name: self._bars.add_task(name, total=iterations + 1, law=name, told="waiting") for name in names
        }
        self._best: dict[str, float] = {}
        self._said: set[str] = set()

    def __enter__(self) -> "Progress":
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def attempted(self, name: str, attempt: Attempt) -> None:
        if attempt.accepted and attempt.cost_n2s is not None:
            self._best[name] = attempt.cost_n2s
        best = f"J {self._best[name]:.2f} N2s" if name in self._best else f"not yet: {attempt.refused}"
        self._bars.update(self._tasks[name], completed=attempt.number + 1, told=best[:BESIDE_A_BAR])
        if not self._console.is_terminal and (attempt.accepted or attempt.number == 0):
            whose = "" if attempt.by == RULES else f" ({attempt.by})"
            self._console.print(f"{name} {attempt.number}{whose}: {best}", markup=False, soft_wrap=True)
        self._say_once(attempt.instead)

    def decided(self, decision: DecisionRecord) -> None:
        if decision.by != RULES:
            said = f"{decision.decision}: {decision.by} chooses {decision.option}: {printable(decision.reason)}"
            self._console.print(said, markup=False, soft_wrap=True)
        self._say_once(decision.instead)

    def _say_once(self, instead: str) -> None:
        """Why the rules have decided though somebody was asked."""
        if instead and instead not in self._said:
            self._said.add(instead)
            self._console.print(f"{printable(instead)}: the rules decide", markup=False, soft_wrap=True)
