"""How soon the simulated line answers: `python -m tests.bench.answer [--lines canopen,modbus] [--seconds 10]`.

A bare client at 100 Hz, without a line of the gateway's drivers: on CANopen from a SYNC to the last TPDO of six drives,
amplifier and line PLC, on Modbus TCP from a request of function 23 to the rack to its answer. As in production, drives
are enabled and commanded anew in every cycle. The simulated line is a process of its own, with the real-time priority
of the other benches; so is the client, where that is permitted.
"""

import argparse
import socket
import struct
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from multiprocessing import get_context
from pathlib import Path

import msgpack
import numpy as np
from numpy.typing import NDArray

from gateway.loop.realtime import become_punctual, freeze_collector, stay_awake
from tests.bench.cycle import PRIORITY
from tests.bench.lines import AMPLIFIER_NODE, PLC_NODE, RACK_UNIT, UDP_MULTICAST, WIRINGS, Ports
from tests.bench.live import LiveLine

PERIOD_S = 0.01
PATIENCE_S = 0.5  #: for one cycle's answers
SPANS = 6
CONTROLWORDS = (0x06, 0x07, 0x0F)  #: shutdown, switch on, enable operation; the last is kept
TORQUES_PER_MILLE = (20, 21)  #: in turn, so that every cycle changes the torque
ENABLED_MASK, ENABLED = 0x6F, 0x27  #: of the statusword: operation enabled
STATUSWORD_AT = 8  #: register of the rack
CST = 10  #: mode cyclic synchronous torque
PAUSE_S = 1e-3  #: between the last answer and the commands, as a controller computes meanwhile

NMT, SYNC, TPDO, RPDO = 0x000, 0x080, 0x180, 0x200
ANSWERS = {TPDO + node for node in range(1, SPANS + 1)} | {TPDO + PLC_NODE} | {
    TPDO + 0x100 * pair + AMPLIFIER_NODE for pair in range((SPANS + 1) // 2)
}  # fmt: skip


class CanClient:
    """CAN frames as python-can's `udp_multicast` packs them, on a socket of its own."""

    def __init__(self, port: int) -> None:
        self._to = (UDP_MULTICAST.channel, port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        for option in (socket.SO_REUSEADDR, socket.SO_REUSEPORT):
            self._socket.setsockopt(socket.SOL_SOCKET, option, 1)
        self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        self._socket.bind(("", port))
        group = socket.inet_aton(UDP_MULTICAST.channel) + socket.inet_aton("0.0.0.0")
        self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        self._socket.settimeout(PATIENCE_S)
        self._sync = _packed(SYNC, b"")
        self._send(_packed(NMT, bytes((1, 0))))  # all nodes operational
        self.statusword = 0  #: of drive 1, in its last answer

    def cycle(self, number: int) -> float:
        began_s = time.perf_counter()
        self._send(self._sync)
        missing = set(ANSWERS)
        while missing:
            frame = msgpack.unpackb(self._socket.recv(4096))
            missing.discard(frame["arbitration_id"])
            if frame["arbitration_id"] == TPDO + 1:
                self.statusword = int.from_bytes(frame["data"][:2], "little")
        took_s = time.perf_counter() - began_s
        time.sleep(PAUSE_S)
        for frame in self._commands(number):
            self._send(frame)
        return took_s

    def _commands(self, number: int) -> list[bytes]:
        word, per_mille = _command(number)
        drive = struct.pack("<Hhb", word, per_mille, CST)
        plc = struct.pack("<HiH", 0, 0, number & 0xFFFF)
        return [*(_packed(RPDO + node, drive) for node in range(1, SPANS + 1)), _packed(RPDO + PLC_NODE, plc)]

    def _send(self, frame: bytes) -> None:
        self._socket.sendto(frame, self._to)

    def close(self) -> None:
        self._socket.close()


class RackClient:
    """Commands to everything in the rack, and everything that it shows, in one transaction."""

    _HEAD = struct.Struct(">HHHBBHHHHB")
    _COMMANDS = struct.Struct(">HiH" + "Hh" * SPANS)
    _READ_COUNT = 8 + 8 * SPANS

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), PATIENCE_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.statusword = 0  #: of axis 1, in its last answer

    def cycle(self, number: int) -> float:
        commands = self._COMMANDS.pack(0, 0, number & 0xFFFF, *_command(number) * SPANS)
        size = len(commands)
        head = self._HEAD.pack(
            number & 0xFFFF, 0, self._HEAD.size - 6 + size, RACK_UNIT, 23, 0, self._READ_COUNT, 200, size // 2, size
        )
        began_s = time.perf_counter()
        self._socket.sendall(head + commands)
        answer = b""
        while len(answer) < 9 + 2 * self._READ_COUNT:
            answer += self._socket.recv(4096)
        took_s = time.perf_counter() - began_s
        self.statusword = int.from_bytes(answer[9 + 2 * STATUSWORD_AT :][:2], "big")
        return took_s

    def close(self) -> None:
        self._socket.close()


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.answer", description=__doc__)
    parser.add_argument("--lines", default="canopen,modbus", help="of canopen and modbus (default both)")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each line (default 10)")
    given = parser.parse_args()
    for kind in given.lines.split(","):
        with tempfile.TemporaryDirectory() as folder, LiveLine(Path(folder), PERIOD_S) as line:
            ports = line.start_sim(WIRINGS[kind])
            with ProcessPoolExecutor(1, get_context("spawn")) as own:
                measured = own.submit(answers_us, kind, ports, given.seconds).result()
        p50, p99, worst = np.percentile(measured, (50, 99, 100))
        print(f"{kind}: median {p50:.0f} us, p99 {p99:.0f} us, worst {worst:.0f} us of {len(measured)}", flush=True)


def answers_us(kind: str, ports: Ports, for_s: float) -> NDArray[np.float64]:
    """Times to the last answer in us, without those of the first half second, in which the drives are enabled.

    Makes the process that it runs in punctual, so that should be its own.
    """
    _be_punctual()
    settling = round(0.5 / PERIOD_S)
    taken_s: list[float] = []
    with closing(_client(kind, ports)) as client:
        due_s = time.perf_counter()
        for number in range(settling + round(for_s / PERIOD_S)):
            due_s = max(due_s + PERIOD_S, time.perf_counter())
            time.sleep(max(0.0, due_s - time.perf_counter()))
            taken_s.append(client.cycle(number))
        assert client.statusword & ENABLED_MASK == ENABLED, f"the drives are not enabled: {client.statusword:#06x}"
    return 1e6 * np.array(taken_s[settling:])


def _client(kind: str, ports: Ports) -> CanClient | RackClient:
    if kind == "canopen" and ports.can is not None:
        return CanClient(ports.can)
    assert kind == "modbus" and ports.modbus is not None
    return RackClient(ports.modbus)


def _command(number: int) -> tuple[int, int]:
    """Controlword and torque of every drive."""
    word = CONTROLWORDS[min(number // 5, len(CONTROLWORDS) - 1)]
    return word, TORQUES_PER_MILLE[number % 2] if word == CONTROLWORDS[-1] else 0


def _packed(can_id: int, data: bytes) -> bytes:
    frame = msgpack.packb({
        "timestamp": 0.0, "arbitration_id": can_id, "is_extended_id": False, "is_remote_frame": False,
        "is_error_frame": False, "channel": None, "dlc": len(data), "data": data, "is_fd": False,
        "bitrate_switch": False, "error_state_indicator": False,
    })  # fmt: skip
    assert frame is not None
    return frame


def _be_punctual() -> None:
    _, refused = become_punctual(None, PRIORITY)
    if sleepy := stay_awake():
        refused.append(sleepy)
    freeze_collector()
    for what in refused:
        print(f"not as the loop has it: {what}", flush=True)


if __name__ == "__main__":
    main()
