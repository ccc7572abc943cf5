"""The demonstration's operator on a line that runs: real gateway, real server, a client with its own certificate."""

import asyncio

import pytest
from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256

from gateway.cli.demo_orders import Approve, Call
from gateway.cli.demo_panel import Panel
from gateway.cli.demo_people import CLIENT, let_in
from gateway.control.design import design_lqg, task_of
from gateway.core.controller import config_hash
from gateway.core.line_file import load_line
from tests.operator.real_line import OperatorLine
from tests.support.recorder import require_safe

pytestmark = [pytest.mark.long, pytest.mark.realtime, pytest.mark.timeout(600)]


async def decide(access, user, password, proposal, shown, revision):
    """`Decide` by somebody else's hand. Returns what the method does; raises where it may not be called."""
    client = Client(access.url, timeout=25.0)
    client.application_uri = access.uri
    await client.set_security(
        SecurityPolicyBasic256Sha256, access.certificate, access.private_key,
        server_certificate=access.server_certificate, mode=ua.MessageSecurityMode.SignAndEncrypt,
    )  # fmt: skip
    client.set_user(user)
    client.set_password(password)
    async with client:
        number = await client.get_namespace_index("urn:r2rgate:line")
        return await client.get_node(ua.NodeId("Line", number)).call_method(
            ua.NodeId("Line.Decide", number), proposal, shown, ua.Variant(revision, ua.VariantType.UInt32), True, ""
        )


def test_a_scripted_operator_approves_what_it_was_shown_and_the_audit_says_that_it_is_a_script(tmp_path):
    async def story(line, access, password, proposal):
        shown = await asyncio.to_thread(line.shown, proposal)
        panel = await Panel.begin(access, tmp_path / "logs" / "client.log")
        try:
            for hash_, revision in (("0" * 64, shown.epoch), (shown.shown, shown.epoch + 1)):
                ok, sentence = await decide(access, "operator", password, proposal, hash_, revision)
                assert not ok and sentence
            with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
                await decide(access, "viewer", password, proposal, shown.shown, shown.epoch)
            assert (await asyncio.to_thread(line.shown, proposal)).stage == "waiting"
            told = await panel.ask(Approve(proposal=proposal, comment="a test"))
            assert told.ok and "on probation" in told.sentence and "rules passed, most narrowly" in told.seen, told
            ok, sentence = await decide(access, "operator", password, proposal, shown.shown, shown.epoch)
            assert not ok and sentence  # a word is good once
            told = await panel.ask(Call(method="Arm"))  # it runs
            assert not told.ok and told.sentence
            return shown
        finally:
            await panel.close()

    with OperatorLine(tmp_path, spans=3) as line:
        line.run()
        described = load_line((line.folder / "line.toml").read_text(encoding="utf-8"), "line.toml")
        found = let_in(described, line.data, people=True)
        line.operate()
        better = design_lqg(task_of(line.line))
        proposal = line.propose(better)
        line.until(proposal, "waiting")
        shown = asyncio.run(story(line, found.script, found.password, proposal))
        assert line.in_service() == config_hash(better)
        line.until(proposal, "kept")
        records = line.records()
        (approved,) = (one for one in records if one.kind == "approved")
        assert approved.who.name == "a program, run by script-operator (operator, opc-ua)"
        assert approved.who.certificate == line.fingerprint(CLIENT)
        assert approved.what["by"] == "script" and approved.what["shown"] == shown.shown
        (refused,) = (one for one in records if one.kind == "refused-person")
        assert refused.who.name == "viewer (viewer, opc-ua)" and refused.what["command"] == "decide"
        assert line.status().loop.state == "RUN"
        line.children.end("loop")
        line.recording()
        require_safe(line.unsafe())
