"""What doctor and scan ask of OPC UA servers, against a real one; and that they only ask."""

import asyncio
from collections.abc import Iterator

import pytest
from asyncua import ua

from drivers.device_map import MAPS, load_map, map_names
from drivers.inspection import BusFacts
from drivers.opcua.inspect import inspect
from drivers.opcua.maps import OpcUaMap
from drivers.opcua.scan import MapFit, OpcUaScan, ScanFailed, is_node_id, scan
from drivers.wiring import Wired
from gateway.core.line import OpcUaBus
from tests.protocol.driver_opcua_support import DeviceServer, device_server, line
from tests.support.ports import free_port

pytestmark = pytest.mark.wires


@pytest.fixture(scope="module")
def one_server() -> Iterator[DeviceServer]:
    with device_server() as server:
        yield server


@pytest.fixture
def server(one_server: DeviceServer) -> Iterator[DeviceServer]:
    """Everything as at first; afterwards nothing may have been written."""
    one_server.reset()
    yield one_server
    assert not one_server.devices.writes


def quiet(text: str) -> None:
    """Nobody waits."""


def inspected(endpoint: str) -> BusFacts:
    of_line = line(endpoint)
    bus = of_line.buses[0]
    assert isinstance(bus, OpcUaBus)
    items = [*of_line.drives, *of_line.load_cells, of_line.plc]
    devices = [Wired(item, bus, load_map(MAPS / f"{item.map}.toml")) for item in items]
    return asyncio.run(inspect(bus, devices, 0.0, quiet))


def test_a_line_as_its_maps_say(server: DeviceServer) -> None:
    facts = inspected(server.endpoint)
    assert not facts.trouble and [device.believed for device in facts.devices] == [True] * 5
    drive, _, cell, second_cell, plc = facts.devices
    assert drive.drive is not None and drive.drive.power is not None and drive.drive.safe_torque_off is False
    assert drive.drive.rated_torque_nm is not None and drive.drive.rated_torque_nm.value == 80.0
    assert drive.watchdog is not None and drive.watchdog.now_s.value == 0.0 and drive.watchdog.high_s == 1.0
    assert cell.cell is not None and set(cell.cell.samples_n) == {10.0} and cell.cell.counter_moves is True
    assert second_cell.cell is not None and set(second_cell.cell.samples_n) == {20.0}
    assert plc.plc is not None and plc.plc.permissive and not plc.plc.emergency_stop
    assert plc.plc.speed_m_per_s.value == pytest.approx(0.1)


def test_what_is_wrong_is_said(server: DeviceServer) -> None:
    devices = server.devices
    devices.set("Axis1.DeviceId", 0x1111)
    devices.set("Axis2.Statusword", 0x0218)
    devices.set("Axis2.ErrorCode", 0x8250)
    del devices.nodes["Axis2.Watchdog"]
    devices.counts = False
    devices.set("Cell1.Status", 2)
    devices.status["Cell2.Tension"] = ua.StatusCodes.UncertainSensorNotAccurate
    devices.set("Line.EmergencyStopHealthy", False)
    foreign, faulty, broken, doubtful, plc = inspected(server.endpoint).devices
    assert foreign.identity is not None and foreign.identity.found == "device id 0x1111" and foreign.drive is None
    assert faulty.drive is not None and faulty.drive.error == "error 0x8250"
    assert faulty.watchdog is not None and faulty.watchdog.now_s.trouble == "BadNodeIdUnknown"
    assert broken.cell is not None and broken.cell.trouble == "wire break" and broken.cell.counter_moves is False
    assert doubtful.cell is not None and doubtful.cell.trouble == "UncertainSensorNotAccurate"
    assert plc.plc is not None and plc.plc.emergency_stop


def test_nobody_there() -> None:
    facts = inspected(f"opc.tcp://127.0.0.1:{free_port()}")
    assert facts.trouble and not facts.devices


def scanned(server: DeviceServer, under: str = "", most: int = 200) -> OpcUaScan:
    every = {name: load_map(MAPS / f"{name}.toml") for name in map_names()}
    maps = {name: device for name, device in every.items() if isinstance(device, OpcUaMap)}
    return asyncio.run(scan(server.endpoint, under, maps, quiet, most))


def test_scan_finds_endpoints_namespaces_and_maps(server: DeviceServer) -> None:
    found = scanned(server)
    assert not found.not_browsed
    assert found.endpoints[0].policy == "None" and "Anonymous" in found.endpoints[0].tokens
    assert "urn:r2rgate:devices" in found.namespaces
    assert {fit.name: fit for fit in found.maps} == {
        "r2r-opcua-drive": MapFit("r2r-opcua-drive", (1, 2)),
        "r2r-opcua-amplifier": MapFit("r2r-opcua-amplifier", (1,)),
        "r2r-opcua-plc": MapFit("r2r-opcua-plc", (1,)),
    }


def test_variables_are_bounded_and_paged_by_a_node(server: DeviceServer) -> None:
    house = "i=2253"
    some = scanned(server, house, most=5)
    assert len(some.variables) == 5 and some.more
    # The build information of the server: a handful of variables, all of it.
    build = scanned(server, "i=2260")
    assert not build.more and {variable.path for variable in build.variables} >= {"ProductName", "SoftwareVersion"}
    by_node = {variable.node: variable for variable in build.variables}
    assert by_node["i=2261"].data_type == "String" and by_node["i=2261"].status == "Good"


def test_what_is_no_server(server: DeviceServer) -> None:
    async def run() -> None:
        async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.read(8)
            writer.write(b"HTTP/1.1 400 Bad Request\r\n\r\n")
            writer.close()

        async with await asyncio.start_server(answer, "127.0.0.1", 0) as web:
            port = web.sockets[0].getsockname()[1]
            with pytest.raises(ScanFailed):
                await scan(f"opc.tcp://127.0.0.1:{port}", "", {}, quiet)

    asyncio.run(run())


def test_node_ids() -> None:
    assert is_node_id("ns=2;s=Axis1") and is_node_id("i=85")
    assert not is_node_id("Axis1") and not is_node_id("ns=x;s=A")
