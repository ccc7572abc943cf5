"""Which phases show a stop: the gateway and the command line go by the same ones, whatever led to the stop."""

import asyncio

import pytest

from gateway.cli.operate_commands import request
from gateway.core.messages import Reply, Stop
from gateway.core.states import STATE_OF, LoopState, Phase, shows_stop
from gateway.core.topics import LOOP_COMMAND, LOOP_SHOWN
from gateway.loop import machine as machines
from gateway.loop.machine import Machine, Times
from gateway.mailbox.unix import UnixMailbox
from gateway.supervisor.true_loop import is_shown
from tests.unit.supervisor_support import ShowsWho, short_folder

pytestmark = pytest.mark.wires

STOPPED = Reply(ok=True, state="STOP", text="the line stops")


@pytest.mark.parametrize("phase", Phase)
def test_whatever_a_stop_or_a_web_break_leads_to_shows_the_stop(phase: Phase) -> None:
    at_once = Times(tensioning_s=1.0, stop_s=1.0, braking_s=5.0)
    stopped = machines.stop(Machine(phase=phase), 1.0, "asked for").phase
    broken = machines.torque_off(Machine(phase=phase), 1.0, "the web has broken").phase
    braked = machines.brake(at_once, Machine(phase=phase), 1.0, "the web has broken").phase
    for found in (stopped, broken, braked):
        assert shows_stop(found) and shows_stop(found.name) and shows_stop(int(found)), found


@pytest.mark.parametrize("phase", Phase)
def test_gateway_and_command_line_take_the_same_phases_for_a_stop(phase: Phase) -> None:
    expected = STATE_OF[phase] is LoopState.STOP or phase is Phase.SILENT
    assert is_shown(Stop(), STOPPED, {(int(STATE_OF[phase]), int(phase))}) is expected

    async def story() -> Reply:
        loop = UnixMailbox()

        async def answer(_: bytes) -> bytes:
            return STOPPED.model_dump_json().encode()

        with short_folder() as folder:
            loop.serve(LOOP_COMMAND, answer)
            loop.serve(LOOP_SHOWN, ShowsWho(folder, phase).answer)
            await loop.listen(folder / "loop.sock")
            try:
                return await request(folder, Stop())
            finally:
                await loop.close()

    assert asyncio.run(story()).ok is expected


def test_what_is_no_phase_shows_nothing() -> None:
    assert not shows_stop("STOPPED") and not shows_stop(99)
