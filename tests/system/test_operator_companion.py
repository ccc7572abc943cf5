"""The operator's OPC UA server with the OPC Foundation's node sets, as they are published and as npm's node-opcua
brings them. What an instance must have is read from the files themselves.
"""

import asyncio
import xml.etree.ElementTree as ET
from pathlib import Path

from asyncua import Client, ua

from gateway.cli.pki_opcua import trust
from gateway.core.states import Phase
from gateway.operator.opcua.companion import DI, MACHINE, MACHINERY, MACHINES, PROCESS, PROCESS_VALUES
from gateway.operator.opcua.packml import BASE, EXECUTE, OBJECTS, PACKML, PATH
from gateway.operator.opcua.packml import MACHINE as MACHINE_STATE
from tests.operator.real_line import until
from tests.protocol.operator_support import PASSWORD, Bench, bench, pair
from tests.system.needs import PEERS
from tests.system.peer import Spoken

FOLDER = PEERS / "node_modules" / "node-opcua-nodesets" / "nodesets"
SPANS = 6
BROUGHT = (
    DI, MACHINERY, PROCESS_VALUES, PACKML, "http://opcfoundation.org/UA/IA/", "http://opcfoundation.org/UA/PADIM/",
)  # fmt: skip
_UA = "{http://opcfoundation.org/UA/2011/03/UANodeSet.xsd}"
_BELOW = ("HasComponent", "HasProperty")
_MANDATORY = "i=78"


class Published:
    """Nodes of published files by (namespace's URI, identifier)."""

    def __init__(self, folder: Path) -> None:
        self.nodes: dict[tuple[str, str], tuple[ET.Element, list[str]]] = {}
        for path in folder.glob("*.xml"):
            root = ET.parse(path).getroot()
            uris = ["http://opcfoundation.org/UA/", *(one.text or "" for one in root.iterfind(f"{_UA}NamespaceUris/*"))]
            for node in root:
                if (node_id := node.get("NodeId")) is not None:
                    self.nodes[_key(node_id, uris)] = (node, uris)

    def mandatory(self, uri: str, type_name: str) -> set[str]:
        """Names of the variables that every instance has, those of supertypes and interfaces among them."""
        types = {key: node for key, (node, _) in self.nodes.items() if node.tag == f"{_UA}UAObjectType"}
        (found,) = [
            key for key, node in types.items() if key[0] == uri and node.get("BrowseName", "").endswith(f":{type_name}")
        ]
        return self._mandatory(found)

    def _mandatory(self, key: tuple[str, str]) -> set[str]:
        if key not in self.nodes:
            return set()
        names: set[str] = set()
        node, uris = self.nodes[key]
        for reference in node.iterfind(f"{_UA}References/{_UA}Reference"):
            kind, forward = reference.get("ReferenceType"), reference.get("IsForward") != "false"
            other = _key(reference.text or "", uris)
            if (kind == "HasSubtype" and not forward) or (kind == "HasInterface" and forward):
                names |= self._mandatory(other)
            elif kind in _BELOW and forward and self._is_mandatory_variable(other):
                names.add(self.nodes[other][0].get("BrowseName", "").rpartition(":")[2])
        return names

    def _is_mandatory_variable(self, key: tuple[str, str]) -> bool:
        node, _ = self.nodes[key]
        rules = node.iterfind(f"{_UA}References/{_UA}Reference[@ReferenceType='HasModellingRule']")
        return node.tag == f"{_UA}UAVariable" and [one.text for one in rules] == [_MANDATORY]


def _key(node_id: str, uris: list[str]) -> tuple[str, str]:
    namespace, _, identifier = node_id.rpartition(";") if node_id.startswith("ns=") else ("", "", node_id)
    return uris[int(namespace.removeprefix("ns=") or 0)], identifier


async def names(client: Client, node_id: ua.NodeId) -> dict[str, ua.DataValue]:
    found = {}
    for child in await client.get_node(node_id).get_children():
        if await child.read_node_class() == ua.NodeClass.Variable:
            told = await child.read_data_value(raise_on_bad_status=False)
            found[(await child.read_browse_name()).Name] = told
    return found


async def _story() -> None:
    published = Published(FOLDER)
    async with bench(SPANS, nodesets=str(FOLDER)) as b, b.connected("emma") as client:
        assert b.said == []
        machines = client.get_node(ua.NodeId(MACHINES, await client.get_namespace_index(MACHINERY)))
        assert [one.nodeid for one in await machines.get_children()] == [b.id(MACHINE)]
        identification = await names(client, b.id(f"{MACHINE}.Identification"))
        must = published.mandatory(MACHINERY, "MachineIdentificationType")
        assert {"Manufacturer", "SerialNumber", "ProductInstanceUri"} <= must <= set(identification)
        assert all(one.StatusCode.is_good() for one in identification.values())
        await b.until(client, f"Line.Spans.{SPANS}.Tension", lambda found: found.StatusCode.is_good())
        must = published.mandatory(PROCESS_VALUES, "ProcessValueType")
        for number in range(1, SPANS + 1):
            value = await names(client, b.id(f"{PROCESS}.{number}"))
            assert {"SignalTag", "AnalogSignal"} <= must <= set(value)
            own = await b.read(client, f"Line.Spans.{number}.Tension")
            assert value["AnalogSignal"].Value == own.Value and value["AnalogSignal"].StatusCode == own.StatusCode
            assert {"EngineeringUnits", "EURange"} <= set(await names(client, b.id(f"{PROCESS}.{number}.AnalogSignal")))
        await _states(b, client)
        await _nothing_takes(b, client)


async def _states(b: Bench, client: Client) -> None:
    """The numbers of states are those of the published file; what is not active says so."""
    number = await client.get_namespace_index(PACKML)
    folder = client.get_node(ua.NodeId(OBJECTS, number))
    assert [one.nodeid for one in await folder.get_children()] == [b.id(PATH)]
    must = Published(FOLDER).mandatory(PACKML, "PackMLStatusObjectType")
    assert {"UnitModeCurrent", "CurMachSpeed"} <= must <= set(await names(client, b.id(f"{PATH}.Status")))
    for phase, standstill, states in (
        (Phase.RUNNING, False, {BASE: "Cleared", MACHINE_STATE: "Running", EXECUTE: "Execute"}),
        (Phase.HOLDING, True, {BASE: "Cleared", MACHINE_STATE: "Running", EXECUTE: "Held"}),
        (Phase.SLOWING, False, {BASE: "Cleared", MACHINE_STATE: "Stopping"}),
    ):
        b.gateway.phase, b.gateway.by_person, b.gateway.standstill = phase, True, standstill
        last = states.get(EXECUTE, "")
        await b.until(client, f"{EXECUTE}.CurrentState", lambda found, last=last: _text(found) == last)
        for path in (BASE, MACHINE_STATE, EXECUTE):
            told = await b.read(client, f"{path}.CurrentState")
            if path not in states:
                assert told.StatusCode.value == ua.StatusCodes.BadStateNotActive
                continue
            assert _text(told) == states[path]
            if path != EXECUTE:  # whose instance has none in the published type
                node_id = (await b.read(client, f"{path}.CurrentState.Id")).Value.Value
                assert (await client.get_node(node_id).read_browse_name()).Name == states[path]


def _text(told: ua.DataValue) -> str:
    return told.Value.Value.Text if told.StatusCode.is_good() else ""


async def _nothing_takes(b: Bench, client: Client) -> None:
    numbers = [await client.get_namespace_index(uri) for uri in BROUGHT]
    called = 0
    for node_id in [one for one in b.opcua.server.iserver.aspace.keys() if one.NamespaceIndex in numbers]:
        node = client.get_node(node_id)
        kind = await node.read_node_class()
        if kind == ua.NodeClass.Variable:
            level = await node.read_attribute(ua.AttributeIds.AccessLevel)
            assert level.Value.Value == ua.AccessLevel.CurrentRead.mask
        elif kind == ua.NodeClass.Method:
            (result,) = await client.uaclient.call([ua.CallMethodRequest(b.id(MACHINE), node_id, [])])
            assert result.StatusCode.value == ua.StatusCodes.BadNotExecutable
            called += 1
    assert called > 50 and b.gateway.heard == []


def test_the_published_node_sets_carry_the_line() -> None:
    asyncio.run(asyncio.wait_for(_story(), 240.0))


def test_a_client_on_another_stack_reads_process_values_and_hears_of_changes(tmp_path: Path) -> None:
    async def story() -> None:
        async with bench(2, nodesets=str(FOLDER)) as b:
            panel = pair("panel")
            trust(b.pki, panel.certificate)
            (b.pki / "opcua-client-panel.pem").write_bytes(panel.certificate)
            (b.pki / "opcua-client-panel.key.pem").write_bytes(panel.private_key)
            async with b.connected("vera") as own:
                for path in (f"{PROCESS}.2.AnalogSignal", f"{EXECUTE}.CurrentState"):
                    await b.until(own, path, lambda found: found.StatusCode.is_good())
            await asyncio.to_thread(_on_another_stack, b, tmp_path)

    asyncio.run(asyncio.wait_for(story(), 240.0))


def _on_another_stack(b: Bench, folder: Path) -> None:
    signal, setpoint = f"{PROCESS}.2.AnalogSignal", f"{PROCESS}.2.ProcessValueSetpoint"
    location = f"{MACHINE}.Identification.Location"
    with Spoken("operator_client.js", b.url, b.pki, folder / "client", log=folder / "log") as client:
        assert client("connect", "vera", {"user": "vera", "password": PASSWORD})["refused"] is None
        low, high = b.line.limits.tension_min_n, b.line.limits.tension_max_n
        for path in (signal, setpoint):
            assert client("analog", "vera", path) == {
                "unit": 5129559, "symbol": "N", "of": "http://www.opcfoundation.org/UA/units/un/cefact",
                "low": low, "high": high,
            }  # fmt: skip
        found = client("read", "vera", [signal, setpoint, location])
        assert [found[path]["value"] for path in (signal, setpoint, location)] == [21.0, 21.0, b.line.site]
        state = f"{EXECUTE}.CurrentState"
        assert client("read", "vera", [state])[state]["value"] == "Execute"
        assert client("watch", "vera", [signal])["refused"] == []
        b.gateway.tension_n = 30.0
        heard = until(lambda: client("seen", "vera").get(signal), lambda seen: seen and seen["last"]["value"] == 31.0)
        assert heard["last"]["status"] == "Good"
        assert client("write", "vera", signal, 1.0) == "BadUserAccessDenied"
        client("close", "vera")
