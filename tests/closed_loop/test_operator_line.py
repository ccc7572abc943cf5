"""A change approved over OPC UA on a line that runs: real gateway, real server, a client with its own certificate."""

import asyncio
import hashlib
from pathlib import Path

import pytest
from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from gateway.cli.children import free_tcp_ports
from gateway.cli.demo_orders import Approve, Call
from gateway.cli.demo_panel import Panel
from gateway.cli.demo_people import let_in
from gateway.control.design import design_lqg, task_of
from gateway.core.controller import config_hash
from gateway.core.line_file import load_line
from gateway.supervisor.audit_file import AuditFile
from tests.closed_loop.gate_line import GateLine

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(180)]


class OperatorLine(GateLine):
    """With an operator's process on free ports, and everybody of the demonstration let in."""

    def __init__(self, folder):
        super().__init__(folder)
        opc_ua, page = free_tcp_ports(2)
        text = (folder / "line.toml").read_text()
        text = text.replace('# opc_ua = "opc.tcp://127.0.0.1:4840"', f'opc_ua = "opc.tcp://127.0.0.1:{opc_ua}"')
        text = text.replace('# page = "http://127.0.0.1:8480"', f'page = "http://127.0.0.1:{page}"')
        (folder / "line.toml").write_text(text)
        self.line = load_line(text, "line.toml")
        assert f":{opc_ua}" in self.line.operator.opc_ua and f":{page}" in self.line.operator.page

    def run(self):
        super().run()
        self.let_in = let_in(self.line, self.data, people=True)
        self.children.start("operator", self.folder / "line.toml", *self.folders)

    def certificate(self):
        """As the audit names it."""
        found = x509.load_pem_x509_certificate(Path(self.let_in.script.certificate).read_bytes())
        return hashlib.sha256(found.public_bytes(Encoding.DER)).hexdigest()

    def records(self, kind):
        with AuditFile(self.data) as file:
            return [record for record in (row.record() for row in file.rows()) if record.kind == kind]


async def decide(line, user, *said):
    """`Decide` by somebody else's hand. Returns what the method does; raises where it may not be called."""
    access = line.let_in.script
    client = Client(access.url, timeout=25.0)
    client.application_uri = access.uri
    await client.set_security(
        SecurityPolicyBasic256Sha256, access.certificate, access.private_key,
        server_certificate=access.server_certificate, mode=ua.MessageSecurityMode.SignAndEncrypt,
    )  # fmt: skip
    client.set_user(user)
    client.set_password(line.let_in.password)
    async with client:
        number = await client.get_namespace_index("urn:r2rgate:line")
        proposal, shown, revision = said
        return await client.get_node(ua.NodeId("Line", number)).call_method(
            ua.NodeId("Line.Decide", number), proposal, shown, ua.Variant(revision, ua.VariantType.UInt32), True, ""
        )


def test_a_scripted_operator_approves_what_it_was_shown_and_the_audit_says_that_it_is_a_script(tmp_path):
    async def story(line, proposal):
        panel = await Panel.begin(line.let_in.script, tmp_path / "logs" / "client.log")
        try:
            told = await panel.ask(Call(method="Start"))  # once the server is there
            shown = line.shown(proposal)
            for user, *said in (
                ("operator", proposal, "0" * 64, shown.epoch),
                ("operator", proposal, shown.shown, shown.epoch + 1),
            ):
                ok, sentence = await decide(line, user, *said)
                assert not ok and sentence
            with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
                await decide(line, "viewer", proposal, shown.shown, shown.epoch)
            assert line.shown(proposal).stage == "waiting"
            told = await panel.ask(Approve(proposal=proposal, comment="a test"))
            assert told.ok and "on probation" in told.sentence and "rules passed, most narrowly" in told.seen, told
            ok, sentence = await decide(line, "operator", proposal, shown.shown, shown.epoch)
            assert not ok, sentence  # a word is good once
            return shown
        finally:
            await panel.close()

    with OperatorLine(tmp_path) as line:
        line.run()
        better = design_lqg(task_of(line.line))
        proposal = line.propose(better)
        line.until(proposal, "waiting")
        shown = asyncio.run(story(line, proposal))
        assert line.in_service() == config_hash(better)
        line.until(proposal, "kept")
        (approved,) = line.records("approved")
        assert approved.who.name == "a program, run by script-operator (operator, opc-ua)"
        assert approved.who.certificate == line.certificate()
        assert approved.what["by"] == "script" and approved.what["shown"] == shown.shown
        (refused,) = line.records("refused-person")
        assert refused.who.name == "viewer (viewer, opc-ua)" and refused.what["command"] == "decide"
        line.recording()
        assert not any(line.unsafe().values()), line.unsafe()
