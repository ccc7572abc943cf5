"""`r2rgate prove` as a client of the gateway: what it orders, one after the other."""

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from gateway.cli.main import app
from gateway.cli.prove import ASKED, prove
from gateway.core.finding import finding
from gateway.core.messages import Command, KeepProof, Prove, Reply, in_words


@pytest.mark.parametrize(
    ("only", "said"), [([], "prove"), (["drive-3", "load-cell-3"], "prove only drive-3 only load-cell-3")]
)
def test_what_is_proved_alone_is_named_from_the_first_order_to_the_last(only: list[str], said: str) -> None:
    told: list[Command] = []

    async def tell(command: Command) -> Reply:
        told.append(command)
        asks = isinstance(command, KeepProof) and not command.answers
        question = finding("drive-torque-unseen", drive="drive-3", roller=3)
        return Reply(ok=not asks, state="STOP", text="", findings=[finding(ASKED), question] if asks else [])

    async def look() -> Any:
        return SimpleNamespace(events=[], loop=SimpleNamespace(phase="OFF", state="STOP"))

    proved = asyncio.run(prove(tell, look, lambda _: True, "anna", lambda _: None, only))
    assert proved.ok and [command.command for command in told] == ["drill", "arm", "prove", "keep-proof", "keep-proof"]
    named = [command.only for command in told if isinstance(command, Prove | KeepProof)]
    assert named == [only] * 3
    assert [(answer.device, answer.by) for answer in proved.answers] == [("drive-3", "anna")]
    assert in_words(told[2]) == said


def test_a_name_that_no_device_can_have_is_refused_before_anything_is_ordered() -> None:
    ran = CliRunner().invoke(app, ["prove", "--only", "Drive 3", "--run-dir", "/nowhere"])
    assert ran.exit_code == 2 and "Drive 3" in ran.output
