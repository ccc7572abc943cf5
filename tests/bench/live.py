"""A line of any wiring in its own processes: simulated line, gateway, loop. For benches and system tests."""

import asyncio
import json
import os
import signal
import time
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from gateway.cli.children import Children, free_udp_port
from gateway.cli.line_commands import known_maps
from gateway.cli.operate_commands import request
from gateway.control.design import design_lqi, task_of
from gateway.core.controller import canonical
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.messages import Arm, Command, Reply, Start, Stop
from gateway.core.status import GatewayStatus
from gateway.core.topics import GATEWAY_STATUS
from gateway.mailbox.paths import GATEWAY_DATA, GATEWAY_SOCKET
from gateway.mailbox.port import Unreachable
from gateway.mailbox.unix import UnixMailbox
from gateway.supervisor.historian import FILE_NAME
from gateway.supervisor.history import History
from sim_plant.recorder import read_recording
from sim_plant.recording import Recording
from tests.bench.lines import UDP_MULTICAST, CanWire, Ports, Wiring, line_text, plant_text
from tests.support.proved import record_proof, store_proof

SIM_PRIORITY = 40  #: below the loop's
SETTLED_N = 1.0  #: a measured tension this near its set-point has settled (ten times the sensors' noise)
LOOK_S = 0.05  #: between two looks at the status
RECOVERY_S = 1.0  #: for a computer that has just stalled to come to itself
STARTS = 5  #: tries to start the line: a test machine that stalls stops it, as it must


class LineStalls(Exception):
    """The line does not come to run, however often it is tried; the text says why it stopped."""


class LiveLine:
    """A context: everything that it started is ended at its end."""

    def __init__(self, folder: Path, period_s: float, settle_s: float = 30.0) -> None:
        self.folder = folder
        self.period_s = period_s
        self.settle_s = settle_s
        (folder / "logs").mkdir(parents=True, exist_ok=True)
        self.children = Children(folder / "logs")
        self.loop_started_s = 0.0  #: monotonic, just before the process was made
        self.world_start_s = 0.0  #: monotonic time of the recording's zero
        self.line: Line
        self.stops: list[str] = []  #: why a start came to nothing

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.children.__exit__(kind, error, trace)

    # processes

    def start_sim(self, wiring: Wiring, can: CanWire = UDP_MULTICAST, seed: int = 1, spans: int = 6) -> Ports:
        """The simulated line, on free ports."""
        (self.folder / "plant.toml").write_text(plant_text(wiring, can, spans), encoding="utf-8")
        ready = self.children.start_sim(
            self.folder / "plant.toml", "--record", self.folder / "recording", "--seed", str(seed),
            "--can-port", str(free_udp_port()), "--modbus-port", "0", "--opcua-port", "0",
            "--priority", str(SIM_PRIORITY),
        )  # fmt: skip
        self.world_start_s = ready["monotonic_start_s"]
        can_port = ready["can_port"] if can.interface == "udp_multicast" else None
        return Ports(can_port, ready["modbus_port"], ready["opcua_port"])

    def describe(self, text: str) -> None:
        """Write the line's file and a controller designed for it."""
        (self.folder / "line.toml").write_text(text, encoding="utf-8")
        self.line = load_line(text, "line.toml", known_maps())
        (self.folder / "controller.json").write_bytes(canonical(design_lqi(task_of(self.line))))

    def start_gateway(self) -> None:
        """And wait until it answers. Its audit knows the proof of the wiring."""
        record_proof(self.line, self.folder / "data")
        self.children.start("gateway", self.folder / "line.toml", *self._folders)
        self.wait(lambda status: True)

    def start_loop(self) -> None:
        """And wait until it has heard of every device. Its wiring counts as proved."""
        store_proof(self.line, self.folder / "data")
        self.loop_started_s = time.monotonic()
        controller = self.folder / "controller.json"
        self.children.start("loop", self.folder / "line.toml", "--controller", controller, *self._folders)
        self.wait(all_heard)

    def start(self, wiring: Wiring, can: CanWire = UDP_MULTICAST, seed: int = 1) -> None:
        """All three processes; the loop is SILENT."""
        self.describe(line_text(wiring, self.period_s, self.start_sim(wiring, can, seed), can))
        self.start_gateway()
        self.start_loop()

    @property
    def _folders(self) -> tuple[str | Path, ...]:
        return ("--run-dir", self.children.run_folder, "--data-dir", self.folder / "data")

    # the operator

    def order(self, command: Command) -> Reply:
        return asyncio.run(request(self.children.run_folder, command, 20.0))

    def status(self) -> GatewayStatus | None:
        """None while the gateway is not up."""

        async def ask() -> bytes:
            mailbox = UnixMailbox()
            mailbox.connect({GATEWAY_STATUS}, self.children.run_folder / GATEWAY_SOCKET)
            try:
                return await mailbox.request(GATEWAY_STATUS, b"", 2.0)
            finally:
                await mailbox.close()

        with suppress(Unreachable):
            return GatewayStatus.model_validate_json(asyncio.run(ask()))
        return None

    def wait(self, enough: Callable[[GatewayStatus], bool], within_s: float = 60.0) -> GatewayStatus:
        """Look on until `enough(status)`. Raises TimeoutError, and ChildFailed when a process has ended."""
        status = None
        deadline_s = time.monotonic() + within_s
        while time.monotonic() < deadline_s:
            self.children.check()
            status = self.status()
            if status is not None and enough(status):
                return status
            time.sleep(LOOK_S)
        raise TimeoutError(f"not reached within {within_s} s: {status}")

    def run(self) -> None:
        """From rest to RUN, settled at the first recipe. Raises LineStalls."""
        for _ in range(STARTS):
            stops = self._run_once()
            if not stops:
                return
            self.stops += stops
            self.wait(at_rest)
            time.sleep(RECOVERY_S)
        raise LineStalls(f"not started in {STARTS} tries: {'; '.join(self.stops)}")

    def _run_once(self) -> list[str]:
        """Why it did not come to run; nothing when it did, or went on running."""
        status = self.status()
        runs = status is not None and status.loop.state == "RUN"
        for command in () if runs else (Arm(), Start()):
            reply = self.order(command)
            if not reply.ok:
                return [f"{command.command}: {'; '.join([reply.text, *reply.reasons])}"]
        status = self.wait(lambda status: self.settled(status) or status.loop.state == "STOP", self.settle_s)
        return [why(status)] if status.loop.state == "STOP" else []

    def settled(self, status: GatewayStatus) -> bool:
        """In RUN, at the first recipe's speed and tensions."""
        recipe = self.line.recipes[0]
        near = all(abs(span.error_n) < SETTLED_N if span.error_n is not None else False for span in status.spans)
        return status.loop.state == "RUN" and status.speed_setpoint_m_per_s == recipe.speed_m_per_s and near

    def stop(self) -> None:
        """To rest."""
        reply = self.order(Stop())
        if not reply.ok:
            raise LineStalls(f"the stop was refused: {reply.text}")
        self.wait(at_rest)

    def kill(self, name: str) -> float:
        """SIGKILL; returns when (world time)."""
        now_s = time.monotonic() - self.world_start_s
        os.kill(self.children.pid(name), signal.SIGKILL)
        return now_s

    # the evidence

    def history(self, start_s: float, end_s: float, *fields: str) -> dict[str, Any]:
        """What the gateway has stored of the loop's frames between two monotonic times. End the gateway first."""
        with closing(History(self.folder / "data" / GATEWAY_DATA / FILE_NAME)) as file:
            found = file.read(start_s, end_s, fields)
            if file.damaged:
                raise LineStalls(f"the history is damaged: {'; '.join(file.damaged)}")
        return found

    def recording(self) -> Recording:
        """What the recorder has seen; ends the simulated line in order if it still runs."""
        self.children.end("sim")
        return read_recording(self.folder / "recording")

    def unsafe(self) -> list[str]:
        """What the recorder has seen, once the simulated line has ended."""
        events = read_recording(self.folder / "recording").of_kind("unsafe")
        return [json.dumps({key: value for key, value in event.items() if key != "kind"}) for event in events]


def all_heard(status: GatewayStatus) -> bool:
    """Every device answers, and every load cell has said something."""
    there = bool(status.buses) and not any(bus.absent for bus in status.buses)
    return status.loop.running and there and all(span.tension_n is not None for span in status.spans)


def at_rest(status: GatewayStatus) -> bool:
    """Torque is off, and every drive says so or is not heard."""
    quiet = all(span.torque_nm == 0.0 and span.drive != "ENABLED" for span in status.spans)
    return status.loop.state in ("SILENT", "STOP") and quiet


def why(status: GatewayStatus) -> str:
    """Why the line has last changed its state."""
    told = [event.text for event in status.events if event.kind == "state"]
    return told[-1] if told else "no event says why"
