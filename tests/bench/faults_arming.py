"""SDO aborts while the line is armed: what was written is taken back, and the arming is refused, saying why."""

from random import Random

import can

from gateway.core.states import Phase
from sim_plant.faults.parse import parse_fault
from tests.bench.faults_seen import Injection
from tests.closed_loop.virtual_line import VirtualLine

TRANSACTION_BOUND_S = 1.0
OBJECTS = {0x1017: (0,), 0x1400: (1, 2, 5), 0x1600: range(9), 0x1800: (1, 2), 0x1A00: range(9), 0x605A: (0,)}
MOST_REQUESTS = 59  #: to one drive, in an arming; what comes next are the reads of a line that stands ready
WATCHDOG_OBJECT = 0x1400
_SERIAL = bytes((0x18, 0x10, 4))  #: 1018h:04, which is read once more where it is aborted, and which not all have


def sdo_abort(number: int) -> Injection:
    """One SDO request of an arming, at random, is answered with an abort."""
    dice = Random(f"sdo-abort/{number}")
    roller, at_request = dice.randint(1, 6), dice.randrange(MOST_REQUESTS)
    return _refused("sdo-abort", f"drive {roller} sdo-abort count=1", number, roller, at_request)


def no_watchdog(number: int) -> Injection:
    """A drive refuses the setting of its watchdog. (One that takes it and never fires cannot be told by reading.)"""
    roller = Random(f"no-watchdog/{number}").randint(1, 6)
    return _refused("no-watchdog", f"drive {roller} sdo-abort index={WATCHDOG_OBJECT}", number, roller, 0)


def _refused(row: str, fault: str, number: int, roller: int, at_request: int) -> Injection:
    with VirtualLine(seed=1 + number) as line:
        line.step(3)
        before = _parameters(line)
        begun_s: list[float] = []

        def begin() -> None:
            begun_s.append(line.truth.faults.now_s())
            line.truth.faults.injector.add(parse_fault(fault), begun_s[0])

        _after(line, roller, at_request, begin)
        reply = line.arm()
        took_s = line.world_s(line.now_s) - begun_s[0] if begun_s else None
        names_it = any(f"drive-{roller}" in reason and "abort" in reason for reason in reply.reasons)
        undone = _parameters(line) == before
        torque = any(event["kind"] == "command" for event in line.recording().events)
        if begun_s:
            line.truth.faults.injector.clear(None, line.truth.faults.now_s())
        line.step(20)
        again = line.arm().ok and line.step_until(Phase.READY, 1.0)
        right = not reply.ok and names_it and undone and again and not torque
        note = f"{fault} at request {at_request}: {reply.text} {'; '.join(reply.reasons)}"
        note += f" named {names_it}, undone {undone}, armed afterwards {again}, commands {torque}"
        reaction = "refused" if right else "arming came first" if not begun_s else "wrong"
        unsafe = {kind: n for kind, n in line.truth.recorder.unsafe_events.items() if n}
        return Injection(row, fault.split(" ", 2)[2], reaction, took_s, took_s, None, unsafe, note)


def _parameters(line: VirtualLine) -> dict[tuple[int, int, int], bytes]:
    """Of all drives, as they are."""
    assert line.truth.canopen is not None
    return {
        (node.node_id, index, sub): bytes(node.objects.get_data(index, sub))
        for node in line.truth.canopen.nodes
        for index, subs in OBJECTS.items()
        for sub in subs
    }


def _after(line: VirtualLine, roller: int, requests: int, begin: object) -> None:
    """Call `begin` when so many SDO requests have gone to a drive."""
    face = line.truth.canopen
    assert face is not None and callable(begin)
    take, seen = face.take, 0

    def counted(message: can.Message) -> None:
        nonlocal seen
        if message.arbitration_id == 0x600 + roller and bytes(message.data[1:4]) != _SERIAL:
            if seen == requests:
                begin()
            seen += 1
        take(message)

    face.take = counted
