"""Some of the rows once more in real time: three processes, real wires, faults through the control socket."""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

from gateway.cli.children import free_udp_port
from sim_plant.faults.control import ask
from sim_plant.recording import EVENTS_FILE, Event
from tests.bench.faults_rows import ROWS, Row, Variant, Wanted
from tests.bench.faults_seen import AT_ONCE_S, Injection, Seen, unsafe_of
from tests.bench.lines import WIRINGS, Ports, Wiring, line_text, plant_text
from tests.bench.live import SIM_PRIORITY, LineStalls, LiveLine, at_rest, why
from tests.closed_loop.wire import from_master

PERIOD_S = 0.01
FLUSHED_S = 0.4  #: until what happened is in the recording's file
REST_S = 15.0
STALLED = ("missed", "watchdog")  #: words of a stop for which this computer is to blame
TRIES = 4
#: The full model of the web is compiled before the line's time begins, because a fault of the web is planned.
NEVER = "web 1 slack length_m=0 at 1000000"
SECOND_INSTANCE_BOUND_S = 1.0


class ControlledLine:
    """A live line with a control socket, and what its recorder notes. A context."""

    def __init__(self, folder: Path, wiring: Wiring = WIRINGS["demo"], seed: int = 1, period_s: float = PERIOD_S):
        self.live = LiveLine(folder, period_s)
        self._wiring, self._seed = wiring, seed
        self._read = 0  #: bytes of the events' file
        self.events: list[Event] = []

    def __enter__(self) -> "ControlledLine":
        live = self.live
        try:
            live.describe(line_text(self._wiring, live.period_s, self._start_sim()))
            live.start_gateway()
            live.start_loop()
        except BaseException:
            live.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, *error: Any) -> None:
        self.live.__exit__(*error)

    def _start_sim(self) -> Ports:
        live = self.live
        (live.folder / "plant.toml").write_text(plant_text(self._wiring), encoding="utf-8")
        self.control = live.children.run_folder / "control.sock"
        ready = live.children.start_sim(
            live.folder / "plant.toml", "--record", live.folder / "recording", "--seed", str(self._seed),
            "--can-port", str(free_udp_port()), "--modbus-port", "0", "--opcua-port", "0",
            "--priority", str(SIM_PRIORITY), "--control", self.control, "--fault", NEVER,
        )  # fmt: skip
        live.world_start_s = ready["monotonic_start_s"]
        return Ports(ready["can_port"], ready["modbus_port"], ready["opcua_port"])

    def inject(self, fault: str) -> float:
        """Returns when (world time). Raises ValueError with the reason when it is refused."""
        return self._ask({"do": "inject", "fault": fault})["time_s"]

    def clear(self) -> None:
        """End all faults, but for the one that never comes."""
        for fault in self._ask({"do": "list"})["faults"]:
            if fault["fault"] != NEVER and fault["acts"]:
                self._ask({"do": "clear", "number": fault["number"]})

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        answer = ask(self.control, request)
        if not answer["ok"]:
            raise ValueError(answer["reason"])
        return answer

    def read(self) -> list[Event]:
        """What the recorder has noted since the last call."""
        with (self.live.folder / "recording" / EVENTS_FILE).open("rb") as file:
            file.seek(self._read)
            whole, newline, _ = file.read().rpartition(b"\n")
        self._read += len(whole) + len(newline)
        return [json.loads(line) for line in whole.splitlines()]


def injections(rows: list[Row], count: int, progress: Callable[[], object]) -> list[Injection]:
    """`count` injections of each row that can be done from outside. `progress()` is called after each."""
    results: list[Injection] = []
    with tempfile.TemporaryDirectory() as folder, ControlledLine(Path(folder)) as line:
        for row in rows:
            variants = [variant for variant in row.variants if _from_outside(row, variant)]
            for number in range(count if variants else 0):
                dice = Random(f"wire/{row.id}/{number}")
                results.append(_inject(line, row, variants[number % len(variants)], dice))
                progress()
    return results


def _from_outside(row: Row, variant: Variant) -> bool:
    """What has one name, and is no matter of a single frame on a wire that also carries heartbeats."""
    if len(variant.faults) != 1:
        return False
    single_frame = row.wanted is not Wanted.STOP and not row.id.startswith(("cell", "encoder"))
    return not (single_frame and "drive {roller}" in variant.faults[0])


def _inject(line: ControlledLine, row: Row, variant: Variant, dice: Random) -> Injection:
    """Again when this computer stalled meanwhile, which stops a line as well."""
    injection = Injection(row.id, variant.name, "machine stalled", None, None, None, {}, "not measured")
    for _ in range(TRIES):
        try:
            line.live.run()
        except LineStalls:
            continue
        tried = _try(line, row, variant, dice)
        if tried is not None:
            return tried
    return injection


def _try(line: ControlledLine, row: Row, variant: Variant, dice: Random) -> Injection | None:
    live = line.live
    time.sleep(dice.uniform(0.5, 0.5 + live.period_s * 10))  # a random phase
    line.read()
    time.sleep(FLUSHED_S)
    fault = variant.faults[0].format(
        roller=dice.randint(1, 6), span=dice.randint(1, 6), period=live.period_s, six_periods=6 * live.period_s,
        late_s=0.9 * live.period_s, code=0x2310, jump=dice.choice((-1.0, 1.0)), slack_m=0.05,
    )  # fmt: skip
    begin_s = line.inject(fault)
    if row.wanted is Wanted.STOP:
        try:
            live.wait(at_rest, REST_S)
        except TimeoutError:
            pass  # the fault was not noticed: that is the result
    else:
        time.sleep(2 * FLUSHED_S)
    status = live.status()
    line.clear()
    time.sleep(FLUSHED_S)
    noted = line.read()
    stopped = status is not None and status.loop.state != "RUN"
    reason = why(status) if status is not None and stopped else ""
    if stopped and any(word in reason for word in STALLED) and not row.id.startswith("receiver"):
        return None
    before = {event["roller"]: event for event in noted if event["kind"] == "command" and event["time_s"] < begin_s}
    since = [event for event in noted if event["time_s"] >= begin_s - AT_ONCE_S]
    speed = live.line.recipes[0].speed_m_per_s
    reach_nm = live.line.moves.torque_off_rate_nm_per_s * live.period_s
    seen = Seen(since, before, speed, reach_nm, live.period_s)
    stop_s, hold_s = seen.stop_s(), seen.hold_s()
    at_s = stop_s if stop_s is not None else hold_s
    reaction = "stop" if stop_s is not None else "held" if hold_s is not None else "nothing"
    off = [event["time_s"] for event in since if event["kind"] == "torque" and event["torque_nm"] == 0.0]
    off_s = max(off) - begin_s if off and stopped else None
    unsafe = unsafe_of(noted, row)
    detected_s = None if at_s is None else at_s - begin_s
    return Injection(row.id, variant.name, reaction, detected_s, None, off_s, unsafe, f"{fault}: {reason}")


def second_instance(count: int, progress: Callable[[], object]) -> list[Injection]:
    """A second loop of the same line: how long until it has exited, and whether it sent anything."""
    results: list[Injection] = []
    with tempfile.TemporaryDirectory() as folder, ControlledLine(Path(folder)) as line:
        live = line.live
        command = [
            sys.executable, "-m", "gateway.cli", "loop", str(live.folder / "line.toml"), "--controller",
            str(live.folder / "controller.json"), "--run-dir", str(live.children.run_folder), "--data-dir",
            str(live.folder / "data"),
        ]  # fmt: skip
        for _ in range(count):
            with _tap(live) as bus:
                begun_s = time.monotonic()
                done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
                took_s = time.monotonic() - begun_s
                sent = _from_masters(bus)
            refused = done.returncode == 3 and "already" in done.stderr and not sent
            note = f"exit code {done.returncode}, {sent} frames of a master: {done.stderr.strip()[-200:]}"
            reaction = "refused" if refused else "wrong"
            results.append(Injection("second-instance", "loop", reaction, took_s, None, None, {}, note))
            progress()
    return results


def _tap(live: LiveLine) -> Any:
    import can

    bus = next(bus for bus in live.line.buses if bus.protocol == "canopen")
    return can.Bus(interface="udp_multicast", channel=bus.channel, port=bus.port, hop_limit=0, fd=False)


def _from_masters(bus: Any) -> int:
    frames = iter(lambda: bus.recv(0.1), None)
    end_s = time.monotonic() + 0.3
    sent = 0
    for frame in frames:
        sent += from_master(frame)
        if time.monotonic() > end_s:
            break
    return sent


WIRE_ROWS = [row for row in ROWS if row.wanted in (Wanted.STOP, Wanted.HOLD)]
