"""A line in its three processes over real wires, for tests that start, kill and watch them from outside."""

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Self

import can

from gateway.cli.children import Children
from gateway.cli.operate_commands import request
from gateway.control.design import design_lqi, task_of
from gateway.core.controller import canonical
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.messages import Arm, Command, Reply, Start
from gateway.core.status import GatewayStatus
from gateway.core.topics import GATEWAY_STATUS
from gateway.mailbox.paths import GATEWAY_SOCKET
from gateway.mailbox.port import Unreachable
from gateway.mailbox.unix import UnixMailbox
from sim_plant.recorder import read_recording
from sim_plant.recording import Recording
from tests.support.ports import free_port
from tests.support.proved import record_proof, store_proof

CHANNEL = "239.74.163.2"


class WireLine:
    """Context: everything it started is ended at its end."""

    def __init__(self, folder: Path, seed: int = 1, spans: int = 6, gate: str = "") -> None:
        """`gate`: more rows for the line's `[gate]`."""
        (folder / "logs").mkdir()
        self.folder = folder
        self.children = Children(folder / "logs")
        self.folders = ("--run-dir", self.children.run_folder, "--data-dir", folder / "data")
        with ExitStack() as undo:
            undo.push(self.children)
            self._describe(seed, spans, gate)
            undo.pop_all()

    def _describe(self, seed: int, spans: int, gate: str) -> None:
        """The simulated line runs from here on; the line's file and a first controller are those of its ports."""
        folder = self.folder
        self.can_port = free_port()
        plant = Path("sim_plant/plants/s_real.toml").read_text().replace("spans = 6", f"spans = {spans}")
        (folder / "plant.toml").write_text(plant)
        ready = self.children.start_sim(
            folder / "plant.toml", "--record", folder / "recording", "--seed", str(seed),
            "--can-port", str(self.can_port), "--modbus-port", "0", "--priority", "40",
        )  # fmt: skip
        self.world_start_s: float = ready["monotonic_start_s"]
        text = line_template(spans, "line.toml").replace("port = 43113", f"port = {self.can_port}")
        text = text.replace("start_warning_s = 3.0", "start_warning_s = 0.0")  # nobody is near
        text = text.replace("port = 5020", f"port = {ready['modbus_port']}")
        text = text.replace('autonomy = "approve-all" ', f'{gate}\nautonomy = "approve-all" ')
        (folder / "line.toml").write_text(text)
        self.line = load_line(text, "line.toml")
        (folder / "controller.json").write_bytes(canonical(design_lqi(task_of(self.line))))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.children.__exit__(None, None, None)

    def start_gateway(self, *, proved: bool = True) -> None:
        """`proved`: its audit knows the proof that `start_loop` stores."""
        if proved:
            record_proof(self.line, self.folder / "data")
        self.children.start("gateway", self.folder / "line.toml", *self.folders)

    def start_loop(self, *, proved: bool = True) -> None:
        """`proved`: its wiring, as `r2rgate prove` would have."""
        if proved:
            store_proof(self.line, self.folder / "data")
        self.children.start(
            "loop", self.folder / "line.toml", "--controller", self.folder / "controller.json", *self.folders
        )

    def run(self) -> None:
        """All processes up, the line RUN at its first recipe and settled."""
        self.start_gateway()
        self.start_loop()
        self.wait(lambda status: status.loop.running)
        self.arm_and_start()

    def arm_and_start(self) -> None:
        """From rest to RUN, settled."""
        for _ in range(3):
            for command in (Arm(), Start()):
                reply = self.order(command)
                assert reply.ok, reply
            status = self.wait(lambda status: settled(status) or at_rest(status))
            if settled(status):
                return
            # A test machine that stalls for longer than loop or devices may miss stops the line, as it must.
        raise AssertionError("this machine stalls too often for a line in real time")

    def inject(self, fault: str) -> None:
        """Into the simulated line, as `r2rgate fault inject` does."""
        command = [
            sys.executable,
            "-m",
            "gateway.cli",
            "fault",
            "inject",
            "--control",
            self.folder / "recording",
            fault,
        ]
        subprocess.run(command, check=True, capture_output=True)

    def order(self, command: Command) -> Reply:
        return asyncio.run(request(self.children.run_folder, command, 15.0))

    def status(self) -> GatewayStatus | None:
        async def ask() -> bytes:
            mailbox = UnixMailbox()
            mailbox.connect({GATEWAY_STATUS}, self.children.run_folder / GATEWAY_SOCKET)
            try:
                return await mailbox.request(GATEWAY_STATUS, b"", 2.0)
            finally:
                await mailbox.close()

        try:
            return GatewayStatus.model_validate_json(asyncio.run(ask()))
        except Unreachable:
            return None

    def wait(self, enough: Callable[[GatewayStatus], bool], within_s: float = 60.0) -> GatewayStatus:
        status = None
        deadline_s = time.monotonic() + within_s
        while time.monotonic() < deadline_s:
            status = self.status()
            if status is not None and enough(status):
                return status
            time.sleep(0.05)  # a person looks at the status now and then
        raise AssertionError(f"not reached within {within_s} s: {status}")

    def wait_at_rest(self, within_s: float = 15.0) -> None:
        """Until the recorder has seen no torque for 0.1 s; for when there is no gateway to ask."""
        deadline_s = time.monotonic() + within_s
        while read_recording(self.folder / "recording", events=False).torque_nm[-100:].any():
            assert time.monotonic() < deadline_s, "there is torque still"
            time.sleep(0.05)  # between two looks

    def kill(self, name: str) -> float:
        """SIGKILL; returns the time (world)."""
        now_s = time.monotonic() - self.world_start_s
        os.kill(self.children.pid(name), signal.SIGKILL)
        return now_s

    def recording(self) -> Recording:
        """What the recorder has; ends the simulated line in order if it still runs."""
        self.children.end("sim")
        return read_recording(self.folder / "recording")

    def unsafe(self) -> dict[str, int]:
        return json.loads((self.folder / "recording" / "summary.json").read_text())["unsafe_events"]

    def tap(self) -> can.BusABC:
        """A listener on the CAN wire that shares nothing with either side."""
        return can.Bus(interface="udp_multicast", channel=CHANNEL, port=self.can_port, hop_limit=0, fd=False)


def at_rest(status: GatewayStatus) -> bool:
    return status.loop.phase == "OFF" and all(span.torque_nm == 0.0 for span in status.spans)


def settled(status: GatewayStatus) -> bool:
    return (
        status.loop.state == "RUN"
        and status.speed_setpoint_m_per_s == 0.01
        and all(abs(span.error_n or 0.0) < 0.6 for span in status.spans)
    )


def heard(bus: can.BusABC, for_s: float) -> list[can.Message]:
    """Everything on the wire within `for_s`, each with the monotonic time at which it was read."""
    frames: list[can.Message] = []
    end_s = time.monotonic() + for_s
    while (left_s := end_s - time.monotonic()) > 0.0:
        frame = bus.recv(left_s)
        if frame is not None:
            frames.append(frame)
    return frames


def from_master(frame: can.Message) -> bool:
    """NMT, SYNC, RPDO1 and SDO requests: what only a master sends."""
    return (
        frame.arbitration_id in (0x000, 0x080)
        or 0x200 < frame.arbitration_id < 0x280
        or 0x600 < frame.arbitration_id < 0x680
    )


def silent_periods_until_ramp(frames: list[can.Message]) -> int:
    """SYNCs in a row without any answer until a torque command differs from the one held since the first of them."""
    silent = 0
    held: dict[int, bytes] = {}
    for frame in frames:
        cob_id = frame.arbitration_id
        if 0x180 < cob_id < 0x200:
            silent, held = 0, {}
        elif cob_id == 0x80:
            silent += 1
        elif 0x200 < cob_id < 0x280 and silent:
            torque = bytes(frame.data[2:4])
            if held.setdefault(cob_id, torque) != torque:
                return silent
        elif cob_id == 0x000 and silent:  # told to leave operational: torque off
            return silent
    raise AssertionError("the torque commands never moved")
