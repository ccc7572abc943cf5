"""Proposals judged for whoever wants to know beforehand: one at a time, after those that are judged for good.

They have a judge's process beside that of the deployer, begun with the first and nicer than all others, so that a
verdict never waits for one of them. What it finds is handed out as a `DryRun`; the deployer takes verdicts from its own
judge alone.
"""

import asyncio
from collections import Counter
from collections.abc import Sequence
from typing import Protocol

from gateway.core.dry_run import DryRun, dry_run_of
from gateway.core.judge_context import JudgeContext
from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.core.verdict import Verdict
from gateway.supervisor.deployer import Deployer
from gateway.supervisor.judging import LONGER

MOST_EACH = 2  #: of one who asks, under way and waiting: an agent that asks without end keeps no other from asking


class TooMany(Exception):
    """The text says how many wait (inbox-full)."""


class PatientJudge(Protocol):
    async def judge(
        self,
        payload: bytes,
        context: JudgeContext,
        recordings: Sequence[Recording],
        seed: int | None = None,
        limit_s: float | None = None,
    ) -> Verdict: ...

    async def close(self) -> None: ...


class DryRuns:
    def __init__(self, line: Line, judge: PatientJudge) -> None:
        """`judge` is another one than the deployer's; it is closed with this."""
        self._limit_s = LONGER * line.gate.verdict_max_s
        self._judge = judge
        self._turn = asyncio.Lock()
        self._asked: Counter[str] = Counter()  #: by who asks

    async def run(self, payload: bytes, deployer: Deployer, who: str) -> DryRun:
        """Of the line as it is then. Raises TooMany, and NotKnown where there is nothing to judge against."""
        if self._asked[who] >= MOST_EACH:
            raise TooMany(f"{MOST_EACH} dry runs of agent {who} wait already; ask again when one is done (inbox-full)")
        self._asked[who] += 1
        try:
            async with self._turn:
                # Shielded: whoever gives up waiting here would take the proposals that are being judged along.
                await asyncio.shield(deployer.judged())
                context, recordings = await deployer.context()
                return dry_run_of(await self._judge.judge(payload, context, recordings, limit_s=self._limit_s))
        finally:
            self._asked[who] -= 1

    async def close(self) -> None:
        await self._judge.close()
