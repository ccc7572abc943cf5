"""`r2rgate alarms` against a gateway behind a real socket: listed, acknowledged, shelved, refused in a sentence."""

import asyncio
import json
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gateway.cli.main import app
from gateway.core.audit_record import Who
from gateway.core.status import GatewayStatus
from gateway.core.topics import GATEWAY_STATUS
from gateway.mailbox.paths import GATEWAY_SOCKET
from gateway.mailbox.unix import UnixMailbox
from gateway.supervisor.alarms import Alarms
from tests.support.patience import PATIENCE_S
from tests.unit.alarm_support import RECORDING, bus, span, status
from tests.unit.supervisor_support import short_folder

pytestmark = pytest.mark.wires

WALL_S = 1_700_000_000.0
BROKEN = status(buses=[bus(["drive-3"], "no \x1b[31mheartbeat")], spans=[span(1, quality="BAD")])


class Gateway:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.found: GatewayStatus = status()
        self.records = list[tuple[str, str, Mapping[str, Any]]]()

    async def append(self, kind: str, who: Who, what: Mapping[str, Any]) -> None:
        self.records.append((kind, who.name, what))

    async def serve(self, began: Callable[[], None], end: asyncio.Event) -> None:
        mailbox, now_s = UnixMailbox(), 100.0
        alarms = Alarms(
            mailbox, self.folder, self.append, lambda kind, text: None, lambda: now_s, lambda: now_s + WALL_S
        )

        async def told(_: bytes) -> bytes:
            alarms.look(self.found, RECORDING)
            return self.found.model_copy(update={"alarms": alarms.status()}).model_dump_json().encode()

        mailbox.serve(GATEWAY_STATUS, told)
        await mailbox.listen(self.folder / GATEWAY_SOCKET)
        began()
        await end.wait()
        await mailbox.close()


@contextmanager
def served() -> Iterator[Gateway]:
    """In a thread: the command has an event loop of its own."""
    with short_folder() as folder:
        gateway, began = Gateway(folder), threading.Event()
        loop, end = asyncio.new_event_loop(), asyncio.Event()
        thread = threading.Thread(target=lambda: loop.run_until_complete(gateway.serve(began.set, end)))
        thread.start()
        try:
            assert began.wait(PATIENCE_S)
            yield gateway
        finally:
            loop.call_soon_threadsafe(end.set)
            thread.join(PATIENCE_S)
            loop.close()


@pytest.fixture
def gateway() -> Iterator[Gateway]:
    with served() as found:
        yield found


def alarms(gateway: Gateway, *arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["alarms", *arguments, "--run-dir", str(gateway.folder)])
    return result.exit_code, result.output


def test_none_is_said_and_each_is_shown_with_cause_consequence_and_action(gateway: Gateway) -> None:
    assert alarms(gateway) == (0, "no alarm\n")
    gateway.found = BROKEN
    code, said = alarms(gateway)
    assert code == 0 and "\x1b" not in said
    assert "device-absent  high, since" in said and "NOT ACKNOWLEDGED, first of several" in said
    assert "a device does not answer: drive-3 on can0: no \\u001b[31mheartbeat" in said
    assert said.count("  Cause: ") == said.count("  Else: ") == said.count("  Do: ") == 2


def test_acknowledged_and_shelved_on_record(gateway: Gateway) -> None:
    gateway.found = BROKEN
    alarms(gateway)
    code, said = alarms(gateway, "acknowledge", "device-absent", "--comment", "plug out")
    assert (code, said) == (0, "device-absent is acknowledged\n")
    code, said = alarms(gateway, "shelve", "load-cell", "--for", "30min", "--because", "being exchanged")
    assert (code, said) == (0, "load-cell is shelved for 1800 s\n")
    assert [(kind, what["alarm"]) for kind, _, what in gateway.records] == [
        ("acknowledged", "device-absent"), ("shelved", "load-cell"),
    ]  # fmt: skip
    told = {one["name"]: one for one in json.loads(alarms(gateway, "--json")[1])}
    assert told["device-absent"]["acknowledged_by"] == gateway.records[0][1]
    assert told["load-cell"]["shelved_until_wall_s"] == WALL_S + 100.0 + 1800.0
    assert "shelved until" in alarms(gateway)[1]
    assert alarms(gateway, "shelve", "load-cell", "--for", "0", "--because", "done")[1] == "load-cell is back\n"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("acknowledge", "load-cell"), "load-cell is not active"),
        (("acknowledge", "load-sell"), "did you mean load-cell?"),
        (("acknowledge", "Load Cell"), "alarm: String should match pattern"),
        (("shelve", "load-cell", "--for", "9h", "--because", "x"), "at most 8h"),
        (("shelve", "load-cell", "--for", "30", "--because", "x"), "--for 30: allowed is a time such as 30min"),
        (("shelve", "load-cell", "--for", "1h", "--because", ""), "because: String should have at least 1"),
    ],
)
def test_what_cannot_be_is_refused(gateway: Gateway, arguments: tuple[str, ...], said: str) -> None:
    code, output = alarms(gateway, *arguments)
    assert code == 2 and said in output and gateway.records == []


@pytest.mark.parametrize("arguments", [(), ("acknowledge", "load-cell")])
def test_without_a_gateway_it_says_what_to_start(arguments: tuple[str, ...]) -> None:
    with short_folder() as folder:
        code, said = alarms(Gateway(folder), *arguments)
    assert code == 3 and "r2rgate gateway" in said
