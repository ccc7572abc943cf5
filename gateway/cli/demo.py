"""The demonstration: a simulated line, the gateway and the loop in their own processes, both cases in real time."""

import asyncio
import platform
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import as_file, files
from pathlib import Path

from rich.console import Console

from gateway.cli.children import ChildFailed, Children, free_udp_port
from gateway.cli.demo_progress import Progress
from gateway.cli.line_commands import known_maps
from gateway.cli.operate_commands import request
from gateway.cli.status_commands import parse_status
from gateway.core.controller import Controller, canonical
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.messages import Arm, Command, SelectRecipe, Start, Stop
from gateway.core.scenario import PAPER, Scenario
from gateway.core.topics import GATEWAY_STATUS
from gateway.mailbox.paths import GATEWAY_SOCKET
from gateway.mailbox.port import Unreachable
from gateway.mailbox.unix import UnixMailbox
from gateway.supervisor.status import GatewayStatus

READY_TIME_S = 20.0
SETTLE_TIME_S = 30.0
SETTLED_N = 0.6  #: a measured tension this near its set-point has settled (six times the sensors' noise)
SETTLED_FOR_S = 2.0
SIM_PRIORITY = 40  #: below the loop's: devices of a real line do not wait for this computer
MOST_REPEATS = 2  #: of a case, after such a stop
OWN_FILES = ("line.toml", "plant.toml", "controller.json", "result.json", "report.html", "recording", "data", "logs")


class DemoFailed(Exception):
    """The demonstration cannot go on; the text says why."""


@dataclass(frozen=True)
class Setup:
    """What a run is made of, and where it writes."""

    out: Path
    line: Line
    config: Controller
    seed: int


@dataclass(frozen=True)
class Window:
    """When a case ran, on CLOCK_MONOTONIC."""

    case: Scenario
    begin_s: float
    end_s: float


def run_demo(out: Path, law: str, seed: int) -> int:
    """Run it and write everything into `out`. Returns the exit code: 0, 1 when something failed, 130 on Ctrl-C."""
    console = Console(highlight=False)
    started_s = time.monotonic()
    try:
        _clear(out)
        with Children(out / "logs") as children:
            setup, world_start_s = _begin(children, out, law, seed)
            windows, stops = asyncio.run(_story(children, setup, console))
            _end_in_order(children)
        console.print("measuring: the same cases in stepped time, then the report")
        _conclude(setup, windows, stops, world_start_s, started_s, console)
    except (ChildFailed, DemoFailed, Unreachable) as error:
        console.print(f"the demonstration failed: {error}", style="red", markup=False)
        return 1
    except KeyboardInterrupt:
        console.print("stopped: the line was brought to rest and every process has ended")
        return 130
    return 0


def _conclude(
    setup: Setup, windows: list[Window], stops: list[str], world_start_s: float, started_s: float, console: Console
) -> None:
    """Figures, `result.json`, `report.html`, table."""
    from gateway.cli.demo_analysis import measure, read_evidence
    from gateway.cli.demo_report import page
    from gateway.cli.demo_table import print_result

    evidence = read_evidence(setup, windows, world_start_s)
    result = measure(setup, windows, stops, evidence, started_s)
    (setup.out / "result.json").write_text(result.model_dump_json(indent=2) + "\n", encoding="utf-8")
    (setup.out / "report.html").write_text(page(setup, result, windows, evidence), encoding="utf-8")
    print_result(result, setup.out, console)


def _clear(out: Path) -> None:
    """Remove what an earlier demonstration left; nothing else of the folder is touched."""
    out.mkdir(parents=True, exist_ok=True)
    for name in OWN_FILES:
        path = out / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    (out / "logs").mkdir()


def _begin(children: Children, out: Path, law: str, seed: int) -> tuple[Setup, float]:
    """Start the three processes. The line's file describes what the simulated line offers on the wire."""
    from gateway.control.design import design_lqi, design_pid, task_of

    with as_file(files("sim_plant") / "plants" / "s_real.toml") as plant:
        shutil.copyfile(plant, out / "plant.toml")
    ready = children.start_sim(
        out / "plant.toml", "--record", out / "recording", "--seed", str(seed),
        "--can-port", str(free_udp_port()), "--modbus-port", "0", "--priority", str(SIM_PRIORITY),
    )  # fmt: skip
    text = line_template(6, "line.toml")
    for default, port in (("port = 43113", ready["can_port"]), ("port = 5020", ready["modbus_port"])):
        if default not in text:
            raise DemoFailed(f"the line template does not say {default!r}")
        text = text.replace(default, f"port = {port}")
    (out / "line.toml").write_text(text, encoding="utf-8")
    line = load_line(text, "line.toml", known_maps())
    config = {"lqi": design_lqi, "pid": design_pid}[law](task_of(line))
    (out / "controller.json").write_bytes(canonical(config) + b"\n")
    folders = ("--run-dir", children.run_folder, "--data-dir", out / "data")
    children.start("gateway", out / "line.toml", *folders)
    children.start("loop", out / "line.toml", "--controller", out / "controller.json", *folders)
    return Setup(out, line, config, seed), ready["monotonic_start_s"]


async def _story(children: Children, setup: Setup, console: Console) -> tuple[list[Window], list[str]]:
    """From SILENT through both cases to rest. Returns when each ran, and why the line stopped in between, if it did."""
    operator = Operator(children)
    try:
        with Progress(console) as progress:
            operator.progress = progress
            progress.step("starting the processes")
            await operator.wait(lambda status: status.loop.running, READY_TIME_S, "the loop")
            await _begin_with_repeats(operator)
            windows = [await _run_with_repeats(operator, setup, case) for case in PAPER]
            progress.step("stopping")
            await operator.order(Stop())
            await operator.wait_at_rest()
            return windows, operator.stops
    finally:
        await operator.close()


async def _begin_with_repeats(operator: "Operator") -> None:
    """From rest to a line that is being tensioned. Refused, a person reads why and tries again."""
    for repeats in range(MOST_REPEATS + 1):
        try:
            await operator.begin()
            return
        except DemoFailed as failed:
            if repeats == MOST_REPEATS:
                raise
            await operator.recover(f"not started; once more ({failed})", str(failed))


async def _run_with_repeats(operator: "Operator", setup: Setup, case: Scenario) -> Window:
    """A computer that stalls, or on which the simulated devices do, stops the line, as it must; then once more."""
    for repeats in range(MOST_REPEATS + 1):
        try:
            return await _run_case(operator, setup, case)
        except DemoFailed as failed:
            if repeats == MOST_REPEATS or not await operator.has_stopped():
                raise
            await operator.recover(f"the case once more: {failed}", str(failed))
            await _begin_with_repeats(operator)
    raise AssertionError("the last repeat returns or raises")


async def _run_case(operator: "Operator", setup: Setup, case: Scenario) -> Window:
    progress = operator.progress
    await operator.order(SelectRecipe(name=case.name))
    progress.step(f"{case.heading.lower()}: settling at its set-points")
    await operator.wait_settled(case.tension_n, case.speed_m_per_s)
    begin_s = time.monotonic()
    progress.case(case.heading, case.duration_s)
    await operator.watch(case.change_at_s)
    for command in case.commands():
        await operator.order(command)
    await operator.watch(begin_s + case.duration_s - time.monotonic())
    end_s = time.monotonic()
    # Beyond the window, so that it is whole whenever exactly the change took effect.
    await operator.watch(4 * setup.line.control.period_s)
    return Window(case, begin_s, end_s)


def _at_rest(status: GatewayStatus) -> bool:
    quiet = all(span.torque_nm == 0.0 and span.drive != "ENABLED" for span in status.spans)
    return status.loop.state in ("SILENT", "STOP") and quiet


def _end_in_order(children: Children) -> None:
    for name in ("loop", "gateway", "sim"):
        code = children.end(name)
        if code != 0:
            raise DemoFailed(f"{name} ended with exit code {code}: see {children.log(name)}")


class Operator:
    """A person at the command line, scripted: looks at the status, gives commands."""

    def __init__(self, children: Children) -> None:
        self.progress: Progress
        self._children = children
        self.stops: list[str] = []  #: why the line stopped by itself
        self._stopping = False  #: a stop is nothing unexpected
        self._mailbox = UnixMailbox()
        self._mailbox.connect({GATEWAY_STATUS}, children.run_folder / GATEWAY_SOCKET)

    async def close(self) -> None:
        await self._mailbox.close()

    async def order(self, command: Command) -> None:
        self._stopping = isinstance(command, Stop)
        reply = await request(self._children.run_folder, command, timeout_s=15.0)
        if not reply.ok:
            raise DemoFailed(f"{command.command}: {'; '.join([reply.text, *reply.reasons])}")

    async def look(self) -> GatewayStatus | None:
        """The status now; None while the gateway is not up."""
        self._children.check()
        try:
            status = parse_status(await self._mailbox.request(GATEWAY_STATUS, b"", 2.0))
        except Unreachable:
            return None
        self.progress.show(status)
        if status.loop.state == "STOP" and not self._stopping:
            told = [event.text for event in status.events if event.kind == "state"]
            raise DemoFailed(f"the line has stopped: {told[-1] if told else 'no event says why'}")
        return status

    async def wait(self, enough: Callable[[GatewayStatus], bool], within_s: float, what: str) -> None:
        """Look on until `enough(status)`."""
        deadline_s = time.monotonic() + within_s
        while time.monotonic() < deadline_s:
            status = await self.look()
            if status is not None:
                if enough(status):
                    return
            await asyncio.sleep(0.1)
        raise DemoFailed(f"{what} took longer than {within_s:g} s")

    async def has_stopped(self) -> bool:
        """Whether the line has stopped by itself."""
        self._stopping = True
        status = await self.look()
        return status is not None and status.loop.state == "STOP"

    async def begin(self) -> None:
        """From rest to a line that is being tensioned."""
        self.progress.step("arming: limits, line PLC, load cells, the drives' watchdogs")
        await self.order(Arm())
        self.progress.step("tensioning the web, then to speed")
        await self.order(Start())

    async def recover(self, story: str, why: str) -> None:
        """Until torque is off; then a computer that has just stalled is given time to come to itself."""
        self.stops.append(why)
        self.progress.step(story)
        await self.wait_at_rest()
        await asyncio.sleep(1.0)

    async def wait_at_rest(self) -> None:
        """Until torque is off."""
        self._stopping = True
        await self.wait(_at_rest, 20.0, "the stop")

    async def wait_settled(self, tension_n: list[float], speed_m_per_s: float) -> None:
        since_s = time.monotonic()

        def settled(status: GatewayStatus) -> bool:
            nonlocal since_s
            spans = zip(status.spans, tension_n, strict=True)
            near = all(span.setpoint_n == target and abs(span.error_n or 0.0) < SETTLED_N for span, target in spans)
            if not near or status.speed_setpoint_m_per_s != speed_m_per_s:
                since_s = time.monotonic()
            return time.monotonic() - since_s >= SETTLED_FOR_S

        await self.wait(settled, SETTLE_TIME_S, "settling")

    async def watch(self, for_s: float) -> None:
        """Look on for a while."""
        end_s = time.monotonic() + for_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            await asyncio.sleep(min(0.1, left_s))
            await self.look()


def machine_lines(log: Path) -> list[str]:
    """What this computer is, and what it granted the loop, in the loop's own words."""
    kernel = f"{platform.system()} {platform.release()}, Python {platform.python_version()}"
    said = log.read_text(errors="replace").splitlines() if log.exists() else []
    return [kernel, *(text for text in said if "SILENT" not in text)]


def now_iso() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def command_line() -> str:
    return " ".join(["r2rgate", *sys.argv[1:]])
