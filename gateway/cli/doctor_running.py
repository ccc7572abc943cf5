"""What is known of a line whose loop runs, without touching its buses: what the loop itself says of them."""

from collections.abc import Iterator
from pathlib import Path

from gateway.cli.doctor_check import Check, Verdict
from gateway.cli.doctor_jitter import lateness_check
from gateway.cli.status_commands import ask_status
from gateway.core.status import GatewayStatus
from gateway.mailbox.listener import PathTooLong
from gateway.mailbox.port import Unreachable

GROUP = "the loop's word"


async def running(run_folder: Path) -> list[Check]:
    """The gateway's status of the line in `run_folder` as checks; one that was skipped where no gateway answers."""
    try:
        return list(judged(await ask_status(run_folder)))
    except (Unreachable, PathTooLong) as error:
        todo = "start `r2rgate gateway LINE.toml`, or end the loop to have the buses looked at"
        return [Check(GROUP, "gateway", "", "skipped", f"no gateway to ask: {error}", "", todo)]


def judged(status: GatewayStatus) -> Iterator[Check]:
    """The state, the cycle, every bus, and every drive and load cell that is not as it should be."""
    loop = status.loop
    yield Check(GROUP, "state", "", "OK" if loop.running else "FAIL", f"{loop.state}: {loop.text}", "", loop.next)
    timing = status.timing
    if timing.lateness is not None:
        late = (timing.lateness.p50_s, timing.lateness.p99_s, timing.lateness.max_s)
        yield lateness_check(GROUP, loop.period_s, late, timing.missed, timing.frames)
    for bus in status.buses:
        measured = f"{bus.timeouts} late, {bus.malformed} discarded, {bus.reconnects} reconnections"
        if bus.absent:
            absent = f"absent: {', '.join(bus.absent)} ({bus.last_error}); {measured}"
            yield Check(GROUP, f"bus {bus.name}", "", "FAIL", absent, "nobody absent", "check power and cable")
        else:
            yield Check(GROUP, f"bus {bus.name}", "", "OK", f"nobody absent; {measured}", "nobody absent")
    for span in status.spans:
        if span.drive in ("FAULT", "ABSENT", "STO"):
            verdict: Verdict = "warning" if span.drive == "STO" else "FAIL"
            todo = "`r2rgate status` shows the events that led to it"
            yield Check(GROUP, span.roller, "drive", verdict, span.drive, "no fault", todo)
        if span.control == "tension" and span.quality != "GOOD":
            todo = "check cell, cable and amplifier"
            yield Check(GROUP, span.name, "load cell", "FAIL", f"its tension is {span.quality}", "GOOD", todo)
