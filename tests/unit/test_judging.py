"""Judge workers: the same verdicts as at home, and a refusal where none comes."""

import asyncio
import errno
import os
import signal
from multiprocessing.context import SpawnProcess

import pytest
from typer.testing import CliRunner

from gateway.cli.judge_commands import seed_of
from gateway.cli.main import app
from gateway.control.design import design_lqi
from gateway.core.proposal import canonical
from gateway.core.verdict import Verdict
from gateway.core.verdict import canonical as verdict_bytes
from gateway.supervisor.judging import NICEST, JudgeWorkers
from safety.courses import courses_of
from safety.judge import judge
from tests.safety.case_support import EXAMPLES, gains, published

pytestmark = pytest.mark.wires


@pytest.fixture(scope="module")
def of():
    return published()


@pytest.fixture(scope="module")
def payload(of):
    return canonical(gains(design_lqi(of.task()), of.context()))


def test_a_worker_judges_as_the_judge_does_and_one_that_gives_none_is_replaced(of, payload):
    context, data = of.context(), [of.recording]

    async def story():
        async with JudgeWorkers(of.line) as workers:
            first = await workers.judge(payload, context, data, seed=5)
            late = await workers.judge(payload, context, data, seed=5, limit_s=0.0)
            again = await workers.judge(payload, context, data, seed=5)
            (pid,) = workers.pids
            os.kill(pid, signal.SIGKILL)
            dead = await workers.judge(payload, context, data)
            return first, late, again, dead

    first, late, again, dead = asyncio.run(story())
    assert verdict_bytes(first) == verdict_bytes(again) == verdict_bytes(judge(payload, context, of.line, data, 5))
    assert first.accepted
    assert not late.accepted and [one.rule for one in late.findings] == ["time"]
    assert not dead.accepted and [one.rule for one in dead.findings] == ["judge process"]
    assert late.proposal == first.proposal and late.kind == "gains"


def test_where_no_process_can_be_started_that_is_the_refusal_and_the_next_may_be_started(of, payload, monkeypatch):
    context, data = of.context(), [of.recording]

    async def story():
        with monkeypatch.context() as without:
            without.setattr(SpawnProcess, "start", no_memory)
            async with JudgeWorkers(of.line) as workers:
                assert not workers.pids
                refused = await workers.judge(payload, context, data)
                without.undo()
                return refused, await workers.judge(payload, context, data, seed=5)

    refused, judged = asyncio.run(story())
    assert [one.rule for one in refused.findings] == ["judge process"] and "memory" in refused.findings[0].text
    assert judged.accepted


def no_memory(_: SpawnProcess) -> None:
    raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM).lower())


def test_a_worker_draws_courses_between_what_it_judges(of, payload):
    context, data = of.context(), [of.recording]

    async def story():
        async with JudgeWorkers(of.line) as workers:
            verdict = await workers.judge(payload, context, data, seed=5)
            drawn = await workers.courses(payload, context, verdict.region)
            none = await workers.courses(b"{}", context, verdict.region)
            judging = asyncio.create_task(workers.judge(payload, context, data, seed=5))
            await asyncio.sleep(0)
            waited = await workers.courses(payload, context, verdict.region)
            return verdict, drawn, waited, none, await judging, workers.pids

    verdict, drawn, waited, none, again, pids = asyncio.run(story())
    assert drawn == waited == courses_of(payload, context, of.line, verdict.region)
    assert none.courses == [] and len(pids) == 1  # what cannot be drawn ends nobody
    assert verdict_bytes(again) == verdict_bytes(verdict)


def test_a_judge_for_whom_nobody_waits_gives_way_to_the_others(of, payload):
    async def story():
        async with JudgeWorkers(of.line, nicer=NICEST) as workers:
            verdict = await workers.judge(payload, of.context(), [of.recording])
            (pid,) = workers.pids
            return verdict, os.getpriority(os.PRIO_PROCESS, pid)

    verdict, nice = asyncio.run(story())
    assert verdict.accepted
    assert nice == 19


def test_what_waits_for_a_verdict_may_be_cancelled_and_the_process_goes_with_it(of, payload):
    async def story():
        async with JudgeWorkers(of.line) as workers:
            await workers.judge(b"{}", of.context(), [of.recording])
            (pid,) = workers.pids
            asked = asyncio.create_task(workers.judge(payload, of.context(), [of.recording]))
            await asyncio.sleep(0)
            asked.cancel()
            with pytest.raises(asyncio.CancelledError):
                await asked
            assert pid not in workers.pids

    asyncio.run(story())


def run(*arguments):
    return CliRunner().invoke(app, ["judge", *map(str, arguments)])


def test_the_command_writes_a_verdict_a_line_in_the_same_order(tmp_path):
    good = (EXAMPLES / "proposal.json").read_bytes().strip()
    given, out = tmp_path / "proposals.jsonl", tmp_path / "verdicts.jsonl"
    given.write_bytes(b"\n".join((good, b"no JSON", b"", good, b'{"format": 1}')))
    fixed = ("--line", EXAMPLES / "line.toml", "--context", EXAMPLES / "judge-context.json", "--proposals", given)
    done = run(*fixed, "--out", out, "--seed", 1, "--workers", 2)
    assert done.exit_code == 0, done.output
    assert "5 judged, 2 accepted, 3 refused" in done.output
    verdicts = [Verdict.model_validate_json(line) for line in out.read_bytes().splitlines()]
    assert [verdict.accepted for verdict in verdicts] == [True, False, False, True, False]
    assert [verdict.seed for verdict in verdicts] == [seed_of(1, index) for index in range(5)]


def test_the_command_refuses_what_it_cannot_judge_by(tmp_path):
    line, context, proposals = (EXAMPLES / name for name in ("line.toml", "judge-context.json", "proposal.json"))
    out = tmp_path / "verdicts.jsonl"

    def refused(**changes):
        given = {"line": line, "context": context, "proposals": proposals, "out": out} | changes
        done = run(*(word for name, value in given.items() for word in (f"--{name}", value)))
        assert done.exit_code == 2 and not out.exists()
        return done.output

    empty = tmp_path / "context.json"
    empty.write_text("{}")
    assert "now: is missing" in refused(context=empty)
    empty.write_bytes(context.read_bytes())
    assert "judge-context.csv" in refused(context=empty)
    data = (EXAMPLES / "judge-context.csv").read_text().splitlines(keepends=True)
    (tmp_path / "judge-context.csv").write_text("".join(data[:-1]))
    assert "the context names" in refused(context=empty)
    assert "would overwrite" in refused(out=proposals) or proposals.exists()
    assert "name a file in a folder" in refused(out=tmp_path / "nowhere" / "v.jsonl")
