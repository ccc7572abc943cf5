"""`r2rgate doctor`: is everything as it must be before this line is armed? Reads only."""

import json
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from gateway.cli.doctor_check import Check, counted
from gateway.cli.doctor_running import running
from gateway.cli.process_commands import DataFolder, LineFile, RunFolder, default_data_folder, read_line
from gateway.cli.waiting import progress, run_until_done
from gateway.core.line import Bus, CanopenBus, Line, ModbusTcpBus
from gateway.core.line_file import check_line
from gateway.core.line_problem import printable
from gateway.mailbox.listener import living
from gateway.mailbox.paths import GATEWAY_DATA, LOOP_SOCKET, OPERATOR_DATA, default_run_folder, running_lines

if TYPE_CHECKING:
    from drivers.inspection import BusFacts

FAILED = 1
LISTEN_S = 1.0  #: to a CAN bus: ten heartbeats
SAMPLE_S = 1.0  #: of the load cells

Progress = Callable[[str], None]


def doctor(
    file: LineFile,
    seconds: Annotated[float, typer.Option(min=0.2, max=600.0, help="How long to measure jitter.")] = 5.0,
    run_dir: RunFolder = None,
    data_dir: DataFolder = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print as JSON.")] = False,
) -> None:
    """Look at all that a line needs: file, software, permissions, computer, clocks, model, jitter, buses, devices.

    Nothing is written to a device and nothing is commanded. While the line's loop runs its buses are left alone, and
    what the loop says of them is shown. Exit code: 0 nothing FAILs, 1 something does, 2 the line's file is not usable.

    Example: r2rgate doctor line.toml
    """
    line = read_line(file)
    run_folder, data_folder = run_dir or default_run_folder(line), data_dir or default_data_folder(line)
    with progress() as tell:
        checks = _file(file) + run_until_done(examine(line, run_folder, data_folder, seconds, tell))
    counts = counted(checks)
    if as_json:
        document = {
            "file": str(file),
            "site": line.site,
            "line": line.line,
            "ok": not counts["FAIL"],
            "counts": counts,
            "checks": [check._asdict() for check in checks],
        }
        typer.echo(json.dumps(document, indent=2))
    else:
        from gateway.cli.doctor_view import table

        Console(highlight=False).print(table(f"{printable(str(file))}: {line.site}/{line.line}", checks))
    raise typer.Exit(FAILED if counts["FAIL"] else 0)


async def examine(line: Line, run_folder: Path, data_folder: Path, seconds: float, tell: Progress) -> list[Check]:
    """Every check but that of the file."""
    from gateway.cli.doctor_certificates import certificates, opcua_certificates
    from gateway.cli.doctor_clocks import clocks
    from gateway.cli.doctor_keys import gateway_key
    from gateway.cli.doctor_language_model import language_model
    from gateway.cli.doctor_machine import machine
    from gateway.cli.doctor_permissions import permissions
    from gateway.cli.doctor_software import software
    from gateway.operator.opcua.trust import pki_folder

    tell("software, permissions, computer, certificates, language model")
    checks = [
        *software(), *permissions(line, run_folder, data_folder), gateway_key(line, data_folder / GATEWAY_DATA),
        *machine(line, data_folder / GATEWAY_DATA), *clocks(),
    ]  # fmt: skip
    now = datetime.now(UTC)
    checks += [
        *certificates(line.network, now),
        *opcua_certificates(pki_folder(line, data_folder / OPERATOR_DATA), now),
    ]
    checks += await language_model(line.agents)
    if living(run_folder / LOOP_SOCKET):
        why = f"the line's loop runs ({run_folder / LOOP_SOCKET})"
        checks.append(Check("real time", "lateness", "", "skipped", f"{why}: the measurement would take its processor"))
        todo = "end the loop to have them looked at; meanwhile this is what the loop says"
        checks.append(Check("buses", "all", "", "skipped", f"{why}: they are not opened", "", todo))
        return checks + await running(run_folder)
    return checks + await _jitter(line, seconds, tell) + await inspected(line, run_folder, tell)


def _file(file: Path) -> list[Check]:
    """It is valid, or `read_line` had refused it; what is odd about it, and device maps that cannot be used."""
    from drivers.device_map import load_maps
    from gateway.cli.line_commands import roles_of

    maps = load_maps()
    warnings = check_line(file.read_text(encoding="utf-8"), str(file), roles_of(maps), maps.unusable).warnings
    found = [Check("file", "line", "", "OK", "valid, as `r2rgate check` has it")]
    for warning in warnings:
        found.append(
            Check("file", f"line {warning.line}", "", "warning", f"{warning.key}: {warning.wrong}", warning.allowed)
        )
    todo = "mend the map, or take the file away: no line can name it; this line does not"
    for name, (first, *others) in maps.unusable.items():
        more = f" (and {len(others)} more)" if others else ""
        found.append(Check("device maps", printable(name), "", "warning", f"{first}{more}", "", todo))
    return found


async def _jitter(line: Line, seconds: float, tell: Progress) -> list[Check]:
    from gateway.cli.doctor_jitter import MeasurementFailed, judged, measure

    others = [folder for folder in running_lines() if living(folder / LOOP_SOCKET)]
    if others:
        why = f"another line's loop runs here ({others[0]}): the measurement would take its processor"
        return [Check("real time", "lateness", "", "skipped", why)]
    tell(f"jitter, for {seconds:g} s")
    try:
        return list(judged(line, await measure(line, seconds)))
    except (MeasurementFailed, OSError) as error:
        todo = "the loop would fail the same way: mend that first"
        return [Check("real time", "lateness", "", "FAIL", f"cannot be measured: {error}", "", todo)]


async def inspected(line: Line, run_folder: Path, tell: Progress) -> list[Check]:
    """The checks of every bus and device of a line whose loop does not run in `run_folder`."""
    from drivers.registry import LinksRefused, build_links
    from gateway.cli.doctor_devices import judged

    try:
        build_links(line)
    except LinksRefused as refused:
        todo = "correct the line's file; the loop would not start"
        return [Check("buses", "drivers", "", "FAIL", reason, "", todo) for reason in refused.reasons]
    checks: list[Check] = []
    for bus in line.buses:
        if living(run_folder / LOOP_SOCKET):
            todo = "run doctor again"
            checks.append(Check("buses", bus.name, "", "skipped", "the line's loop was started meanwhile", "", todo))
            continue
        checks += judged(line, bus, await _inspect(line, bus, tell))
    order = ["buses", "drives", "load cells", "line PLC"]
    return sorted(checks, key=lambda check: order.index(check.group))


async def _inspect(line: Line, bus: Bus, tell: Progress) -> "BusFacts":
    from drivers.device_map import MAPS, load_map
    from drivers.wiring import Wired

    items = [item for item in (*line.drives, *line.load_cells, line.plc) if item.bus == bus.name]
    devices = [Wired(item, bus, load_map(MAPS / f"{item.map}.toml")) for item in items]
    if isinstance(bus, CanopenBus):
        from drivers.canopen.inspect import inspect as inspect_canopen

        return await inspect_canopen(bus, devices, LISTEN_S, SAMPLE_S, tell)
    if isinstance(bus, ModbusTcpBus):
        from drivers.modbus.inspect import inspect as inspect_modbus

        return await inspect_modbus(bus, devices, SAMPLE_S, tell)
    from drivers.opcua.inspect import inspect as inspect_opcua

    return await inspect_opcua(bus, devices, SAMPLE_S, tell)
