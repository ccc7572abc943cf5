"""The line as a PackML machine: which phase is which state, and what becomes of it where the model is not sound."""

import asyncio

import pytest
from asyncua import ua

from gateway.core.states import Phase
from gateway.operator.opcua.packml import BASE, EXECUTE, MACHINE, PACKML, PATH, states_of
from gateway.operator.opcua.space import NAMESPACE
from tests.protocol.nodeset_support import MANDATORY, OPTIONAL, SMALL, TYPE, node, node_set, write
from tests.protocol.operator_support import bench
from tests.protocol.test_operator_nodesets import served
from tests.unit.alarm_support import status

STATE, MACHINE_TYPE, STATE_VARIABLE = "i=2307", "i=2771", "i=2760"
CODES = ua.StatusCodes


def machine(number: int, name: str, states: list[str], inner: str = "") -> str:
    """A type with its states; their numbers follow."""
    text = node("UAObjectType", number, f"1:{name}", ("HasSubtype", MACHINE_TYPE)) + inner
    for k, state in enumerate(states, 1):
        text += node("UAObject", number + k, f"1:{state}", ("HasComponent", f"ns=1;i={number}"), "", STATE)
    current = number + 50
    text += node("UAVariable", current, "CurrentState", ("HasComponent", f"ns=1;i={number}"), MANDATORY,
                 STATE_VARIABLE, DataType="LocalizedText")  # fmt: skip
    return text + node("UAVariable", current + 1, "Id", ("HasProperty", f"ns=1;i={current}"), MANDATORY, "i=68",
                       DataType="NodeId")  # fmt: skip


def inside(number: int, name: str, above: int, kind: int) -> str:
    return node("UAObject", number, f"1:{name}", ("HasComponent", f"ns=1;i={above}"), MANDATORY, f"ns=1;i={kind}")


EXECUTE_STATES = ["Idle", "Starting", "Execute", "Holding", "Held", "Resetting"]
NODES = (
    node("UAObject", 72, "1:PackMLObjects", ("Organizes", "i=85"), of="i=61")
    + machine(1100, "PackMLExecuteStateMachineType", EXECUTE_STATES)
    + machine(1200, "PackMLMachineStateMachineType", ["Stopped", "Stopping", "Running"],
              inside(1290, "ExecuteState", 1200, 1100))
    + machine(1300, "PackMLBaseStateMachineType", ["Cleared", "Aborting", "Aborted"],
              inside(1390, "MachineState", 1300, 1200))
    + node("UAObjectType", 1400, "1:PackMLBaseObjectType", ("HasSubtype", TYPE))
    + inside(1401, "BaseStateMachine", 1400, 1300)
    + node("UAMethod", 1402, "1:SetUnitMode", ("HasComponent", "ns=1;i=1400"), MANDATORY)
    + node("UAVariable", 1403, "1:TagID", ("HasProperty", "ns=1;i=1400"), OPTIONAL, "i=68", DataType="String")
)  # fmt: skip
WITH = {**SMALL, PACKML: node_set(PACKML, NODES)}
NONE = "the line is no PackML machine; own types only for its state: "


def run(story):
    asyncio.run(asyncio.wait_for(story(), 120.0))


@pytest.mark.parametrize(
    ("phase", "standstill", "by_person", "states"),
    [
        ("UNKNOWN", True, False, None),
        ("SILENT", True, False, None),  # nothing is commanded, whoever may move the web
        ("ARMING", True, False, ("Cleared", "Running", "Resetting")),
        ("READY", True, False, ("Cleared", "Running", "Idle")),
        ("ENABLING", True, False, ("Cleared", "Running", "Starting")),
        ("TENSIONING", True, False, ("Cleared", "Running", "Starting")),
        ("RUNNING", False, False, ("Cleared", "Running", "Execute")),
        ("HOLDING", False, False, ("Cleared", "Running", "Holding")),
        ("HOLDING", True, False, ("Cleared", "Running", "Held")),
        ("SLOWING", False, True, ("Cleared", "Stopping", "")),
        ("UNLOADING", True, True, ("Cleared", "Stopping", "")),  # there is torque yet
        ("OFF", False, True, ("Cleared", "Stopping", "")),  # it coasts, or nobody knows
        ("OFF", True, True, ("Cleared", "Stopped", "")),
        ("SLOWING", False, False, ("Aborting", "", "")),
        ("OFF", False, False, ("Aborting", "", "")),
        ("OFF", True, False, ("Aborted", "", "")),
    ],
)
def test_each_phase_is_a_state_and_a_standstill_is_told_where_it_is_measured(phase, standstill, by_person, states):
    assert states_of(status({"phase": phase, "standstill": standstill, "by_person": by_person})) == states


def test_every_phase_of_the_loop_is_known():
    for phase in Phase.__members__:
        assert (states_of(status({"phase": phase})) is None) is (phase == "SILENT")


def test_states_follow_the_line_and_say_why_they_are_not_known(tmp_path):
    async def story():
        async with bench(1, nodesets=write(tmp_path, WITH)) as b, b.connected("vera") as client:
            assert b.said == []

            async def states():
                told = [await b.read(client, f"{path}.CurrentState") for path in (BASE, MACHINE, EXECUTE)]
                return [one.Value.Value.Text if one.StatusCode.is_good() else one.StatusCode.value for one in told]

            await b.until(client, f"{EXECUTE}.CurrentState", lambda found: found.StatusCode.is_good())
            assert await states() == ["Cleared", "Running", "Execute"]
            number = await client.get_namespace_index(PACKML)
            told = await b.read(client, f"{EXECUTE}.CurrentState.Id")
            assert told.Value.Value == ua.NodeId(1100 + 1 + EXECUTE_STATES.index("Execute"), number)
            b.gateway.phase = Phase.SLOWING
            await b.until(  # which is told last
                client, f"{EXECUTE}.CurrentState", lambda found: found.StatusCode.value == CODES.BadStateNotActive
            )
            assert (await b.read(client, f"{BASE}.CurrentState.Id")).Value.Value.Identifier == 1302
            assert await states() == ["Aborting", CODES.BadStateNotActive, CODES.BadStateNotActive]
            b.gateway.running = False
            await b.until(client, f"{EXECUTE}.CurrentState", lambda found: found.StatusCode.value == CODES.BadNoData)
            assert await states() == [CODES.BadNoData] * 3
            methods = await client.get_node(b.id(PATH)).get_methods()
            assert methods == []

    run(story)


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        (SMALL, ""),  # who has no such file has not asked for it
        ({**WITH, PACKML: node_set(PACKML, "")}, "its model has no PackMLBaseObjectType, PackMLBaseStateMachineType"),
        ({**WITH, PACKML: node_set(PACKML, NODES.replace("ns=1;i=72", "ns=1;i=73"))}, "has no folder PackMLObjects"),
        ({**WITH, PACKML: node_set(PACKML, NODES, {NAMESPACE: ""})}, f"no file there holds the model {NAMESPACE}"),
        (
            {**WITH, PACKML: node_set(PACKML, NODES.replace("1:Held", "1:Kept"))},
            "PackMLExecuteStateMachineType has no state Held",
        ),
        (
            {**WITH, PACKML: node_set(PACKML, NODES.replace("1:MachineState", "1:Machine"))},
            "does not declare BaseStateMachine.MachineState.CurrentState",
        ),
    ],
)
def test_what_is_missing_or_unsound_is_told_and_left_out(tmp_path, texts, said):
    async def story():
        async with served(write(tmp_path, {uri: text for uri, text in texts.items() if text})) as (server, told):
            assert [one.startswith(NONE) and said in one for one in told] == [True] * bool(said)
            own = {one.Identifier for one in server.iserver.aspace.keys() if isinstance(one.Identifier, str)}
            assert "Line.Operation.State" in own and not [one for one in own if one.startswith(PATH)]

    run(story)
