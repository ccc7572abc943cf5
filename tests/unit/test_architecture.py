"""The picture in docs/architecture.md against the imports of the code, both ways."""

import re
from pathlib import Path

import grimp

ROOTS = ("gateway", "drivers", "sim_plant", "safety", "agents")


def room(module: str) -> str:
    parts = module.split(".")
    return ".".join(parts[:2]) if parts[0] == "gateway" else parts[0]


def picture() -> tuple[set[str], set[tuple[str, str]]]:
    text = Path("docs/architecture.md").read_text()
    graph = re.search(r"```mermaid\n(.*?)```", text, re.DOTALL)
    assert graph, "docs/architecture.md has lost its picture"
    lines = [line.strip() for line in graph[1].splitlines()[1:] if line.strip()]
    arrows = {(left, right) for left, _, right in (line.partition(" --> ") for line in lines) if right}
    rooms = {name for arrow in arrows for name in arrow} | {line for line in lines if "-->" not in line}
    return rooms, arrows


def code() -> tuple[set[str], set[tuple[str, str]]]:
    graph = grimp.build_graph(*ROOTS)
    arrows = {
        (room(module), room(imported))
        for module in graph.modules
        for imported in graph.find_modules_directly_imported_by(module)
        if room(module) != room(imported)
    }
    return {room(module) for module in graph.modules if room(module) != "gateway"}, arrows


def test_the_picture_shows_every_room_and_every_import_between_rooms():
    assert picture() == code()


def test_every_room_is_described():
    text = Path("docs/architecture.md").read_text()
    described = set(re.findall(r"^\| `([a-z_.]+)` \|", text, re.MULTILINE))
    assert described == picture()[0]
