"""A line that was stopped by the loss of a device is armed again, once the device is there again."""

from collections.abc import Callable

import can
import pytest

from gateway.core.states import LoopState, Phase
from safety.tensioning import longest_tensioning_s
from tests.bench.faults_lines import virtual_line
from tests.bench.lines import AMPLIFIER_NODE, PLC_NODE
from tests.closed_loop.virtual_line import VirtualLine


def lose(line: VirtualLine, *nodes: int) -> Callable[[], None]:
    """Nothing of these CANopen nodes reaches the loop, nor they anything of it, until what is returned is called."""
    face = line.truth.canopen
    assert face is not None
    send, take = face.send, face.take
    face.send = lambda can_id, data: None if can_id & 0x7F in nodes else send(can_id, data)
    face.take = lambda message: None if message.arbitration_id & 0x7F in nodes else take(message)

    def bring_back() -> None:
        face.send, face.take = send, take

    return bring_back


@pytest.mark.parametrize("nodes", [(PLC_NODE,), (AMPLIFIER_NODE,), (2, 5), (*range(1, 7), AMPLIFIER_NODE, PLC_NODE)])
def test_what_was_lost_on_canopen_and_came_back_is_armed_and_started_again(nodes: tuple[int, ...]) -> None:
    with virtual_line("canopen", seed=1) as line:
        line.begin_in_production()
        line.step(20)
        bring_back = lose(line, *nodes)
        assert line.step_until(Phase.OFF, line.line.longest_stop_s)
        line.step(50)
        if len(nodes) == 1:
            refused = line.arm()
            assert not refused.ok and refused.reasons, "it is still away"
        bring_back()
        line.step(50)  # some heartbeats
        armed = line.arm()
        assert armed.ok, armed
        assert line.start().ok
        assert line.step_until(Phase.RUNNING, longest_tensioning_s(line.line)), line.cycle.machine.reason


def test_what_the_line_plc_says_refuses_at_once_and_touches_no_link() -> None:
    """An arming that waited for the circuit to close would arm by closing it."""
    with virtual_line("canopen", seed=1) as line:
        line.begin_in_production()
        line.truth.plc.emergency_stop = True
        assert line.step_until(Phase.OFF, line.line.longest_stop_s)
        face, orders = line.truth.canopen, []
        assert face is not None
        take = face.take

        def tap(message: can.Message) -> None:
            if message.arbitration_id == 0:
                orders.append(message)
            take(message)

        face.take = tap
        asked_s = line.now_s
        refused = line.arm()
        assert not refused.ok and "emergency-stop" in {one.code for one in refused.findings}
        assert line.now_s - asked_s <= 3 * line.period_s
        line.truth.plc.emergency_stop = False
        line.step(150)
        assert line.cycle.machine.state is LoopState.STOP
        assert not orders
        assert line.arm().ok and orders
