"""Where the files of a line lie: a folder a line, site_line, in the first base for sockets that may be written.

No name has an underscore, so that no two lines share a folder. Earlier versions said site-line, which a-b/c and a/b-c
share: such a folder goes on being used where it lies, by the line that has taken it first.
"""

import os
from contextlib import suppress
from pathlib import Path

from gateway.core.line import Line
from gateway.files import NotText, read_text
from gateway.mailbox.connection import dial
from gateway.mailbox.who_serves import ServedByStranger

GATEWAY_SOCKET = "gateway.sock"
BUS_SOCKET = "bus.sock"  #: the agents'
LOOP_SOCKET = "loop.sock"
TAKEN_BY = "line"  #: file in a folder of an earlier version: whose it is, as site/line
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
    return folder_in(run_base(), line.site, line.line)


def folder_in(base: Path, site: str, line: str) -> Path:
    """The line's folder in `base`, which may not be there yet."""
    own, earlier = base / f"{site}_{line}", base / f"{site}-{line}"
    if os.path.exists(own) or not os.path.isdir(earlier) or _taken_by(earlier) not in ("", f"{site}/{line}"):
        return own
    return earlier


def take(folder: Path, site: str, line: str) -> None:
    """Keep a folder of an earlier version for this line, whose name is not its alone."""
    if folder.name == f"{site}-{line}" and folder.name.count("-") > 1:
        with suppress(OSError), (folder / TAKEN_BY).open("x", encoding="ascii") as file:
            file.write(f"{site}/{line}\n")


def _taken_by(folder: Path) -> str:
    """As site/line; empty: no line has taken it."""
    try:
        return read_text(folder / TAKEN_BY, 200).strip()
    except (OSError, NotText):
        return ""


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
