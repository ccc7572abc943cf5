"""The demonstration's OPC UA client against the real server: what it approves, over what, and what it leaves alone."""

import pytest

from gateway.cli import demo_client
from gateway.cli.demo_client import carried_out
from gateway.cli.demo_failed import DemoFailed
from gateway.cli.demo_orders import Access, Approve, Call
from gateway.cli.demo_panel import Panel
from gateway.core.decisions import Decide
from gateway.core.messages import Arm, Reply
from tests.protocol.operator_support import PASSWORD, SHOWN, bench, pair, shown
from tests.protocol.test_operator_nodes import run


def access_of(b, **changes):
    for name in ("certificate", "private_key"):
        (b.folder / f"client.{name}.pem").write_bytes(getattr(pair("client"), name))
    return Access(
        **{
            "url": b.url, "uri": "urn:test:client", "certificate": str(b.folder / "client.certificate.pem"),
            "private_key": str(b.folder / "client.private_key.pem"),
            "server_certificate": str(b.pki / "opcua-server.pem"), "user": "otto", "password": PASSWORD, **changes,
        }
    )  # fmt: skip


def approve(one):
    return Approve(proposal=one.proposal_hash, comment="a test")


@pytest.mark.wires
def test_it_arms_and_approves_exactly_what_it_has_read_from_a_process_of_its_own():
    async def story():
        async with bench(spans=1) as b:
            one = shown()
            b.gateway.waiting = [one]
            panel = await Panel.begin(access_of(b), b.folder / "client.log")
            try:
                told = await panel.ask(Call(method="Arm"))
                assert (told.ok, told.sentence) == (True, "done")
                told = await panel.ask(approve(one))
                assert told.ok and told.sentence == "done"
                assert "gain of span 2 from 1 to 2" in told.seen and "2 rules passed" in told.seen
                assert "most narrowly delay margin by 0.002 s" in told.seen
                b.gateway.reply = Reply(ok=False, state="", text="nothing was decided", reasons=["it is decided"])
                told = await panel.ask(approve(one))
                assert (told.ok, told.sentence) == (False, "nothing was decided; it is decided")
            finally:
                await panel.close()
            with pytest.raises(DemoFailed, match="does not answer"):
                await panel.ask(Call(method="Arm"))
            decide = Decide(proposal=one.proposal_hash, shown=SHOWN, revision=one.epoch, approve=True, comment="a test")
            assert [heard.said for heard in b.gateway.heard] == [Arm(), decide, decide]
            assert {(heard.person.name, heard.person.through) for heard in b.gateway.heard} == {("otto", "opc-ua")}
            assert all(heard.person.certificate for heard in b.gateway.heard)

    run(story)


def test_what_a_rule_is_against_it_does_not_approve():
    async def story():
        async with bench(spans=1) as b:
            one = shown()
            failed = [found.model_copy(update={"passed": False}) for found in one.verdict.findings]
            verdict = one.verdict.model_copy(update={"accepted": False, "findings": failed})
            b.gateway.waiting = [one.model_copy(update={"verdict": verdict})]
            told = await carried_out(access_of(b), approve(one))
            assert not told.ok and "the gate has not accepted it (delay margin, shape)" in told.sentence
            assert not b.gateway.heard

    run(story)


def test_what_is_not_shown_and_who_is_not_let_in_is_told(monkeypatch):
    monkeypatch.setattr(demo_client, "THERE_WITHIN_S", 0.5)

    async def story():
        async with bench(spans=1) as b:
            told = await carried_out(access_of(b), approve(shown()))
            assert not told.ok and "has not shown proposal" in told.sentence
            told = await carried_out(access_of(b, password="three old rolls"), Call(method="Arm"))
            assert not told.ok and "BadUserAccessDenied" in told.sentence
            told = await carried_out(access_of(b, url="opc.tcp://127.0.0.1:1"), Call(method="Arm"))
            assert not told.ok and "ConnectionRefusedError" in told.sentence
            assert not b.gateway.heard

    run(story)
