"""What of a folder's node sets is taken over: a model with all it requires or nothing of it, and no code."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from asyncua import Server, ua

from gateway.operator.opcua.companion import MACHINE, PROCESS, make_companion
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
)
from tests.protocol.operator_support import NUMBER
from tests.unit.supervisor_support import line_of

OWN = "Line.Spans.2.Tension"


def run(story):
    asyncio.run(asyncio.wait_for(story(), 120.0))


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
        ({**SMALL, DI: node_set(DI, DI_NODES, {NAMESPACE: ""}), "own": node_set(NAMESPACE, "")}, "own, or", False),
        ({**SMALL, MACHINERY: node_set(MACHINERY, FOREIGN, {DI: "2024"})}, "allowed: its own namespace", False),
        ({**SMALL, DI: SMALL[DI].replace("</Uri>", f"</Uri><Uri>{NAMESPACE}</Uri>")}, "is this server's own", False),
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
