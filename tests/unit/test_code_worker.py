"""A computation's process, with works that try everything: what it cannot do, and what is told when it is ended."""

import asyncio
import multiprocessing
import os
import socket
import threading
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.context import SpawnProcess
from pathlib import Path

import numpy as np
import pytest

from agents.code.job import Job, Outcome
from agents.code.worker import LIMITS, NICER, Limits, run_work
from gateway.core.recording import Recording
from tests.unit import code_support as works
from tests.unit.code_support import LINE, in_service, job, nothing

pytestmark = pytest.mark.wires

LONG_S = 120.0  #: nobody waits for it in a test that goes well


def named(source: str) -> Job:
    """With a recording that is nothing but a name."""
    none, row = np.zeros(0), np.zeros((0, LINE.n))
    recording = Recording(none, row, row, row, row, row, none, np.zeros(0, dtype=np.bool_), 0.01, source)
    return job({"call": "margins"}, in_service(), recordings=(recording,))


def run(
    work: Callable[[Job], Outcome], given: Job | None = None, limits: Limits = LIMITS, within_s: float = LONG_S
) -> Outcome:
    return asyncio.run(run_work(nothing, work, given or named(""), within_s, limits))


def said(outcome: Outcome) -> dict[str, str]:
    assert not outcome.failed
    return dict(word.split(": ", 1) for word in outcome.words)


def test_no_socket_can_be_opened_in_it(tmp_path: Path) -> None:
    path = tmp_path / "s"
    with socket.create_server(("127.0.0.1", 0)) as tcp, socket.socket(socket.AF_UNIX) as local:
        local.bind(str(path))
        local.listen()
        given = named(f"{tcp.getsockname()[1]} {path}")
        assert said(works.connects(given)) == {"tcp": "done", "local": "done", "datagram": "done"}, "they are there"
        denied = "PermissionError"
        assert said(run(works.connects, given)) == {"tcp": denied, "local": denied, "datagram": denied}


def test_no_file_can_be_written_and_no_program_started_in_it(tmp_path: Path) -> None:
    there = tmp_path / "there"
    there.write_bytes(b"as it was")
    found = said(run(works.writes, named(str(there))))
    assert found == {"over": "OSError", "new": "OSError", "read": "done"}
    assert there.read_bytes() == b"as it was"
    assert said(run(works.starts))["program"] == "PermissionError"


def test_memory_is_bounded() -> None:
    assert run(works.eats, limits=replace(LIMITS, memory_bytes=2**30)).failed == "it needed more than 1 GiB of memory"


def test_processor_time_is_bounded() -> None:
    found = run(works.spins, limits=replace(LIMITS, processor_s=1))
    assert found.failed == "it used more than 1 s of processor time"


@pytest.mark.parametrize("work", [works.waits, works.spins, works.stalls, works.trickles])
def test_what_hangs_is_ended(work: Callable[[Job], Outcome]) -> None:
    assert run(work, limits=replace(LIMITS, wall_s=0.2)).failed == "it was not done within 0.2 s"
    assert not multiprocessing.active_children()


def test_nobody_waits_longer_than_there_is_time() -> None:
    assert "was not ready within" in run(works.waits, within_s=0.0).failed


def test_one_that_dies_or_stumbles_or_says_nonsense_is_told() -> None:
    assert run(works.dies).failed == "its process ended before it was done, with exit code 7"
    assert run(works.raises).failed == "RuntimeError: the algorithm has stumbled"
    assert run(works.says_nonsense).failed == "its process has said what is no outcome"
    assert run(works.says_too_much).failed == "its process has said more than 8388608 bytes"


def test_one_that_cannot_be_started_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_memory(_: SpawnProcess) -> None:
        raise OSError(12, "Cannot allocate memory")

    monkeypatch.setattr(SpawnProcess, "start", no_memory)
    assert "cannot be started" in run(works.stands).failed and "Cannot allocate memory" in run(works.stands).failed


def test_it_gives_way_to_the_others() -> None:
    assert int(said(run(works.stands))["nice"]) == min(os.getpriority(os.PRIO_PROCESS, 0) + NICER, 19)


def begun() -> None:
    while not multiprocessing.active_children():
        pass


def test_one_that_stalls_in_its_answer_is_ended_when_nobody_waits_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    answering, read = threading.Event(), os.read

    def seen(descriptor: int, most: int) -> bytes:
        piece = read(descriptor, most)
        if works.BEGINNING in piece:
            answering.set()
        return piece

    monkeypatch.setattr("agents.code.worker.os.read", seen)

    async def story() -> None:
        task = asyncio.create_task(run_work(nothing, works.stalls, named(""), LONG_S, LIMITS))
        assert await asyncio.to_thread(answering.wait, LONG_S)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert not multiprocessing.active_children()

    asyncio.run(story())


def test_what_nobody_waits_for_any_more_is_ended_with_its_process() -> None:
    async def story() -> None:
        task = asyncio.create_task(run_work(nothing, works.waits, named(""), LONG_S, LIMITS))
        await asyncio.to_thread(begun)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert not multiprocessing.active_children()

    asyncio.run(story())
