"""The line as companion specifications have it: found through Machines, the same values, and nothing that takes."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from asyncua import Client, Server, ua

from gateway.operator.opcua.companion import MACHINE, MACHINES, PROCESS, make_companion
from gateway.operator.opcua.line_nodes import make_line
from gateway.operator.opcua.nodesets import CORE
from gateway.operator.opcua.space import NAMESPACE, Space
from tests.protocol.nodeset_support import (
    DI,
    DI_NODES,
    MACHINERY,
    MACHINERY_NODES,
    PADIM,
    PROCESS_VALUES,
    SMALL,
    has,
    node,
    node_set,
    write,
)  # fmt: skip
from tests.protocol.operator_support import NUMBER, Bench, bench
from tests.unit.supervisor_support import line_of

CODES = ua.StatusCodes
TENSION, OWN = f"{PROCESS}.2.AnalogSignal", "Line.Spans.2.Tension"
SETPOINT, OWN_SETPOINT = f"{PROCESS}.2.ProcessValueSetpoint", "Line.Spans.2.Setpoint"


def run(story):
    asyncio.run(asyncio.wait_for(story(), 120.0))


async def below(node) -> list:
    """All nodes below."""
    found = []
    for child in await node.get_children():
        found += [child, *await below(child)]
    return found


async def ids(node) -> set[str]:
    """Texts of the own nodes below."""
    found = [one.nodeid for one in await below(node)]
    return {one.Identifier for one in found if one.NamespaceIndex == NUMBER and isinstance(one.Identifier, str)}


async def read(client: Client, nodes: list, attribute: ua.AttributeIds) -> list:
    return [one.Value.Value for one in await client.uaclient.read_attributes(nodes, attribute)]


async def same(b: Bench, client: Client, path: str, own: str) -> ua.DataValue:
    """Both of one instant: they are read in one request."""
    nodes = [client.get_node(b.id(one)) for one in (path, own)]
    first, second = await client.uaclient.read_attributes([one.nodeid for one in nodes], ua.AttributeIds.Value)
    assert (first.Value, first.StatusCode, first.SourceTimestamp) == (
        second.Value, second.StatusCode, second.SourceTimestamp,
    )  # fmt: skip
    return first


def test_the_line_is_found_among_the_machines_and_says_what_is_known_of_it(tmp_path: Path):
    async def story():
        async with bench(spans=2, nodesets=write(tmp_path)) as b, b.connected("vera") as client:
            assert b.said == []
            machinery, di = await client.get_namespace_index(MACHINERY), await client.get_namespace_index(DI)
            (machine,) = await client.get_node(ua.NodeId(MACHINES, machinery)).get_children(ua.ObjectIds.Organizes)
            assert (await machine.read_browse_name()).Name == b.line.line
            assert client.get_node(b.id("Line")) in await machine.get_children(ua.ObjectIds.Organizes)
            (identification, monitoring) = await machine.get_children(ua.ObjectIds.HasAddIn)
            assert await identification.read_browse_name() == ua.QualifiedName("Identification", di)
            assert await identification.read_type_definition() == ua.NodeId(1012, machinery)
            assert await monitoring.read_browse_name() == ua.QualifiedName("Monitoring", machinery)
            children = await identification.get_children()
            properties = {(await one.read_browse_name()).Name: await one.read_value() for one in children}
            assert properties == {
                "Manufacturer": ua.LocalizedText(), "SerialNumber": "", "ProductInstanceUri": "",
                "ComponentName": ua.LocalizedText(b.line.line), "Location": b.line.site,
            }  # fmt: skip

    run(story)


def test_a_tension_is_a_process_value_with_unit_range_limits_and_set_point(tmp_path: Path):
    async def story():
        async with bench(spans=2, nodesets=write(tmp_path)) as b, b.connected("vera") as client:
            value = client.get_node(b.id(f"{PROCESS}.2"))
            number = await client.get_namespace_index(PROCESS_VALUES)
            assert await value.read_type_definition() == ua.NodeId(1003, number)
            assert await b.value(client, f"{PROCESS}.2.SignalTag") == b.line.spans[1].name
            low, high = b.line.limits.tension_min_n, b.line.limits.tension_max_n
            for path in (TENSION, SETPOINT):
                assert (await b.value(client, f"{path}.EngineeringUnits")).UnitId == 5129559  # NEW
                assert await b.value(client, f"{path}.EURange") == ua.Range(low, high)
                assert await client.get_node(b.id(path)).read_data_type() == ua.NodeId(ua.ObjectIds.Double)
            assert [await b.value(client, f"{TENSION}.{name}Limit") for name in ("Low", "High")] == [low, high]
            assert (await b.value(client, f"{TENSION}.HighLimit.EngineeringUnits")).UnitId == 5129559
            names = await ids(value)
            assert f"{TENSION}.HighHighLimit" not in names  # of the optional ones what is known
            assert not any("ZeroPointAdjustment" in one for one in names)  # no methods

    run(story)


def test_a_process_value_follows_the_own_node_with_the_same_codes(tmp_path: Path):
    async def story():
        async with bench(spans=2, nodesets=write(tmp_path)) as b, b.connected("vera") as client:
            await b.until(client, OWN, lambda found: found.StatusCode.is_good())
            assert (await same(b, client, TENSION, OWN)).Value.Value == 21.0
            assert (await same(b, client, SETPOINT, OWN_SETPOINT)).Value.Value == 21.0
            for quality, code in (
                ("STALE", CODES.UncertainLastUsableValue), ("BAD", CODES.BadSensorFailure),
                ("MISSING", CODES.BadNotConnected), ("GOOD", CODES.Good),
            ):  # fmt: skip
                b.gateway.quality = quality
                await b.until(client, OWN, lambda found, code=code: found.StatusCode.value == code)
                assert (await same(b, client, TENSION, OWN)).StatusCode.value == code
            await b.gateway_mailbox.close()
            await b.until(client, OWN, lambda found: found.StatusCode.value == CODES.BadNoCommunication)
            for path, own in ((TENSION, OWN), (SETPOINT, OWN_SETPOINT)):
                assert (await same(b, client, path, own)).StatusCode.value == CODES.BadNoCommunication

    run(story)


def test_before_anything_is_told_it_is_waited_for(tmp_path: Path):
    async def story():
        async with bench(2, gateway=False, nodesets=write(tmp_path)) as b, b.connected("vera") as client:
            for path in (TENSION, SETPOINT):
                found = await b.read(client, path)
                assert (found.StatusCode.value, found.Value.Value) == (CODES.BadWaitingForInitialData, None)

    run(story)


@asynccontextmanager
async def served(folder: str) -> AsyncIterator[tuple[Server, list[str]]]:
    """The nodes of a line in a server that does not listen, and what was told."""
    server, said, line = Server(), list[str](), line_of(2)
    await server.init()
    space = Space(server, await server.register_namespace(NAMESPACE))
    await make_line(space, line)
    operator = line.operator.model_copy(update={"nodesets": folder})
    await make_companion(space, line.model_copy(update={"operator": operator}), said.append)
    try:
        yield server, said
    finally:
        await server.iserver.stop()


class _Heard:
    def __init__(self) -> None:
        self.values: asyncio.Queue[float] = asyncio.Queue()

    def datachange_notification(self, node, value, data):
        if value is not None:
            self.values.put_nowait(value)


def test_a_subscription_hears_of_changes(tmp_path: Path):
    async def story():
        async with bench(spans=2, nodesets=write(tmp_path)) as b, b.connected("vera") as client:
            heard = _Heard()
            subscription = await client.create_subscription(50, heard)
            await subscription.subscribe_data_change(client.get_node(b.id(TENSION)))
            assert await heard.values.get() == 21.0
            b.gateway.tension_n = 30.0
            assert await heard.values.get() == 31.0

    run(story)


def test_a_span_without_a_load_cell_has_no_process_value(tmp_path: Path):
    async def story():
        line = line_of(2)
        drawn = [line.spans[0].model_copy(update={"control": "draw"}), line.spans[1]]
        line = line.model_copy(update={"spans": drawn})
        async with bench(line=line, nodesets=write(tmp_path)) as b, b.connected("vera") as client:
            values = await client.get_node(b.id(PROCESS)).get_children()
            assert [one.nodeid for one in values] == [b.id(f"{PROCESS}.2")]

    run(story)


def test_the_own_nodes_are_those_of_a_server_without_companion_types(tmp_path: Path):
    async def story():
        async with bench(spans=2) as b, b.connected("vera") as client:
            without = await ids(client.get_node(b.id("Line")))
            assert (await b.read(client, MACHINE)).StatusCode.value == CODES.BadNodeIdUnknown
        async with bench(spans=2, nodesets=write(tmp_path)) as b, b.connected("vera") as client:
            assert await ids(client.get_node(b.id("Line"))) == without

    run(story)


def test_nothing_of_the_companion_types_can_be_written_or_called(tmp_path: Path):
    async def story():
        async with bench(spans=2, nodesets=write(tmp_path)) as b, b.connected("emma") as client:
            numbers = [await client.get_namespace_index(uri) for uri in SMALL]
            nodes = [one for one in b.opcua.server.iserver.aspace.keys() if one.NamespaceIndex in numbers]
            nodes += [b.id(one) for one in await ids(client.get_node(b.id(MACHINE))) if one.startswith(MACHINE)]
            kinds = await read(client, nodes, ua.AttributeIds.NodeClass)
            variables = [one for one, kind in zip(nodes, kinds, strict=True) if kind == ua.NodeClass.Variable]
            methods = [one for one, kind in zip(nodes, kinds, strict=True) if kind == ua.NodeClass.Method]
            assert len(variables) > 20 and len(methods) == 3
            for attribute in (ua.AttributeIds.AccessLevel, ua.AttributeIds.UserAccessLevel):
                assert set(await read(client, variables, attribute)) == {ua.AccessLevel.CurrentRead.mask}
            for attribute in (ua.AttributeIds.Executable, ua.AttributeIds.UserExecutable):
                assert set(await read(client, methods, attribute)) == {False}
            with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
                await client.get_node(b.id(f"{MACHINE}.Identification.Location")).write_value("elsewhere")
            for method in methods:
                assert not b.gateway.heard and method.NamespaceIndex in numbers
                for on in (MACHINE, f"{PROCESS}.1", "Line"):
                    request = ua.CallMethodRequest(b.id(on), method, [ua.Variant(1.0)])
                    (result,) = await client.uaclient.call([request])
                    assert result.StatusCode.value == CODES.BadNotExecutable
            assert b.gateway.heard == []

    run(story)


NO_MACHINE = "the line is not among Machinery's machines; own types only: "
NO_VALUES = "the tensions are no process values; own types only for them: "
NEWER = "2025-05-05T00:00:00Z"
FOREIGN = MACHINERY_NODES.replace("ns=1;i=6005", "i=6005")
LOOSE = MACHINERY_NODES + has(6009, "1:Loose", 4711, "i=78")


@pytest.mark.parametrize(
    ("texts", "told", "machine"),
    [
        ({}, f"{NO_MACHINE}no file there holds the model {MACHINERY}", False),
        ({**SMALL, DI: ""}, f"{NO_MACHINE}no file there holds the model {DI}", False),
        ({**SMALL, PADIM: ""}, f"{NO_VALUES}no file there holds the model {PADIM}", True),
        ({**SMALL, PROCESS_VALUES: ""}, f"{NO_VALUES}no file there holds the model {PROCESS_VALUES}", True),
        (
            {**SMALL, MACHINERY: node_set(MACHINERY, MACHINERY_NODES, {DI: NEWER})},
            f"requires {DI} of 2025-05-05 or newer, and has that of 2024-01-01", False,
        ),
        ({**SMALL, DI: node_set(DI, DI_NODES, {CORE: "2090-01-01T00:00:00Z"})}, f"requires {CORE} of 2090", False),
        ({**SMALL, DI: node_set(DI, DI_NODES, {MACHINERY: NEWER})}, "or requires itself", False),
        ({**SMALL, DI: node_set(DI, DI_NODES, {NAMESPACE: ""}), "own": node_set(NAMESPACE, "")}, "server's own", False),
        ({**SMALL, MACHINERY: node_set(MACHINERY, FOREIGN, {DI: "2024"})}, "allowed: its own namespace", False),
        ({**SMALL, MACHINERY: node_set(MACHINERY, LOOSE, {DI: "2024"})}, "cannot be brought in", False),
        ({**SMALL, MACHINERY: SMALL[MACHINERY].replace("</UANodeSet>", f"<!--{'x' * 70_000}-->")}, "ParseError", False),
        ({**SMALL, MACHINERY: node_set(MACHINERY, "", {DI: "2024"})}, "has no MachineIdentificationType", False),
        ({**SMALL, MACHINERY: SMALL[MACHINERY].replace("1:Location", "1:Place")}, "does not declare Location", False),
        ({**SMALL, MACHINERY: SMALL[MACHINERY].replace("ns=1;i=1001", "ns=1;i=1")}, "has no folder Machines", False),
        (
            {**SMALL, PROCESS_VALUES: SMALL[PROCESS_VALUES].replace("1:HighLimit", "1:Top")},
            "does not declare AnalogSignal.HighLimit", True,
        ),
    ],
)  # fmt: skip
def test_what_is_missing_or_unsound_is_told_and_left_out(tmp_path, texts, told, machine):
    async def story():
        folder = write(tmp_path, {uri: text for uri, text in texts.items() if text})
        async with served(folder) as (server, said):
            assert len(said) == 1 and told in said[0]
            nodes = set(server.iserver.aspace.keys())
            own = {one.Identifier for one in nodes if one.NamespaceIndex == NUMBER}
            assert (f"{MACHINE}.Identification.Location" in own) is machine and PROCESS not in own
            assert OWN in own

    run(story)


def test_of_an_import_that_fails_nothing_stays(tmp_path: Path):
    async def story():
        loose = {**SMALL, MACHINERY: node_set(MACHINERY, LOOSE, {DI: "2024"})}
        async with served(write(tmp_path, loose)) as (server, said):
            assert "cannot be brought in" in said[0]
            number, space = await server.get_namespace_index(MACHINERY), server.iserver.aspace
            targets = [one.NodeId for node in space.keys() for one in space[node].references]
            assert not [one for one in (*space.keys(), *targets) if one.NamespaceIndex == number]

    run(story)


def test_no_code_is_made_of_definitions(tmp_path: Path):
    """asyncua would run a class made of such a text."""
    run_me = "A(int):&#10;  import pathlib; pathlib.Path('ran').touch()&#10;class B"
    types = node("UADataType", 3001, "1:Harm", ("HasSubtype", "i=29")).replace(
        "</UADataType>", f'<Definition Name="{run_me}"><Field Name="{run_me}" Value="0"/></Definition></UADataType>'
    )

    async def story():
        folder = write(tmp_path, {**SMALL, DI: node_set(DI, DI_NODES + types)})
        async with served(folder) as (server, said):
            number = await server.get_namespace_index(DI)
            assert said == [] and ua.NodeId(3001, number) in server.iserver.aspace
            assert not hasattr(ua, "Harm") and not list(Path.cwd().glob("ran"))

    run(story)


def test_a_folder_that_is_not_there_is_told_and_the_line_is_served(tmp_path: Path):
    async def story():
        async with bench(spans=2, nodesets=str(tmp_path / "nowhere")) as b, b.connected("vera") as client:
            assert b.said == [
                f"companion types: {tmp_path / 'nowhere'} cannot be read: No such file or directory",
                f"{NO_MACHINE}no file there holds the model {MACHINERY}",
            ]
            await b.until(client, OWN, lambda found: found.StatusCode.is_good())

    run(story)
