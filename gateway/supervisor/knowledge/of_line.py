"""What the line's file says, as documents: what the line consists of, what it believes, and what it never leaves. Pure.

What the file believes of web and rollers is said with its tolerance in one sentence: it is no figure that could speak
against one that was measured.
"""

from typing import Any

from gateway.core.line import Drive, Line, LoadCell, Parameter, Strict
from gateway.core.line_help import HELP
from gateway.core.line_queries import Generated
from gateway.core.line_words import name_and_unit
from gateway.supervisor.knowledge.words import listed, number, quoted, section, whole

MOST_LETTERS = 90_000  #: of a document here: a file of sixty spans is told whole
_TABLES = {"limits": "Limits", "moves": "Moves", "control": "Control", "gate": "Gate", "priorities": "Priorities"}
_KEYWORDS = {
    "limits": ["torque limit", "tension limit", "speed limit", "largest step", "watchdog"],
    "moves": ["ramp", "set-point rates", "controlled stop"],
    "control": ["control period", "latency"],
    "gate": ["who approves", "rules of the gate", "probation", "cool-down"],
    "priorities": ["weights of the score", "what matters"],
}


def of_line(line: Line) -> list[Generated]:
    """The same as long as the file is the same. Without a date: the file has none."""
    tables = [_table(line, key, model) for key, model in _TABLES.items()]
    return [_equipment(line), _believed(line), *tables, _recipes(line)]


def _equipment(line: Line) -> Generated:
    drives = {one.roller: one for one in line.drives}
    cells = {one.span: one for one in line.load_cells}
    return Generated(
        name="line",
        title=f"This line, {line.site}/{line.line}: spans, rollers, drives, load cells, buses",
        text=whole([
            f"The line {line.line} of {line.site} has {line.n} spans and {line.n} driven rollers. Span i lies between "
            "roller i-1 and roller i; roller 0 is the unwinder, which the line PLC drives.",
            section("What its people say of it", quoted(line.description)) if line.description else "",
            listed("Spans", (
                f"Span {i} ({span.name}) {_parameter('is', span.length_m, 'm')} long, "
                f"{_cell(cells.get(i))}." for i, span in enumerate(line.spans, 1)
            )),
            listed("Rollers", (
                f"Roller {i} ({roller.name}) {_drive(drives.get(i))}." for i, roller in enumerate(line.rollers, 1)
            )),
            listed("Buses", (f"Bus {bus.name} speaks {bus.protocol}." for bus in line.buses)),
        ], MOST_LETTERS),
        date="",
        keywords=["equipment", "layout", "how many spans", "load cells", "drives", "fieldbus", "unwinder"],
    )  # fmt: skip


def _believed(line: Line) -> Generated:
    web = line.web
    return Generated(
        name="line-believed",
        title="What the line's file believes of web and rollers, before anything is measured",
        text=whole([
            "These are nominal values with tolerances. A model that was accepted counts before them.",
            f"The web's EA {_parameter('is taken for', web.stiffness_n, 'N')}.",
            listed("Rollers", (
                f"Roller {i} ({one.name}): {_parameter('radius', one.radius_m, 'm')}, "
                f"{_parameter('inertia', one.inertia_kg_m2, 'kg m²')}, "
                f"{_parameter('viscous friction', one.friction_nms_per_rad, 'Nm s/rad')}."
                for i, one in enumerate(line.rollers, 1)
            )),
        ], MOST_LETTERS),
        date="",
        keywords=["nominal values", "tolerances", "line.toml"],
    )  # fmt: skip


def _table(line: Line, key: str, model: str) -> Generated:
    table: Strict = getattr(line, key)
    fields: dict[str, Any] = table.model_dump()
    return Generated(
        name=f"line-{key}",
        title=f"The {key} of this line",
        text=whole([f"As the line's file has it: {HELP['Line'][key].partition(';')[0]}.", listed(key.capitalize(), (
            f"{_named(key, name)} is {_value('' if key == 'priorities' else name, value)}: {HELP[model][name]}."
            for name, value in fields.items() if value is not None
        ))], MOST_LETTERS),
        date="",
        keywords=_KEYWORDS[key],
    )  # fmt: skip


def _recipes(line: Line) -> Generated:
    return Generated(
        name="line-recipes",
        title="The recipes of this line: set-points of tension and speed of each grade",
        text=whole([listed("Recipes", (
            f"Recipe {one.name}: {', '.join(map(number, one.tension_n))} N in spans 1 to {line.n}, at "
            f"{number(one.speed_m_per_s, 'm/s')}." for one in line.recipes
        ))], MOST_LETTERS),
        date="",
        keywords=["grades", "set-points", "recipes", "production speed"],
    )  # fmt: skip


def _parameter(says: str, one: Parameter, unit: str) -> str:
    return f"{says} {number(one.value, unit)} within {number(100.0 * one.tolerance)} %"


def _cell(cell: LoadCell | None) -> str:
    if cell is None:
        return "draw-controlled, without a load cell"
    believed = f"believed up to {number(cell.capacity_n, 'N')}"
    return f"tension-controlled, with load cell {cell.name} ({cell.map} on {cell.bus}, {believed})"


def _drive(drive: Drive | None) -> str:
    if drive is None:
        return "has no drive"
    return f"is driven by {drive.name} ({drive.map} on {drive.bus}, rated {number(drive.rated_torque_nm, 'Nm')})"


def _named(table: str, key: str) -> str:
    name, _ = name_and_unit(key)
    return f"{table}.{key} ({name.replace('_', ' ').removesuffix(' per')})"


def _value(key: str, value: Any) -> str:
    """With the unit that its key ends with; without a key, without one."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return number(value, name_and_unit(key)[1])
