"""The proof of the wiring over every wire, with a drive and a load cell mounted the other way round."""

import pytest

from gateway.core.messages import Drill, Prove
from gateway.core.states import Phase
from sim_plant.faults.parse import parse_fault
from tests.bench.faults_lines import virtual_line

LONGEST_S = 300.0


@pytest.mark.parametrize("wiring", ["canopen", "modbus", "opcua"])
def test_a_mistake_is_named_on_every_wire(wiring: str) -> None:
    with virtual_line(wiring, seed=1, start_warning_s=0.0) as line:
        cycle = line.cycle
        line.step(3)
        assert line.command(Drill()).ok
        for fault in ("load-cell 1 cell-factor factor=-1", "drive 2 reversed"):
            line.truth.faults.injector.add(parse_fault(fault), line.truth.world.now_s)
        reply = line.arm()
        assert reply.ok, reply.reasons
        assert line.command(Prove()).ok
        assert line.step_until(Phase.OFF, LONGEST_S), cycle.machine.reason
        told = [(finding.rule, finding.parameters) for finding in line.findings if finding.parameters]
        found = sorted((code, parameters.get("span", parameters.get("roller"))) for code, parameters in told)
        assert found == [("cell-inverted", 1), ("drive-reversed", 2)], cycle.machine.reason
