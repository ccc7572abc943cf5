"""What `init` writes, and the documents that describe the format."""

import json
import re
import tomllib
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from gateway.cli.line_commands import known_maps
from gateway.core.line_file import check_line, load_line
from gateway.core.line_help import HELP, line_schema
from gateway.core.line_template import line_template
from gateway.core.line_template_wiring import MOST_SPANS_OF_RACK, Wire, Wiring

DOCS = Path(__file__).parents[2] / "docs"
MAPS = {
    "cia402-torque": ("canopen", "drive", ""),
    "loadcell-amp": ("modbus-tcp", "load-cell", ""),
    "line-plc": ("modbus-tcp", "line-plc", ""),
}


@pytest.mark.parametrize("spans", [1, 2, 3, 6, 7, 24, 25, 48, 49, 60])
def test_it_is_valid_as_it_is_without_a_warning(spans: int) -> None:
    checked = check_line(line_template(spans), "line.toml", MAPS)
    assert checked.warnings == []
    line = checked.line
    assert line.n == spans == len(line.rollers) == len(line.drives) == len(line.load_cells)
    assert [drive.roller for drive in line.drives] == list(range(1, spans + 1))


@pytest.mark.parametrize("spans", [0, -1, 61])
def test_other_numbers_of_spans_are_refused(spans: int) -> None:
    with pytest.raises(ValueError, match="1 to 60 spans"):
        line_template(spans)


def test_it_describes_the_demonstration_line() -> None:
    line = check_line(line_template(), "line.toml").line
    assert (line.web.stiffness_n.value, line.web.stiffness_n.tolerance) == (2400.0, 0.3)
    roller, span = line.rollers[5], line.spans[5]
    parameters = (roller.inertia_kg_m2, roller.radius_m, roller.friction_nms_per_rad, span.length_m)
    assert [(p.value, p.tolerance) for p in parameters] == [(0.95, 0.3), (0.04, 0.2), (10.0, 0.75), (1.0, 0.3)]
    limits = line.limits
    assert (limits.torque_nm, limits.torque_rate_nm_per_s) == (60.0, 1000.0)
    assert (limits.tension_min_n, limits.tension_max_n, limits.speed_max_m_per_s) == (2.0, 60.0, 0.12)
    assert (limits.tension_step_max_n, limits.speed_step_max_m_per_s) == (24.0, 0.09)
    assert (line.control.period_s, line.control.latency_s) == (0.010, 0.010)
    assert [(r.name, r.tension_n, r.speed_m_per_s) for r in line.recipes] == [
        ("tension", [28.0, 36.0, 20.0, 40.0, 24.0, 32.0], 0.01),
        ("velocity", [30.0] * 6, 0.01),
    ]


def test_every_key_of_the_format_is_in_it_with_its_help() -> None:
    text = line_template(1)
    for model, keys in HELP.items():
        if model in ("Line", "Parameter"):
            continue
        for key, said in keys.items():
            entry = rf"^(?:(?:# )?{key} = .*|\[{model.lower()}\.{key}\]  )# {re.escape(said)}$"
            assert re.search(entry, text, re.MULTILINE), f"{model}.{key}"


def test_every_key_of_the_format_has_its_help() -> None:
    schema = line_schema()  # a key without help is a KeyError here
    models = {"Line": schema, **schema["$defs"]}
    assert {name: set(model["properties"]) for name, model in models.items()} == {
        name: set(keys) for name, keys in HELP.items()
    }


REGENERATE = (
    "regenerate: python -c 'import json; from gateway.core.line_help import line_schema; "
    "print(json.dumps(line_schema(), indent=2))' > docs/schemas/line.schema.json; "
    "r2rgate init --force --out docs/examples/line.toml"
)


def test_the_published_schema_is_the_code() -> None:
    published = (DOCS / "schemas/line.schema.json").read_text(encoding="utf-8")
    assert published == json.dumps(line_schema(), indent=2) + "\n", REGENERATE


def test_the_published_example_is_the_template() -> None:
    assert (DOCS / "examples/line.toml").read_text(encoding="utf-8") == line_template(), REGENERATE


def test_the_example_has_the_structure_of_the_schema() -> None:
    published = json.loads((DOCS / "schemas/line.schema.json").read_text(encoding="utf-8"))

    def fits(value: Any, node: dict[str, Any]) -> None:
        node = published["$defs"][node["$ref"].rsplit("/", 1)[1]] if "$ref" in node else node
        if "oneOf" in node:
            node = published["$defs"][node["discriminator"]["mapping"][value["protocol"]].rsplit("/", 1)[1]]
        if "anyOf" in node:
            node = node["anyOf"][0]
        if isinstance(value, dict):
            assert node["type"] == "object"
            assert set(node["required"] if "required" in node else ()) <= set(value) <= set(node["properties"])
            for key, child in value.items():
                fits(child, node["properties"][key])
        elif isinstance(value, list):
            assert node["type"] == "array"
            for child in value:
                fits(child, node["items"])
        else:
            assert isinstance(value, {"number": (int, float), "integer": int, "string": str}[node["type"]])
            assert value in node.get("enum", [value])
            assert re.search(node.get("pattern", ""), str(value))

    fits(tomllib.loads((DOCS / "examples/line.toml").read_text(encoding="utf-8")), published)


@pytest.mark.slow
@pytest.mark.parametrize("spans", [1, 8, 9, 14, 60])
def test_every_mix_of_wires_is_valid_and_every_device_is_on_the_wire_asked_for(spans: int) -> None:
    wires: tuple[Wire, ...] = ("canopen", "modbus-tcp", "opcua", "rack")
    for drives, load_cells, plc in product(wires, wires, wires):
        wiring = Wiring(drives, load_cells, plc)
        if wiring.uses("rack") and spans > MOST_SPANS_OF_RACK:
            with pytest.raises(ValueError, match="at most 14 spans"):
                line_template(spans, wiring=wiring)
            continue
        line = load_line(line_template(spans, wiring=wiring), "line.toml", known_maps())
        protocols = {bus.name: bus.protocol for bus in line.buses}
        for wire, devices in ((drives, line.drives), (load_cells, line.load_cells), (plc, [line.plc])):
            assert {protocols[device.bus] for device in devices} == {"modbus-tcp" if wire == "rack" else wire}
