"""What a result says of its own making: when, by which command, on which computer."""

import platform
import sys
from datetime import UTC, datetime
from pathlib import Path


def now_iso() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def command_line() -> str:
    return " ".join(["r2rgate", *sys.argv[1:]])


def machine_lines(log: Path) -> list[str]:
    """What this computer is, and what it granted the loop, in the loop's own words."""
    kernel = f"{platform.system()} {platform.release()}, Python {platform.python_version()}"
    said = log.read_text(errors="replace").splitlines() if log.exists() else []
    return [kernel, *(text for text in said if "SILENT" not in text)]
