"""`r2rgate judge`: proposals judged away from the line, one verdict a line."""

import asyncio
import hashlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, BinaryIO, NoReturn

import typer

from gateway.cli.process_commands import REFUSED, read_line
from gateway.core.judge_context import ContextRefused, JudgeContext, parse_context
from gateway.core.line import Line
from gateway.core.line_problem import printable
from gateway.core.recording import Recording
from gateway.core.verdict import Verdict, canonical


@dataclass(frozen=True)
class Job:
    """What every proposal is judged against."""

    line: Line
    context: JudgeContext
    recordings: list[Recording]
    seed: int | None


@dataclass
class Count:
    judged: int = 0
    accepted: int = 0


def judge(
    line: Annotated[Path, typer.Option(help="The line description, with its limits and its gate.")],
    context: Annotated[Path, typer.Option(help="What is in service, the model with its data, clock and state (JSON).")],
    proposals: Annotated[Path, typer.Option(help="One proposal a line (JSON lines).")],
    out: Annotated[Path, typer.Option(help="One verdict a line, in the same order.")],
    seed: Annotated[
        int | None, typer.Option(min=0, help="For the same verdicts again. Without: others in each run.")
    ] = None,
    workers: Annotated[int, typer.Option(min=0, max=64, help="Processes that judge. 0: one per processor.")] = 0,
) -> None:
    """Judge proposals as the gate of a running line does, and write every rule's number, limit and margin.

    Each proposal is judged by itself against the same context: an accepted one changes nothing for the next. A line of
    the file that is no JSON is refused like any other. Recordings that the context names are read from beside it, and
    their digests checked. docs/gate.md explains rules, thresholds, and how to write a context.

    Exit code: 0 all were judged, 2 refused to begin, 130 interrupted.

    Example: r2rgate judge --line line.toml --context context.json --proposals proposals.jsonl --out verdicts.jsonl
    """
    from gateway.cli.waiting import interruptible, progress

    found = read_line(line)
    judged_by, recordings = _context(context)
    payloads = _payloads(proposals)
    _may_write(out, [line, context, proposals])
    part, job = out.with_name(out.name + ".part"), Job(found, judged_by, recordings, seed)
    with interruptible(f"{part} has the first verdicts"), progress() as tell:
        count = asyncio.run(_judge(job, payloads, part, workers, tell))
    part.replace(out)
    typer.echo(f"{out}: {count.judged} judged, {count.accepted} accepted, {count.judged - count.accepted} refused")


async def _judge(job: Job, payloads: list[bytes], part: Path, count: int, tell: Callable[[str], None]) -> Count:
    """Verdicts into `part`, in order; as many at a time as there are processes."""
    from gateway.cli.workers import processors
    from gateway.supervisor.judging import JudgeWorkers

    count, told = count or processors(), Count()
    tell("processes begin")
    async with JudgeWorkers(job.line, min(count, max(1, len(payloads)))) as judges:

        async def verdict_of(index: int) -> Verdict:
            seed = None if job.seed is None else seed_of(job.seed, index)
            return await judges.judge(payloads[index], job.context, job.recordings, seed)

        with part.open("wb") as file:
            ahead: deque[asyncio.Task[Verdict]] = deque()
            for index in range(len(payloads)):
                ahead.append(asyncio.create_task(verdict_of(index)))
                if len(ahead) >= 4 * count:
                    _write(file, await ahead.popleft(), told, len(payloads), tell)
            while ahead:
                _write(file, await ahead.popleft(), told, len(payloads), tell)
    return told


def _write(file: BinaryIO, verdict: Verdict, told: Count, total: int, tell: Callable[[str], None]) -> None:
    file.write(canonical(verdict) + b"\n")
    told.judged += 1
    told.accepted += verdict.accepted
    tell(f"{told.judged} of {total} judged, {told.accepted} accepted")


def seed_of(seed: int, index: int) -> int:
    """Of the proposal at `index` (from 0), where the whole file has one seed."""
    return int.from_bytes(hashlib.sha256(f"{seed} {index}".encode()).digest()[:6])


def _context(path: Path) -> tuple[JudgeContext, list[Recording]]:
    """With its recordings; the command ends where one of them is not what it should be."""
    from gateway.cli.recordings import read_recording
    from gateway.cli.recordings_table import RecordingRefused

    try:
        context = parse_context(path.read_bytes())
    except ContextRefused as refused:
        _refuse("\n".join(f"{path}: {reason}" for reason in refused.reasons))
    recordings: list[Recording] = []
    for one in context.data:
        try:
            recording = read_recording(path.parent / one.path)
        except RecordingRefused as refused:
            _refuse(f"{path}: data: {refused}")
        if recording.digest() != one.digest:
            _refuse(f"{path}: data: {one.path} has the digest {recording.digest()}; the context names {one.digest}")
        recordings.append(recording)
    return context, recordings


def _payloads(path: Path) -> list[bytes]:
    """Line by line; what comes after the last end of line counts where there is something."""
    lines = path.read_bytes().split(b"\n")
    return lines if lines[-1] else lines[:-1]


def _may_write(out: Path, inputs: list[Path]) -> None:
    """Known before the work, not after it."""
    if out.resolve() in [given.resolve() for given in inputs]:
        _refuse(f"--out {out} would overwrite what is read; name another file")
    if out.is_dir() or not out.parent.is_dir():
        _refuse(f"--out {out} cannot be written: name a file in a folder that is there")


def _refuse(message: str) -> NoReturn:
    typer.echo(printable_lines(message), err=True)
    raise typer.Exit(REFUSED)


def printable_lines(text: str) -> str:
    """As `printable`, with the ends of lines as they are."""
    return "\n".join(map(printable, text.split("\n")))
