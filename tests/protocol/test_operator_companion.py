"""The line as companion specifications have it: found through Machines, the same values, and nothing that takes."""

import asyncio
from pathlib import Path

import pytest
from asyncua import Client, ua

from gateway.operator.opcua.companion import MACHINE, MACHINES, PROCESS
from tests.protocol.nodeset_support import DI, MACHINERY, PROCESS_VALUES, SMALL, write
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


def test_a_folder_that_is_not_there_is_told_and_the_line_is_served(tmp_path: Path):
    async def story():
        async with bench(spans=2, nodesets=str(tmp_path / "nowhere")) as b, b.connected("vera") as client:
            assert b.said == [
                f"companion types: {tmp_path / 'nowhere'} cannot be read: No such file or directory",
                "the line is not among Machinery's machines; own types only: "
                f"no file there holds the model {MACHINERY}",
            ]
            await b.until(client, OWN, lambda found: found.StatusCode.is_good())

    run(story)
