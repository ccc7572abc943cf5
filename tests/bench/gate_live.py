"""`make bench-gate-live`: the gate on a line that runs, in its processes; the recorder at the drives is the judge.

Swaps: another law through the gate onto the line, and back by a person. Rollbacks: a law that chatters is forced in
past the gate, straight into the loop, whose monitor takes it back; its chatter tells its torques from the fallback's.
Lateness: of the loop's frames, in turns with and without two judges that compute without a pause.
"""

import argparse
import asyncio
import tempfile
import time
from contextlib import closing
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from gateway.control.design import design_lqg, task_of
from gateway.core.controller import Controller, config_hash
from gateway.core.controller_laws import LqiConfig
from gateway.core.deployment import Deployment
from gateway.core.judge_context import JudgeContext, LineState
from gateway.core.proposal import GainsChange, Proposal, canonical
from gateway.core.signals import FloatArray
from gateway.mailbox.paths import GATEWAY_DATA
from gateway.supervisor.historian import FILE_NAME
from gateway.supervisor.history import History
from gateway.supervisor.judging import JudgeWorkers
from sim_plant.recording import Recording
from tests.bench.figures import Bench
from tests.closed_loop.gate_line import GateLine, largest_step_nm

CHATTER_NM = 8.0  #: from one command to the next, and back with the one after: so does the law that was forced in
CHATTERS = 1.5  #: added to what its torques before weigh: they turn round every period
AROUND_S = 0.3  #: a swap, either side
TURNS = 3


@dataclass
class Found:
    swaps_nm: list[float] = field(default_factory=list[float])  #: largest step of a torque around each swap
    calm_nm: list[float] = field(default_factory=list[float])  #: and where nothing is swapped
    verdicts_s: list[float] = field(default_factory=list[float])
    back_s: list[float] = field(default_factory=list[float])  #: from the rollback to the fallback's first command
    late: int = 0  #: commands of the law that was taken back, after that
    alone_s: list[FloatArray] = field(default_factory=list["FloatArray"])  #: lateness of the loop
    beside_s: list[FloatArray] = field(default_factory=list["FloatArray"])
    judged: int = 0
    unsafe: int = 0


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--rollbacks", type=int, default=10, help="in a run")
    parser.add_argument("--seconds", type=float, default=10.0, help="with and without judges, three times a run")
    given = parser.parse_args()
    bench, found = Bench("gate-live", list(range(1, given.runs + 1))), Found()
    for seed in range(1, given.runs + 1):
        one_run(seed, given.rollbacks, given.seconds, found)
    n, back_s = len(found.swaps_nm), found.back_s
    bench.figure("swap_torque_step_nm", max(found.swaps_nm), "Nm", n)
    bench.figure("calm_torque_step_nm", max(found.calm_nm), "Nm", len(found.calm_nm))
    bench.figure("rollback_to_command_ms", 1e3 * max(back_s), "ms", len(back_s))
    bench.figure("commands_of_what_was_taken_back", found.late, "", len(back_s))
    alone, beside = (1e6 * float(np.percentile(np.concatenate(one), 99)) for one in (found.alone_s, found.beside_s))
    samples = sum(map(len, found.beside_s))
    bench.figure("lateness_p99_alone_us", alone, "us", sum(map(len, found.alone_s)))
    bench.figure("lateness_p99_beside_two_verdicts_us", beside, "us", samples)
    bench.figure("lateness_p99_ratio_beside_two_verdicts", beside / alone, "", samples)
    bench.figure("verdict_s", max(found.verdicts_s), "s", len(found.verdicts_s))
    bench.figure("unsafe_events", found.unsafe, "", given.runs)
    bench.tables = {"judges": {"verdicts computed beside the loop": found.judged}}
    bench.finish()


def one_run(seed: int, rollbacks: int, seconds: float, found: Found) -> None:
    with tempfile.TemporaryDirectory() as folder, GateLine(Path(folder), seed, spans=6) as line:
        line.run()
        windows = swaps(line, found)
        for _ in range(rollbacks):
            force_in(line)
        turns = asyncio.run(beside_judges(line, seconds, found))
        line.children.end("loop")
        line.children.end("gateway")
        recording = line.recording()
        found.unsafe += sum(line.unsafe().values())
        found.swaps_nm += [largest_step_nm(recording, *window) for window in windows[1:]]
        found.calm_nm.append(largest_step_nm(recording, *windows[0]))
        with closing(History(line.folder / "data" / GATEWAY_DATA / FILE_NAME)) as history:
            taken_back(line, history, recording, found)
            for begin_s, end_s, judges in turns:
                lateness = history.read(begin_s, end_s, ["lateness_s"])["lateness_s"].astype(float)
                (found.beside_s if judges else found.alone_s).append(lateness)


def swaps(line: GateLine, found: Found) -> list[tuple[float, float]]:
    """Windows of world time: one in which nothing happens, then one around each swap."""

    def now_s() -> float:
        return time.monotonic() - line.world_start_s

    windows = [(now_s() - AROUND_S, now_s() + AROUND_S)]
    other = design_lqg(task_of(line.line))
    for _ in range(TURNS):
        began_s = time.monotonic()
        proposal = line.propose(other)
        line.until(proposal, "waiting")
        found.verdicts_s.append(time.monotonic() - began_s)
        for change in (lambda one=proposal: line.decide(one), line.roll_back):
            began_s = now_s()
            reply = change()
            assert reply.ok, reply
            windows.append((began_s - AROUND_S, now_s() + AROUND_S))
            time.sleep(2 * AROUND_S)
    return windows


def force_in(line: GateLine) -> None:
    """Past the gate; until the loop has taken it back by itself."""
    law = line.first
    assert isinstance(law, LqiConfig)
    gain = np.array(law.gain_input) + CHATTERS * np.eye(line.line.n)
    bad: Controller = law.model_copy(update={"gain_input": gain.tolist()})
    epoch = line.configuration().epoch + 1
    reply = line.deploy(Deployment(controller=bad, hash=config_hash(bad), epoch=epoch, lease_s=30.0))
    assert reply.ok, reply
    line.look_on(line.in_service, lambda runs: runs == config_hash(law), 10.0)
    time.sleep(1.0)  # for the line to come to rest


def taken_back(line: GateLine, history: History, recording: Recording, found: Found) -> None:
    """For each rollback by the monitor: when the fallback's first command came, and whether others came after it."""
    far_s = time.time() + 1e6
    events = [event for event in history.events(0.0, far_s) if event.kind == "rolled-back"]
    for event in events:
        if "turned round" not in event.text and "cut a torque" not in event.text:
            continue
        at_s = event.time_s - line.world_start_s
        first_s, late = 0.0, 0
        for roller in range(1, recording.spans + 1):
            commands = [
                (one["time_s"], one["target_torque_nm"])
                for one in recording.of_kind("command")
                if one["roller"] == roller and at_s - 0.05 <= one["time_s"] <= at_s + 0.05
            ]
            times_s, torque_nm = np.array(commands).T
            steps_nm = np.diff(torque_nm)
            far = np.abs(steps_nm) > CHATTER_NM
            turned = far[1:] & far[:-1] & (steps_nm[1:] * steps_nm[:-1] < 0.0)
            after = times_s >= at_s
            first_s = max(first_s, float(times_s[after][0]) - at_s)
            late += int((turned & after[2:]).sum())
        found.back_s.append(first_s)
        found.late += late


async def beside_judges(line: GateLine, seconds: float, found: Found) -> list[tuple[float, float, bool]]:
    """Turns of monotonic time, and whether judges computed in them."""
    turns: list[tuple[float, float, bool]] = []
    now = datetime.now(UTC)
    proposal = canonical(
        Proposal(
            format=1,
            site=line.line.site,
            line=line.line.line,
            change=GainsChange(controller=design_lqg(task_of(line.line))),
            base=config_hash(line.first),
            model=None,
            reason="again and again",
            author="engineer",
            created=now.isoformat(),
            expires=(now + timedelta(hours=1)).isoformat(),
        )  # fmt: skip
    )
    recipe = line.line.recipes[0]
    state = LineState(state="RUN", tension_n=recipe.tension_n, speed_m_per_s=recipe.speed_m_per_s)
    context = JudgeContext(format=1, now=now.isoformat(), state=state, in_service=line.first)
    async with JudgeWorkers(line.line, 2) as workers:
        for _ in range(2):
            await workers.judge(proposal, context, [])  # begun, and compiled

        async def again_and_again() -> None:
            while True:
                assert (await workers.judge(proposal, context, [])).accepted
                found.judged += 1

        for _ in range(3):
            began_s = time.monotonic()
            await asyncio.sleep(seconds)
            turns.append((began_s, time.monotonic(), False))
            judging = [asyncio.create_task(again_and_again()) for _ in range(2)]
            began_s = time.monotonic()
            await asyncio.sleep(seconds)
            turns.append((began_s, time.monotonic(), True))
            for task in judging:
                task.cancel()
            await asyncio.gather(*judging, return_exceptions=True)
            for _ in range(2):
                await workers.judge(proposal, context, [])  # what was interrupted has begun anew
    return turns


if __name__ == "__main__":
    main()
