"""The status of a drive's torque goes bad at speed and the drive runs on: told, and in the status by name."""

from types import SimpleNamespace

import numpy as np

from gateway.core.doubts import Doubt
from gateway.core.states import LoopState
from gateway.supervisor.status import loop_status, span_statuses
from tests.support.reel_line import TENSION_N, TOP_M_PER_S, reel_loop

TOLD = ["torque-status-bad", "torque-not-compared"]


def status_of(loop):
    frame = loop.recorded()[-1]
    sink = SimpleNamespace(age_s=lambda _now_s: 0.0, newest=lambda: frame, restarts=0, other_version=None)
    return loop_status(loop.line, sink, 0.0), span_statuses(loop.line, frame, True)


def test_a_torque_whose_status_goes_bad_at_speed_is_told_and_then_not_compared_by_name():
    loop = reel_loop()
    loop.begin_in_production(np.array(TENSION_N), 0.95 * TOP_M_PER_S)
    loop.step(50)
    link = loop.cycle.links[0]
    collect, bad = link.collect, [True]

    async def collected(inputs, deadline_s):
        await collect(inputs, deadline_s)
        if bad[0]:
            inputs.torque.reject(1)

    link.collect = collected
    assert not status_of(loop)[0].doubts
    loop.step(100)
    told = [(finding.rule, finding.parameters.get("drive")) for _, finding in loop.alarms]
    assert told[:2] == [(code, "drive-2") for code in TOLD]
    assert Doubt.TORQUE_UNCOMPARED in loop.cycle.watch.doubts, "and proposals are blocked"
    status, spans = status_of(loop)
    assert [doubt.partition(":")[0] for doubt in status.doubts] == ["drive-2"]
    assert [span.torque_actual_nm is None for span in spans] == [False, True, False]
    assert loop.cycle.machine.state is LoopState.RUN
    bad[0] = False
    loop.step(100)
    assert not status_of(loop)[0].doubts and status_of(loop)[1][1].torque_actual_nm is not None
