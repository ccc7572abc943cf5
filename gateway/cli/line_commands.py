"""`init` and `check`: writing and proving a line description. Neither touches a bus."""

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from enum import StrEnum
from errno import EFBIG
from pathlib import Path
from shlex import quote
from typing import Annotated, Any, NoReturn

import numpy as np
import typer

from drivers.device_map import Maps, load_maps
from drivers.registry import nameless, unnamed_reactions, unseen
from gateway.cli.plc_signals import missing_plc_signals
from gateway.core.can_load import REFUSED_LOAD, bus_load
from gateway.core.line import Bus, CanopenBus, Line, OpcUaBus
from gateway.core.line_checks import Role
from gateway.core.line_file import CheckedLine, check_line
from gateway.core.line_problem import LineRefused, Problem, printable
from gateway.core.line_rules_process import recipe_torque
from gateway.core.line_rules_wiring import devices
from gateway.core.line_template import MOST_SPANS, line_template
from gateway.core.line_template_wiring import Wiring
from gateway.files import NotText, read_text

REFUSED = 2  #: exit code; 1 is left to crashes
_LARGEST_FILE_BYTES = 1_000_000
_KINDS = {"drives": "drive", "load_cells": "load cell", "plc": "PLC"}


class WireName(StrEnum):
    """What a role can be wired to."""

    CANOPEN = "canopen"
    MODBUS_TCP = "modbus-tcp"
    OPCUA = "opcua"
    RACK = "rack"


def init(
    spans: Annotated[int, typer.Option(min=1, max=MOST_SPANS, help="Number of spans, and of driven rollers.")] = 6,
    out: Annotated[Path, typer.Option(help="The file to write.")] = Path("line.toml"),
    drives: Annotated[WireName, typer.Option(help="The wire of the drives.")] = WireName.CANOPEN,
    load_cells: Annotated[WireName, typer.Option(help="The wire of the load cells.")] = WireName.MODBUS_TCP,
    plc: Annotated[WireName, typer.Option(help="The wire of the line PLC.")] = WireName.MODBUS_TCP,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file if it exists.")] = False,
) -> None:
    """Write a commented line description to fill in. As written it describes the simulated demonstration line.

    "rack" is one Modbus TCP unit that carries drives, load cells and line control together.

    Example: r2rgate init --spans 4 --plc opcua --out coater.toml
    """
    try:
        text = line_template(spans, quote(out.name), Wiring(drives.value, load_cells.value, plc.value))
    except ValueError as error:
        _refuse(str(error))
    try:
        with out.open("w" if force else "x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        _refuse(f"{out} exists and was left as it is; use another --out, or --force to overwrite it")
    except OSError as error:
        _refuse(f"{out} cannot be written: {error.strerror}")
    typer.echo(
        f"{out}: a line with {spans} {_count(spans, 'span')}. Fill in your line, then: r2rgate check {quote(str(out))}"
    )


def check(
    file: Annotated[Path, typer.Argument(help="The line description.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Check a line description: every error at once, each with its line, what is allowed, and the nearest valid thing.

    Touches no bus. Exit code 0: valid (perhaps with warnings), with a summary; 2: refused.

    Example: r2rgate check line.toml
    """
    source = printable(str(file))
    maps = load_maps()
    try:
        text = read_line_text(file, source)
        checked = check_line(text, source, roles_of(maps), maps.unusable)
        checked.warnings.extend(missing_plc_signals(text, source, checked.line))
    except LineRefused as refused:
        _print_refused(source, refused.problems, as_json)
        raise typer.Exit(REFUSED) from None
    checked = CheckedLine(checked.line, [*checked.warnings, *unusable_map_warnings(maps)])
    if as_json:
        warnings = [asdict(warning) for warning in checked.warnings]
        summary = summary_of(checked.line)
        result = {"file": source, "valid": True, "problems": [], "warnings": warnings, "summary": summary}
        more = {"unseen": unseen(checked.line), "reaction_unnamed": unnamed_reactions(checked.line)}
        _print_json({**result, **more, "serial_unnamed": nameless(checked.line)})
    else:
        typer.echo(_valid_in_words(source, checked))


def known_maps() -> Mapping[str, Role]:
    """Protocol, role and family of every device type that the drivers have a usable map for."""
    return roles_of(load_maps())


def roles_of(maps: Maps) -> Mapping[str, Role]:
    """Protocol, role and family of every usable map."""
    families = {name: getattr(device, "family", None) or "" for name, device in maps.usable.items()}
    return {name: (device.protocol, device.role, families[name]) for name, device in maps.usable.items()}


def unusable_map_warnings(maps: Maps) -> list[Problem]:
    """Maps that have mistakes, for whoever looks at a line that names none of them."""
    found: list[Problem] = []
    for first, *others in maps.unusable.values():
        more = f" (and {len(others)} more)" if others else ""
        wrong = f"this device map is not usable; no device of this line names it: {first.wrong}{more}"
        found.append(replace(first, wrong=wrong))
    return found


def read_line_text(file: Path, source: str) -> str:
    """The text of a line's file, called `source` in messages. Raises LineRefused where it is no text file."""
    try:
        return read_text(file, _LARGEST_FILE_BYTES)
    except OSError as error:
        if error.errno == EFBIG:
            raise LineRefused([Problem(source, 1, "", "", "is larger than 1 MB: no line description")]) from None
        advice = " (r2rgate init writes one)" if isinstance(error, FileNotFoundError) else ""
        raise LineRefused([Problem(source, 1, "", "", f"cannot be read: {error.strerror}{advice}")]) from None
    except NotText as error:
        wrong = "is not UTF-8 here: save the file as UTF-8"
        raise LineRefused([Problem(source, error.line, "", "", wrong)]) from None


def _refuse(message: str) -> NoReturn:
    typer.echo(message, err=True)
    raise typer.Exit(REFUSED)


def _print_refused(source: str, problems: list[Problem], as_json: bool) -> None:
    if as_json:
        refused = [asdict(problem) for problem in problems]
        _print_json({"file": source, "valid": False, "problems": refused, "warnings": [], "summary": None})
        return
    for problem in problems:
        typer.echo(str(problem))
    counted = " (drives[3] is the third [[drives]] table)" if any("[" in problem.key for problem in problems) else ""
    typer.echo(f"{source}: refused, {len(problems)} {_count(len(problems), 'error')}{counted}")


def _print_json(result: dict[str, Any]) -> None:
    typer.echo(json.dumps(result, indent=2))


def summary_of(line: Line) -> dict[str, Any]:
    """What a person wants to see of a valid line before trusting it, as plain data."""
    return {
        "site": line.site,
        "line": line.line,
        "spans": line.n,
        "draw_spans": sum(span.control == "draw" for span in line.spans),
        "period_s": line.control.period_s,
        "latency_s": line.control.latency_s,
        "torque_limit_nm": line.limits.torque_nm,
        "buses": [_bus_summary(line, bus) for bus in line.buses],
        "recipes": [_recipe_summary(line, index) for index in range(len(line.recipes))],
    }


def _bus_summary(line: Line, bus: Bus) -> dict[str, Any]:
    kinds = [_KINDS[str(path[0])] for path, device in devices(line) if device.bus == bus.name]
    return {
        "name": bus.name,
        "protocol": bus.protocol,
        "wire": _wire(bus),
        "devices": {kind: kinds.count(kind) for kind in dict.fromkeys(kinds)},
        "load": round(bus_load(line, bus), 4) if isinstance(bus, CanopenBus) else None,
    }


def _wire(bus: Bus) -> str:
    if isinstance(bus, OpcUaBus):
        return bus.endpoint
    port = f":{bus.port}" if bus.port is not None else ""
    return f"{bus.interface} {bus.channel}{port}" if isinstance(bus, CanopenBus) else f"{bus.host}{port}"


def _recipe_summary(line: Line, index: int) -> dict[str, Any]:
    recipe = line.recipes[index]
    torque = recipe_torque(line, recipe)
    return {
        "name": recipe.name,
        "tension_n": recipe.tension_n,
        "speed_m_per_s": recipe.speed_m_per_s,
        "torque_nm": [round(float(value), 3) for value in torque.running],
        "needed_nominal_nm": round(float(np.max(torque.nominal)), 3),
        "needed_worst_nm": round(float(np.max(torque.worst)), 3),
    }


def _valid_in_words(source: str, checked: CheckedLine) -> str:
    summary = summary_of(checked.line)
    draw = f", {summary['draw_spans']} of them draw-controlled" if summary["draw_spans"] else ""
    spans = f"{summary['spans']} {_count(summary['spans'], 'span')}{draw}"
    timing = f"period {1e3 * summary['period_s']:g} ms, latency {1e3 * summary['latency_s']:g} ms"
    text = [f"warning: {warning}" for warning in checked.warnings]
    text += [f"note: {note}: say in the map where the drive tells it" for note in unseen(checked.line)]
    if maps := unnamed_reactions(checked.line):
        text.append(
            f"note: no option code says what a watchdog does in device map {', '.join(maps)}: "
            "only the drill of `r2rgate prove` shows it"
        )
    if names := nameless(checked.line):
        text.append(
            f"warning: the device maps of {', '.join(names)} name no serial number: that one of these is exchanged is "
            "not seen; prove it again by hand then: `r2rgate prove --only`"
        )
    text.append(f"{source}: valid. {summary['site']}/{summary['line']}: {spans}; {timing}")
    text += [f"  {row}" for row in _bus_rows(summary["buses"])]
    for recipe in summary["recipes"]:
        text += [f"  {row}" for row in _recipe_rows(recipe, summary["torque_limit_nm"])]
    if checked.warnings:
        text.append(f"{len(checked.warnings)} {_count(len(checked.warnings), 'warning')}: legal, but look again.")
    return "\n".join(text)


def _bus_rows(buses: list[dict[str, Any]]) -> list[str]:
    rows: list[str] = []
    for bus in buses:
        on_it = ", ".join(f"{n} {_count(n, kind)}" for kind, n in bus["devices"].items())
        load = f"; load {bus['load']:.0%} of at most {REFUSED_LOAD:.0%}" if bus["load"] is not None else ""
        rows.append(f"bus {bus['name']}: {bus['protocol']}, {printable(bus['wire'])}; {on_it}{load}")
    return rows


def _recipe_rows(recipe: dict[str, Any], limit_nm: float) -> list[str]:
    needed, worst = recipe["needed_nominal_nm"], recipe["needed_worst_nm"]
    return [
        f"recipe {recipe['name']}: {recipe['speed_m_per_s']:g} m/s; needs {needed:.1f} Nm of {limit_nm:g} Nm "
        f"(margin {1 - needed / limit_nm:.0%}), at the worst corner of the tolerances {worst:.1f} Nm",
        "  tension  N " + _row(recipe["tension_n"]),
        "  torque  Nm " + _row(recipe["torque_nm"]),
    ]


def _row(values: list[float]) -> str:
    """Numbers in columns, ten to a line."""
    lines = [values[start : start + 10] for start in range(0, len(values), 10)]
    return "\n               ".join("".join(f"{value:8.2f}" for value in line) for line in lines)


def _count(count: int, noun: str) -> str:
    return noun if count == 1 else f"{noun}s"
