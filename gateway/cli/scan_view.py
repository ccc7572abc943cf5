"""What a scan found, for a person at a terminal or a pipe of 80 columns. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from gateway.core.line_problem import printable

if TYPE_CHECKING:  # the protocols' libraries are loaded by the scan that needs them
    from drivers.canopen.scan import CanScan, NodeFound
    from drivers.modbus.scan import ModbusScan, Row
    from drivers.opcua.scan import OpcUaScan

MOST_COB_IDS = 30
NO_MAP = "A device without a map: docs/adding-a-device.md says how to write one."


def can_scan(where: str, bitrate: int, found: CanScan) -> RenderableType:
    frames = sum(seen.count for seen in found.listening.frames.values())
    head = f"{where}: {frames} frames in {found.listened_s:g} s, load {found.load:.1%} of {bitrate} bit/s"
    parts: list[RenderableType] = [Text(head, "bold")]
    parts += [Text(f"bus: {printable(error)}", "yellow") for error in found.errors]
    if found.not_asked:
        parts.append(
            Text(f"The nodes were not asked, because somebody else talks to them: {found.not_asked}", "yellow")
        )
    if found.nodes:
        parts += [Text(), _nodes(found.nodes)]
        if any(node.answers and not node.maps for node in found.nodes):
            parts.append(Text(NO_MAP, "dim"))
    if found.listening.frames:
        parts += [Text(), _traffic(found)]
    return Group(*parts)


def _nodes(nodes: Sequence[NodeFound]) -> Table:
    table = _table()
    table.add_column("node", justify="right")
    table.add_column("state", no_wrap=True)
    table.add_column("vendor, product", no_wrap=True)
    table.add_column("what it says it is")
    table.add_column("maps that fit")
    for node in nodes:
        versions = [("", node.name), ("hardware ", node.hardware), ("software ", node.software), ("", node.profile)]
        says = ", ".join(what + text for what, text in versions if text)
        if not node.answers:
            says = "heartbeat only"
        identity = "-"
        if node.vendor_id is not None and node.product_code is not None:
            identity = f"{node.vendor_id:#x}, {node.product_code:#x}"
        fits = ", ".join(node.maps) or ("none" if node.answers else "-")
        state = node.nmt_state or "no heartbeat"
        table.add_row(str(node.node), state, identity, printable(says), fits)
    return table


def _traffic(found: CanScan) -> Table:
    from drivers.canopen.listening import in_words

    table = _table()
    table.add_column("COB-ID", no_wrap=True)
    table.add_column("frames", justify="right")
    table.add_column("per second", justify="right")
    table.add_column("by the predefined connection set")
    frames = sorted(found.listening.frames.items())
    for cob_id, seen in frames[:MOST_COB_IDS]:
        rate = "-" if seen.rate_hz is None else f"{seen.rate_hz:.1f}"
        table.add_row(f"{cob_id:03X}h", str(seen.count), rate, in_words(cob_id))
    if len(frames) > MOST_COB_IDS:
        table.add_row("...", "", "", f"and {len(frames) - MOST_COB_IDS} more; --json has all")
    return table


def modbus_scan(found: ModbusScan) -> RenderableType:
    table = _table()
    table.add_column("unit", justify="right")
    for function in (3, 4):
        table.add_column(f"function {function}")
    table.add_column("maps that fit")
    for unit in found.units:
        answers = [printable(unit.functions[function]) for function in (3, 4)]
        table.add_row(str(unit.unit), *answers, ", ".join(unit.maps) or "none")
    parts: list[RenderableType] = [Text(found.where, "bold"), Text(), table]
    parts.append(Text("Function 3 reads holding registers, 4 input registers. Asked: register 0.", "dim"))
    if any(not unit.maps for unit in found.units):
        parts.append(Text(NO_MAP, "dim"))
    return Group(*parts)


def register_table(unit: int, function: int, rows: Sequence[Row]) -> RenderableType:
    from drivers.modbus.scan import usual_float

    parts: list[RenderableType] = []
    marked = False
    for register, group in groupby(rows, key=lambda row: row.register):
        table = _table()
        table.add_column("read as", no_wrap=True)
        table.add_column(f"from 0 (wire {register})", justify="right")
        table.add_column(f"from 1 (wire {register - 1})" if register else "from 1", justify="right")
        for row in group:
            cells: list[str] = []
            for value in (row.zero, row.one):
                usual = usual_float(row, value)
                marked = marked or usual
                text = "-" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
                cells.append(text + (" *" if usual else "  "))
            table.add_row(row.reading, *cells)
        parts += [Text(f"unit {unit}, function {function}, register {register}", "bold"), table, Text()]
    parts.append(
        Text(
            "from 0, from 1: how the manual counts, the map's address_base. high-first, low-first: its word_order.",
            "dim",
        )
    )
    if marked:
        parts.append(Text("* a float of the size that measured values usually have (1e-4 to 1e7).", "dim"))
    return Group(*parts)


def opcua_scan(found: OpcUaScan) -> RenderableType:
    server = " ".join(word for word in (found.server or {}).values() if word)
    parts: list[RenderableType] = [Text(printable(f"{found.endpoint}  {server}".rstrip()), "bold"), Text()]
    endpoints = _table()
    for column in ("endpoint", "security", "mode", "sign in by"):
        endpoints.add_column(column)
    for endpoint in found.endpoints:
        endpoints.add_row(printable(endpoint.url), endpoint.policy, endpoint.mode, ", ".join(endpoint.tokens))
    parts.append(endpoints)
    if found.not_browsed:
        return Group(*parts, Text(), Text(f"Not browsed: {printable(found.not_browsed)}", "yellow"))
    parts.append(Text())
    parts += [Text(f"namespace {k}: {printable(uri)}") for k, uri in enumerate(found.namespaces)]
    for fit in found.maps:
        channels = f", channels {_ranges(fit.channels)}" if len(fit.channels) > 1 else ""
        parts.append(Text(f"map that fits: {fit.name} (address 1{channels})"))
    if not found.maps:
        parts.append(Text(f"No map fits. {NO_MAP}", "dim"))
    table = _table()
    for column in ("node", "type", "value", "status"):
        table.add_column(column, overflow="fold")
    for variable in found.variables:
        table.add_row(printable(variable.node), variable.data_type, printable(variable.value), variable.status)
    parts += [Text(), table]
    if found.more:
        parts.append(
            Text(f"The first {len(found.variables)}; --under NODE shows those below a node, --most more", "dim")
        )
    return Group(*parts)


def _ranges(numbers: Sequence[int]) -> str:
    """1 to 6, 8."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1].append(number)
        else:
            parts.append([number])
    return ", ".join(f"{part[0]} to {part[-1]}" if len(part) > 1 else str(part[0]) for part in parts)


def _table() -> Table:
    return Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="dim")
