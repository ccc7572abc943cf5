"""A verdict once more from the audit alone: judged by a deployer, stored, replayed by the command."""

import asyncio
import json
from datetime import datetime
from pathlib import Path

from typer.testing import CliRunner

from gateway.cli.audit_replay import differences
from gateway.cli.main import app
from gateway.cli.recordings import read_recording
from gateway.core.audit_record import Who
from gateway.core.judge_context import parse_context
from gateway.core.line_file import load_line
from gateway.core.proposal import parse_proposal, proposal_hash
from gateway.core.verdict import Verdict
from gateway.supervisor.audit import Audit
from gateway.supervisor.deployer import Deployer
from gateway.supervisor.kept_audit import KeptAudit
from gateway.supervisor.lifecycle import Book
from safety.judge import judge
from tests.unit.deployer_gateway import nothing_to_store
from tests.unit.deployer_support import Death, FakeLoop, FakeSurroundings

EXAMPLES = Path("docs/examples")
SEED = 11


def replayed(*given: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, ["audit", "replay", *map(str, given)])
    return result.exit_code, result.stdout, result.stderr


async def judged_into(folder: Path, payload: bytes) -> None:
    line = load_line((EXAMPLES / "line.toml").read_text(), "line.toml")
    context = parse_context((EXAMPLES / "judge-context.json").read_bytes())
    recordings = [read_recording(EXAMPLES / one.path) for one in context.data]
    loop = FakeLoop(Death())

    class AsInTheExample(FakeSurroundings):
        async def context(self, book):
            return context, recordings

    class Judge:
        async def judge(self, payload, context, recordings) -> Verdict:
            return judge(payload, context, line, recordings, SEED)

    audit = Audit(folder, clock=lambda: loop.now_s, wall_clock=lambda: loop.now_s)
    audit.start()
    deployer = Deployer(
        line, Book(), KeptAudit(folder, audit), loop, Judge(), AsInTheExample(loop), nothing_to_store,
        lambda: loop.now_s, datetime.fromisoformat(context.now).timestamp,
    )  # fmt: skip
    try:
        assert (await deployer.propose(payload, Who(name="anna"))).ok
        await deployer.judged()
    finally:
        await deployer.close()
        await asyncio.to_thread(audit.close)


def test_the_same_verdict_again_from_what_was_stored(tmp_path: Path) -> None:
    payload = (EXAMPLES / "proposal.json").read_bytes().strip()
    asyncio.run(judged_into(tmp_path, payload))
    hash_ = proposal_hash(parse_proposal(payload, len(payload)))
    code, said, err = replayed(hash_[:10], "--data-dir", tmp_path)
    assert code == 0 and said.startswith(f"the same verdict: accepted (record 3, seed {SEED}"), said + err
    code, said, _ = replayed("3", "--data-dir", tmp_path, "--json")
    assert code == 0 and json.loads(said)["same"] and json.loads(said)["verdict"]["seed"] == SEED
    code, _, err = replayed("0123456789", "--data-dir", tmp_path)
    assert code == 2 and "of the 1 verdicts in the audit none is meant" in err


def test_what_differs_is_told() -> None:
    verdict = Verdict.model_validate_json((EXAMPLES / "verdict.json").read_bytes())
    first = verdict.findings[0].model_copy(update={"text": "otherwise"})
    other = verdict.model_copy(update={"findings": [first, *verdict.findings[1:]], "program_version": "0"})
    told = differences(verdict, other)
    assert len(told) == 2 and told[0].startswith("judged by version") and "otherwise" in told[1]
    assert differences(verdict, verdict) == []
