"""A line, its telemetry and a short folder for sockets, for the tests of the gateway process."""

import asyncio
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from gateway.core.line import Line
from gateway.core.line_template import line_template
from gateway.core.signals import DriveState, Quality
from gateway.core.states import STATE_OF, LoopState, Phase
from gateway.core.telemetry import Frame, pack
from gateway.mailbox.loop_proof import AskShown, make_key, shown


def line_of(spans: int = 6, name: str | None = None) -> Line:
    document = tomllib.loads(line_template(spans))
    if name is not None:
        document["line"] = name
    return Line.model_validate(document)


@contextmanager
def short_folder() -> Iterator[Path]:
    """pytest's own folders may be longer than a socket's path may be."""
    folder = Path(tempfile.mkdtemp(prefix="r2r-", dir="/tmp"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


@contextmanager
def child(program: str, *arguments: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A Python program in a process of its own, and the first line it said; killed at the end."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    root = Path(__file__).parents[2]
    with subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield process, process.stdout.readline()
        finally:
            process.kill()


async def until(condition: Callable[[], bool]) -> None:
    """Lets the event loop turn until `condition`; what it waits for may happen in another process."""
    while not condition():  # noqa: ASYNC110
        await asyncio.sleep(0.001)


class ShowsWho:
    """A loop's answer to who it is, as of one start: for a mailbox that serves LOOP_SHOWN on the loop's socket."""

    def __init__(self, folder: Path, phase: Phase = Phase.RUNNING) -> None:
        self.phase = phase
        self.asked = 0
        self._key = make_key(folder)
        self._start = secrets.token_hex(32)

    async def answer(self, payload: bytes) -> bytes:
        self.asked += 1
        challenge = AskShown.model_validate_json(payload).challenge
        state = STATE_OF[self.phase].name
        return shown(
            self._key, challenge, self._start, os.getpid(), self.asked, time.monotonic(), state, self.phase.name
        )


def frame_of(sequence: int, time_s: float, spans: int = 6, **changes: Any) -> bytes:
    rng = np.random.default_rng(sequence)
    setpoint = np.linspace(20.0, 40.0, spans)
    values: dict[str, Any] = {
        "sequence": sequence,
        "time_s": time_s,
        "lateness_s": 40e-6 + 5e-6 * rng.random(),
        "cycle_s": 600e-6 + 50e-6 * rng.random(),
        "missed": 0,
        "unwind_speed_m_per_s": 0.1,
        "speed_setpoint_m_per_s": 0.1,
        "state": LoopState.RUN,
        "phase": Phase.RUNNING,
        "by_person": False,
        "standstill": False,
        "saturated": False,
        "held": 0,
        "doubts": 0,
        "tension_n": setpoint + 0.1 * rng.standard_normal(spans),
        "tension_setpoint_n": setpoint,
        "speed_m_per_s": 0.1 + 1e-4 * rng.standard_normal(spans),
        "torque_nm": 5.0 + 0.5 * rng.standard_normal(spans),
        "torque_actual_nm": 5.0 + 0.5 * rng.standard_normal(spans),
        "tension_quality": np.full(spans, Quality.GOOD, np.int8),
        "drive_state": np.full(spans, DriveState.ENABLED, np.int8),
    }
    return pack(Frame(**(values | changes)))
