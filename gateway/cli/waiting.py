"""Commands that take a while: progress on a terminal, none in a pipe, and an interruption without a traceback."""

import asyncio
import sys
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import typer
from rich.console import Console
from rich.text import Text

INTERRUPTED = 130  #: exit code, as shells have it: 128 and SIGINT

T = TypeVar("T")


@contextmanager
def progress() -> Iterator[Callable[[str], None]]:
    """Takes a sentence about what is done now; it is shown on standard error and overwritten by the next."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda text: None
        return
    with console.status("") as status:
        yield lambda text: status.update(Text(text))


@contextmanager
def interruptible(kept: str) -> Iterator[None]:
    """Ctrl-C in the block ends the program with exit code 130 and a line that says what is `kept` of the work."""
    try:
        yield
    except KeyboardInterrupt:
        print(f"interrupted: {kept}", file=sys.stderr)
        raise typer.Exit(INTERRUPTED) from None


def run_until_done(work: Coroutine[Any, Any, T]) -> T:
    """Run `work`; Ctrl-C ends it in order, and the program with exit code 130."""
    try:
        return asyncio.run(work)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise typer.Exit(INTERRUPTED) from None
