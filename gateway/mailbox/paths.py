"""Where sockets and data of a line lie: one run folder a line, named site_line, under the first base that one
may write; one data folder a line, in which each process has its own, so that each can have a user of its own.
"""

import os
from pathlib import Path

from gateway.core.line import Line
from gateway.mailbox.dial import dial
from gateway.mailbox.who_serves import ServedByStranger

GATEWAY_SOCKET = "gateway.sock"
BUS_SOCKET = "bus.sock"  #: the agents'
LOOP_SOCKET = "loop.sock"
#: In the data folder of a line: what that process alone writes.
LOOP_DATA, GATEWAY_DATA, OPERATOR_DATA, AGENTS_DATA, SIM_DATA = "loop", "gateway", "operator", "agents", "sim"
CONTROLLER = "controller.json"  #: in `LOOP_DATA`: what `r2rgate loop` starts with
LOGS = "logs"  #: of `r2rgate run`
_SERVICE = Path("/run/r2rgate")  # made by the service manager for its user


def _bases() -> list[Path]:
    """Base folders in order of preference."""
    session = os.environ.get("XDG_RUNTIME_DIR")
    own = [Path(session) / "r2rgate"] if session else []
    return [*own, _SERVICE, Path(f"/tmp/r2rgate-{os.getuid()}")]


def _usable(base: Path) -> bool:
    """Whether the base may be written, or made in a folder that may."""
    return os.access(base if base.exists() else base.parent, os.W_OK | os.X_OK)


def default_run_folder(line: Line) -> Path:
    """$XDG_RUNTIME_DIR/r2rgate, else /run/r2rgate where it may be written, else /tmp/r2rgate-UID; then site_line."""
    return run_base() / name_of(line.site, line.line)


def name_of(site: str, line: str) -> str:
    """Of the line's folders: no name has an underscore, so that no two lines share one (a-b/c and a/b-c)."""
    return f"{site}_{line}"


def run_base() -> Path:
    """In which every command looks for lines that run; it need not exist."""
    *preferred, last = _bases()
    return next((base for base in preferred if _usable(base)), last)


def _folders_in(base: Path) -> list[Path]:
    """None where the base is not there, is no folder or may not be read."""
    try:
        return list(base.iterdir())
    except OSError:
        return []


def running_lines() -> list[Path]:
    """Run folders in which a gateway or a loop answers now that may serve a line, by name."""
    folders = {folder for base in _bases() for folder in _folders_in(base)}
    return sorted(folder for folder in folders if _answers(folder / GATEWAY_SOCKET) or _answers(folder / LOOP_SOCKET))


def _answers(path: Path) -> bool:
    try:
        dial(path).close()
    except BlockingIOError:  # so many wait to be taken that who it is cannot be asked now
        return True
    except (OSError, ServedByStranger):
        return False
    return True
