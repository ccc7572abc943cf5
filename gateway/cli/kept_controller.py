"""The controller that `run` designs by itself and keeps, for as long as the line is the one it was designed for.

Beside `controller.json` lies `controller.source.json`: what the design was made from, as a hash, and the hash of the
configuration. A `controller.json` without it, or one that does not match, somebody has put there: it is never replaced.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

from gateway.core.controller import ControllerRefused, canonical, config_hash, parse_controller
from gateway.core.line import Line
from gateway.files import MOST_BYTES, read_bytes
from gateway.mailbox.paths import CONTROLLER

SOURCE = "controller.source.json"


def source_hash(line: Line) -> str:
    """SHA-256 of what a design is made from: timing, limits, web, rollers, spans and the design point; not names."""
    source: dict[str, Any] = {
        "design": 3,  #: what designs are like; raised when they change
        "period_s": line.control.period_s,
        "latency_s": line.control.latency_s,
        "limits": line.limits.model_dump(),
        "web": line.web.model_dump(),
        "rollers": [roller.model_dump(exclude={"name"}) for roller in line.rollers],
        "spans": [span.model_dump(exclude={"name"}) for span in line.spans],
        "tension_n": line.recipes[0].tension_n,
    }
    return hashlib.sha256(json.dumps(source, sort_keys=True, allow_nan=False).encode()).hexdigest()


def kept_controller(line: Line, folder: Path) -> tuple[Path, str]:
    """The configuration to run `line` with, and a sentence about where it comes from ("" when it is as last time).

    An LQI on the line's nominal model is designed the first time, and anew when the line has changed since; the old
    one is then kept as controller-HASH.json. Raises DesignRefused and OSError.
    """
    from gateway.control.design import design_lqi, margins, require_margin, task_of

    path = folder / CONTROLLER
    kept_hash = _hash_of(path)
    source = _source(folder / SOURCE)
    wanted = source_hash(line)
    if path.exists() and (not source or source.get("controller") != kept_hash):
        return path, f"{path} is used: it was put there, not designed by run, and is never replaced"
    if path.exists() and source.get("made_from") == wanted:
        return path, ""
    task = task_of(line)
    config = design_lqi(task)
    require_margin(margins(config, task))
    if kept_hash == config_hash(config):  # what has changed does not matter to the design
        said = ""
    elif kept_hash:
        old = path.with_name(f"controller-{kept_hash[:12]}.json")
        path.replace(old)
        said = f"the line has changed: {path} is designed anew, on its nominal model; the one before is kept as {old}"
    else:
        said = f"{path}: an LQI designed on the line's nominal model"
    # The source first: interrupted in between, there is no controller, and the next start designs one.
    _write(folder / SOURCE, json.dumps({"made_from": wanted, "controller": config_hash(config)}).encode())
    _write(path, canonical(config))
    return path, said


def _hash_of(path: Path) -> str:
    """The hash of the configuration at `path`, as it is written where it cannot be read; "" where there is none."""
    try:
        payload = read_bytes(path, MOST_BYTES)
    except FileNotFoundError:
        return ""
    try:
        return config_hash(parse_controller(payload))
    except ControllerRefused:  # of another version of the format, say; what `run` has written it still knows
        return hashlib.sha256(payload).hexdigest()


def _source(path: Path) -> dict[str, Any]:
    try:
        source = json.loads(read_bytes(path, MOST_BYTES))
    except (FileNotFoundError, ValueError, RecursionError):
        return {}
    return source if isinstance(source, dict) else {}


def _write(path: Path, content: bytes) -> None:
    """All of it or nothing."""
    beside = path.with_name(path.name + ".part")
    beside.write_bytes(content + b"\n")
    beside.replace(path)
