"""Gateway processes to be killed: the product's own, but that their judge takes milliseconds and their time runs fast.

`python -m tests.closed_loop.gate_victim FOLDER SCALE BEGAN_S` forks one for each line on its standard input and says
its number; whoever started it kills them. Each writes the number and head of every record of its audit to `told.bin`,
as soon as it was told that it is stored.
"""

import asyncio
import hashlib
import os
import random
import struct
import sys
import time
import traceback
from dataclasses import dataclass
from pathlib import Path

from gateway.cli.lifetime import follow_parent
from gateway.core.deployment import Region
from gateway.core.judge_context import JudgeContext, context_hash
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.recording import Recording
from gateway.core.verdict import RuleFinding, Verdict, line_hash
from gateway.mailbox.paths import GATEWAY_DATA
from gateway.supervisor.audit import Audit
from gateway.supervisor.process import serve

TOLD, TOLD_FILE = struct.Struct("<Q64s"), "told.bin"
BAD = "bad"  #: in its reason: a proposal that the stand-in for the judge refuses
WALL_S = 1.7e9  #: Unix time when the clock says 0
LOOK_S = 0.02  #: of the victims' deployer, where the product takes 0.25 s


@dataclass(frozen=True)
class FastTime:
    """Runs `scale` times as fast as that of the machine, from 0 at its monotonic time `began_s`."""

    scale: float
    began_s: float

    def clock(self) -> float:
        return self.scale * (time.monotonic() - self.began_s)

    def wall_clock(self) -> float:
        return WALL_S + self.clock()


class QuickJudge:
    """Says yes to all but those that are bad, after some milliseconds."""

    def __init__(self, rng: random.Random, line: Line) -> None:
        self._rng = rng
        self._line = line_hash(line)

    def begin(self) -> None: ...

    async def close(self) -> None: ...

    async def judge(self, payload: bytes, context: JudgeContext, recordings: list[Recording]) -> Verdict:
        await asyncio.sleep(self._rng.uniform(0.0, 0.03))
        hash_, accepted = hashlib.sha256(payload).hexdigest(), BAD.encode() not in payload
        return Verdict(
            format=1, proposal=hash_, payload=hash_, context=context_hash(context), line=self._line, kind="gains",
            seed=1, accepted=accepted, findings=[RuleFinding(rule="test", passed=accepted, text="as a test wants it")],
            region=Region(speed_max_m_per_s=0.1) if accepted else None, judged=context.now, program_version="0",
        )  # fmt: skip


def live(folder: Path, scale: float, began_s: float) -> None:
    told = os.open(folder / "data" / GATEWAY_DATA / TOLD_FILE, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    append = Audit.append

    async def telling(self, *args):
        at = await append(self, *args)
        os.write(told, TOLD.pack(at.sequence, at.head.encode()))
        return at

    Audit.append = telling
    line = load_line((folder / "line.toml").read_text(), "line.toml")
    fast = FastTime(scale, began_s)
    judge = QuickJudge(random.Random(os.getpid()), line)
    asyncio.run(serve(line, folder / "run", folder / "data", judge, fast.clock, fast.wall_clock, LOOK_S))


def main() -> None:
    folder, scale, began_s = Path(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3])
    follow_parent()
    output = os.open(folder / "victims.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for _ in sys.stdin:
        pid = os.fork()
        if pid == 0:
            try:
                follow_parent()
                os.dup2(output, 1)
                os.dup2(output, 2)
                live(folder, scale, began_s)
            except BaseException:
                traceback.print_exc()
                sys.stderr.flush()
            finally:
                os._exit(1)
        print(pid, flush=True)
        os.waitpid(pid, 0)


if __name__ == "__main__":
    main()
