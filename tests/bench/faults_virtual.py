"""One fault after another on a virtual line, each timed by what the recorder at the devices saw.

The bench keeps its own list of what the recorder notes, as it is noted: reading a growing recording for each injection
would take longer than the injections.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from random import Random
from typing import Any

import can

from gateway.core.states import Phase
from gateway.core.telemetry import unpack
from sim_plant.faces.modbus_codec import TARGET_SILENT, Frame, exception_answer
from sim_plant.faults.parse import parse_fault
from sim_plant.recording import Event
from tests.bench.faults_lines import DEMO, virtual_line
from tests.bench.faults_rows import HEARTBEAT_S, Row, Variant, Wanted
from tests.bench.faults_seen import AT_ONCE_S, Injection, Seen, unsafe_of
from tests.bench.lines import AMPLIFIER_NODE, PLC_NODE
from tests.closed_loop.virtual_line import VirtualLine

CHANNEL = "239.74.163.2"
OBSERVED_PERIODS = 130  #: of a fault that should stop the line, until it counts as unseen
UNIT = {"load-cell": 1, "plc": 2}


class Recorded:
    """The recorder's notes, as they come."""

    def __init__(self, line: VirtualLine) -> None:
        self.events: list[Event] = []
        recorder = line.truth.recorder
        note = recorder.note

        def tee(kind: str, now_s: float, **what: Any) -> None:
            self.events.append({"kind": kind, "time_s": now_s, **what})
            note(kind, now_s, **what)

        recorder.note = tee


@dataclass
class Bench:
    """A virtual line, in production whenever an injection begins."""

    line: VirtualLine
    dice: Random
    recorded: Recorded = field(init=False)
    exceptions: dict[int, int] = field(default_factory=dict[int, int])  #: answers still to be refused, by unit
    heartbeats_s: dict[int, float] = field(default_factory=dict[int, float])  #: last one, by node

    def __post_init__(self) -> None:
        self.recorded = Recorded(self.line)
        self._listen()
        self._refuse()

    def begin(self, row: Row) -> None:
        """From rest to production, ready for `row`. Raises AssertionError when it cannot."""
        self.line.begin_in_production()
        self.line.step(row.settle_periods + self.dice.randrange(10))

    def inject(self, row: Row, variant: Variant) -> Injection:
        """One fault, and what comes of it; the line is at rest, or runs on, afterwards."""
        line, events = self.line, self.recorded.events
        values = self._values()
        if variant.spares_heartbeat_s:
            self._avoid_heartbeat(_node(variant, values), variant.spares_heartbeat_s)
        line.pass_time(self.dice.random() * line.period_s)
        events_before, frames_before = len(events), len(line.frames)
        before = {event["roller"]: event for event in self._last_commands()}
        speed_before = line.cycle.outputs.speed_request_m_per_s
        begin_s = self._now_s()
        for text in variant.faults:
            line.truth.faults.injector.add(parse_fault(_at(text.format(**values), begin_s, values)), begin_s)
        if variant.action:
            begin_s = ACTIONS[variant.action.split()[0]](self, variant.action.split()[1:], values)
        elif len(variant.faults) > 1:
            begin_s += values["again_s"]
        self._observe(row)
        since = [event for event in events[events_before:] if event["time_s"] >= begin_s - AT_ONCE_S]
        telemetry = [unpack(frame) for frame in line.frames[frames_before:]]
        seen = Seen(
            since, before, speed_before, line.line.moves.torque_off_rate_nm_per_s * line.period_s, line.period_s,
            [line.world_s(frame.time_s) for frame in telemetry if frame.held],
        )  # fmt: skip
        reaction, at_s = self._reaction(row, seen)
        due_s = (line.world_s(frame.time_s) for frame in telemetry)
        first_s = min((tick_s for tick_s in due_s if tick_s >= begin_s - AT_ONCE_S), default=begin_s)
        torque_off_s = self._torque_off_s(since, begin_s)
        if variant.action == "gone" and torque_off_s is not None:
            at_s = begin_s + torque_off_s
        unsafe = unsafe_of(events[events_before:], row)
        self._tidy()
        note = f"{' '.join(variant.faults).format(**values)}: {line.cycle.machine.reason}"
        detected_s = None if at_s is None else at_s - begin_s
        met_s = None if at_s is None else at_s - first_s
        return Injection(row.id, variant.name, reaction, detected_s, met_s, torque_off_s, unsafe, note)

    def _reaction(self, row: Row, seen: Seen) -> tuple[str, float | None]:
        """What the devices were told, and when."""
        hold_s = seen.hold_s()
        stops_s = [at_s for at_s in (seen.stop_s(), self._left_alone_s(seen)) if at_s is not None]
        if stops_s or self.line.cycle.machine.phase is not Phase.RUNNING:
            return "stop", min(stops_s, default=None)
        return ("held", hold_s) if hold_s is not None else ("nothing", None)

    def _left_alone_s(self, seen: Seen) -> float | None:
        """When the loop, having decided to stop, had ceased to command; the drives' watchdogs do the rest."""
        ceased_s, stopped = seen.ceased_s(), self.line.transitions[-3:]
        decided = [at.time_s for at in stopped if at.phase in (Phase.SLOWING, Phase.UNLOADING)]
        return None if ceased_s is None or not decided else max(ceased_s, self.line.world_s(decided[0]))

    def _values(self) -> dict[str, Any]:
        dice, line = self.dice, self.line
        period_s = line.period_s
        jump = dice.choice((-1, 1)) * dice.uniform(0.5, 2.0)
        return {
            "roller": dice.randint(1, line.line.n), "span": dice.randint(1, line.line.n),
            "period": period_s, "six_periods": 6 * period_s, "late_s": round(dice.uniform(0.55, 0.9) * period_s, 4),
            "very_late_s": round(dice.uniform(1.05, 1.45) * period_s, 4),
            "code": dice.choice((0x2310, 0x3210, 0x4210, 0x8100, 0xFF01)), "jump": round(jump, 3),
            "again_s": round(dice.uniform(3, 80) * period_s, 4), "slack_m": round(dice.uniform(0.03, 0.1), 4),
        }  # fmt: skip

    def _observe(self, row: Row) -> None:
        """Go on until the line rests, or long enough to see that it runs on."""
        line = self.line
        for _ in range(OBSERVED_PERIODS if row.wanted is Wanted.STOP else row.pause_periods):
            line.step()
            if line.cycle.machine.phase not in (Phase.RUNNING,):
                break
        if line.cycle.machine.phase is not Phase.RUNNING:
            line.step_until(Phase.OFF, line.line.longest_stop_s)
            line.step(15)

    def _tidy(self) -> None:
        self.exceptions.clear()
        self.line.truth.faults.injector.clear(None, self._now_s())
        if self.line.cycle.machine.phase is not Phase.RUNNING:
            self.line.step(30)  # answers that were late have passed, devices have booted

    def _torque_off_s(self, since: list[Event], begin_s: float) -> float | None:
        """When the last drive lost its torque; None while there is some."""
        if self.line.truth.world.torque_nm.any():
            return None
        last = [event["time_s"] for event in since if event["kind"] == "torque" and event["torque_nm"] == 0.0]
        return max(last, default=begin_s) - begin_s

    def _now_s(self) -> float:
        return self.line.truth.faults.now_s()

    def _last_commands(self) -> list[Event]:
        n = self.line.line.n
        return [event for event in self.recorded.events[-40 * n :] if event["kind"] == "command"][-n:]

    # what no fault has a name for

    def _listen(self) -> None:
        face = self.line.truth.canopen
        if face is None:
            return
        send = face.send

        def tap(can_id: int, data: bytes) -> None:
            if can_id & 0x780 == 0x700:
                self.heartbeats_s[can_id & 0x7F] = self._now_s()
            send(can_id, data)

        face.send = tap

    def _avoid_heartbeat(self, node: int, for_s: float) -> None:
        """Go on until none of the node's heartbeats is due for so long."""
        while node in self.heartbeats_s:
            due_s = self.heartbeats_s[node] + HEARTBEAT_S - self._now_s()
            if due_s > for_s + 2 * self.line.period_s:
                return
            self.line.step()

    def _refuse(self) -> None:
        face = self.line.truth.modbus
        if face is None:
            return
        answer = face.answer

        def refused(frame: Frame, now_s: float) -> bytes:
            if self.exceptions.get(frame.unit, 0) <= 0:
                return answer(frame, now_s)
            self.exceptions[frame.unit] -= 1
            pdu = exception_answer(frame.pdu[0], TARGET_SILENT)
            return b"".join((
                frame.transaction.to_bytes(2, "big"), b"\0\0", (1 + len(pdu)).to_bytes(2, "big"),
                bytes((frame.unit,)), pdu,
            ))  # fmt: skip

        face.answer = refused

    def refuse(self, arguments: list[str], values: dict[str, Any]) -> float:
        """Modbus exceptions of one device: one answer, or six."""
        self.exceptions[UNIT[arguments[0]]] = 1 if arguments[1:] else 6
        return self._now_s()

    def foreign_nmt(self, arguments: list[str], values: dict[str, Any]) -> float:
        """Another master commands a drive."""
        now_s = self._now_s()
        with can.Bus(
            interface="udp_multicast", channel=CHANNEL, port=self.line.truth.can_port, hop_limit=0, fd=False
        ) as bus:
            data = bytes((int(arguments[0]), values["roller"]))
            bus.send(can.Message(arbitration_id=0, data=data, is_extended_id=False))
        return now_s

    def stall(self, arguments: list[str], values: dict[str, Any]) -> float:
        """Periods missed at once. Returns the last wake-up: before it nobody can react."""
        line = self.line
        for k, periods in enumerate(arguments):
            line.stall(int(periods))
            if k < len(arguments) - 1:
                line.step()
        due_s = line.world_s(line.now_s) + (int(arguments[-1]) + 1) * line.period_s
        return line.period_s * int(due_s / line.period_s)

    def gone(self, arguments: list[str], values: dict[str, Any]) -> float:
        """No period any more. Returns the last command."""
        last_s = max(event["time_s"] for event in self._last_commands())
        self.line.pass_time(0.3)
        return last_s


ACTIONS: dict[str, Callable[[Bench, list[str], dict[str, Any]], float]] = {
    "exception": Bench.refuse,
    "nmt": Bench.foreign_nmt,
    "stall": Bench.stall,
    "gone": Bench.gone,
}


def _at(text: str, begin_s: float, values: dict[str, Any]) -> str:
    """`at` counts from the injection."""
    marker = f"at {values['again_s']}"
    return text.replace(marker, f"at {begin_s + values['again_s']:.6f}")


def _node(variant: Variant, values: dict[str, Any]) -> int:
    """The CANopen node that a variant is about, where its device is one."""
    return {"drive": values["roller"], "load-cell": AMPLIFIER_NODE, "plc": PLC_NODE}[variant.name.split()[0]]


@contextmanager
def bench_line(seed: int, row: Row, wiring: str = DEMO) -> Iterator[Bench]:
    """A line in production, ready for `row`."""
    with virtual_line(wiring, seed) as line:
        bench = Bench(line, Random(seed))
        bench.begin(row)
        yield bench


def _fits(variant: Variant, wiring: str) -> bool:
    """Modbus exceptions are for the units of the demonstration. An answer of several PDOs may come in any order.

    Frames of OPC UA pass untouched in virtual time: there is no proxy in front of the server.
    """
    if wiring == "mixed" and variant.name.startswith("plc "):
        return False
    if variant.name == "load-cell reorder":
        return wiring != "canopen"
    return wiring == DEMO or not variant.action.startswith("exception")


def injections(row: Row, numbers: list[int], wiring: str = DEMO) -> list[Injection]:
    """The injections of these numbers, one variant after the other, on as few lines as will do."""
    variants = [variant for variant in row.variants if _fits(variant, wiring)]
    results: list[Injection] = []
    left = list(numbers)
    while left:
        with bench_line(1 + left[0], row, wiring) as bench:
            while left:
                number = left.pop(0)
                bench.dice.seed(f"{row.id}/{number}")
                results.append(bench.inject(row, variants[number % len(variants)]))
                if bench.line.cycle.machine.phase is Phase.RUNNING:
                    bench.line.step(row.pause_periods)
                    continue
                try:
                    bench.begin(row)
                except AssertionError:  # some faults leave nothing to go on with
                    break
    return results
