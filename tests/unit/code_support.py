"""What tests of the Code agent share: a line, jobs on it, and works for its worker that go wrong in every way."""

import inspect
import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from agents.code.calls import parse_call
from agents.code.job import Believed, Job, Named, Outcome
from gateway.control.design import design_lqi, task_of
from gateway.core.controller import Controller
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.questions import Figure
from gateway.core.recording import Recording

LINE = load_line(line_template(3, "line.toml"), "line.toml")
NOMINAL = Believed("nominal", None)


def in_service() -> Controller:
    return design_lqi(task_of(LINE))


def job(document: dict[str, Any], *controllers: Controller, recordings: tuple[Recording, ...] = ()) -> Job:
    """On the nominal model."""
    named = tuple(Named(f"controller {k}", one) for k, one in enumerate(controllers, 1))
    return Job(parse_call(document), LINE, (NOMINAL,), named, recordings)


def value(outcome: Outcome, name: str) -> float:
    assert not outcome.refused and not outcome.failed, outcome
    (found,) = [figure.value for figure in outcome.figures if figure.name == name]
    assert found is not None, name
    return found


# Works. A job's first recording, where it has one, names a port or a file in its source.


def nothing(_: Job) -> None:
    """Prepares nothing."""


def told(**words: object) -> Outcome:
    return Outcome(words=[f"{name}: {said}" for name, said in words.items()])


def attempted(what: Any) -> str:
    try:
        what()
    except OSError as error:
        return type(error).__name__
    return "done"


def connects(job: Job) -> Outcome:
    """To a port of this machine, and to a socket in the file system."""
    port, path = job.recordings[0].source.split(" ", 1)

    def local() -> None:
        with socket.socket(socket.AF_UNIX) as one:
            one.connect(path)

    return told(
        tcp=attempted(lambda: socket.create_connection(("127.0.0.1", int(port)), 5.0).close()),
        local=attempted(local),
        datagram=attempted(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM).close()),
    )


def writes(job: Job) -> Outcome:
    """To a file that is there, and to one that is not; and reads one."""
    there = Path(job.recordings[0].source)
    return told(
        over=attempted(lambda: _over(there)), new=attempted(lambda: there.with_name("new").write_bytes(b"new")),
        read=attempted(there.read_bytes),
    )  # fmt: skip


def _over(path: Path) -> None:
    with path.open("r+b", buffering=0) as stream:
        stream.write(b"over")


def starts(_: Job) -> Outcome:
    return told(program=attempted(lambda: subprocess.run([sys.executable, "-c", "print(1)"], check=False)))


def eats(_: Job) -> Outcome:
    """Memory without end."""
    kept: list[bytearray] = []
    while True:
        kept.append(bytearray(2**26))


def spins(_: Job) -> Outcome:
    while True:
        pass


def waits(_: Job) -> Outcome:
    while True:
        time.sleep(1.0)


def dies(_: Job) -> Outcome:
    os._exit(7)


def raises(_: Job) -> Outcome:
    raise RuntimeError("the algorithm has stumbled")


def stands(_: Job) -> Outcome:
    return told(nice=os.getpriority(os.PRIO_PROCESS, 0), pid=os.getpid())


BEGINNING = b"\x00\x00\x10\x00{"  #: of an answer, whichever way its length is told


def stalls(_: Job) -> Outcome:
    """In the middle of its answer."""
    os.write(_own_pipe(), BEGINNING)
    while True:
        time.sleep(1.0)


def trickles(_: Job) -> Outcome:
    """An answer that has no end."""
    pipe = _own_pipe()
    os.write(pipe, BEGINNING)
    while True:
        os.write(pipe, b" ")
        time.sleep(0.001)


def _own_pipe() -> int:
    frame = inspect.currentframe()
    while frame is not None and "pipe" not in frame.f_locals:
        frame = frame.f_back
    assert frame is not None
    return frame.f_locals["pipe"].fileno()


def says_too_much(_: Job) -> Outcome:
    return Outcome.model_construct(words=["x" * 20_000_000], figures=[])


def says_nonsense(_: Job) -> Outcome:
    return Outcome.model_construct(figures=[Figure.model_construct(name="", value=0.0, unit="")])
