"""What a result says of its own making: when, by which command, on which computer, with which libraries."""

import os
import platform
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path


def now_iso() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def command_line() -> str:
    return " ".join(["r2rgate", *sys.argv[1:]])


def machine() -> str:
    system = f"{platform.system()} {platform.release()}, {platform.machine()}"
    return f"{os.cpu_count() or 1} processors, {system}, Python {platform.python_version()}"


def versions_of(libraries: Sequence[str]) -> dict[str, str]:
    """Raises importlib.metadata.PackageNotFoundError."""
    return {name: version(name) for name in libraries}


def machine_lines(log: Path) -> list[str]:
    """What this computer is, and what it granted the loop, in the loop's own words."""
    said = log.read_text(errors="replace").splitlines() if log.exists() else []
    silent = next((number for number, text in enumerate(said) if "is SILENT" in text), -1)  # before: of line and wiring
    return [machine(), *said[silent + 1 :]]
