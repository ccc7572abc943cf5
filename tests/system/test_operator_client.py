"""`r2rgate operator` before a running line, and a client on node-opcua (npm) that was written from docs/operator.md.

What the client is told is judged by what the client says; what has come of it by the loop and by the audit.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Any

import pytest

from gateway.control.design import design_lqg, task_of
from gateway.core.controller import Controller, config_hash
from gateway.operator.opcua.trust import REJECTED
from tests.operator.names import PANEL, PASSWORD, STRANGER
from tests.operator.real_line import OperatorLine, until
from tests.system.peer import Spoken

pytestmark = pytest.mark.timeout(300)

SPANS = 6
MEASURED = [
    *(f"Line.Spans.{k}.{name}" for k in range(1, SPANS + 1) for name in ("Tension", "Error")),
    *(f"Line.Rollers.{k}.{name}" for k in range(1, SPANS + 1) for name in ("Speed", "Torque", "TorqueActual")),
    "Line.Unwinder.Speed",
]
KEPT = [
    *(f"Line.Spans.{k}.{name}" for k in range(1, SPANS + 1) for name in ("Setpoint", "Quality")),
    *(f"Line.Rollers.{k}.Drive" for k in range(1, SPANS + 1)),
    *(f"Line.Operation.{name}" for name in ("State", "Running", "Stands")),
    *(f"Line.Controller.{name}" for name in ("InService", "LastKnownGood", "Revision", "Health")),
]
POLICIES = ["Basic256Sha256", "Aes256_Sha256_RsaPss"]
OTTO = {"user": "otto", "password": PASSWORD}
VERA = {"user": "vera", "password": PASSWORD}


class Panel:
    """The client, with a session of each name that it is asked for."""

    def __init__(self, line: OperatorLine, client: Spoken) -> None:
        self.line, self.client = line, client

    @contextmanager
    def as_(self, name: str, **options: str) -> Iterator[None]:
        connected = self.client("connect", name, options)
        assert connected["refused"] is None, connected
        try:
            yield
        finally:
            self.client("close", name)

    def refused(self, **options: str) -> str:
        """By what the server has answered."""
        answer = self.client("connect", "refused", options)["refused"]
        assert answer is not None
        return answer

    def values(self, name: str, *paths: str) -> list[Any]:
        found = self.client("read", name, paths)
        assert {one["status"] for one in found.values()} == {"Good"}, found
        return [found[path]["value"] for path in paths]

    def until(self, name: str, path: str, value: Any) -> None:
        until(lambda: self.client("read", name, [path])[path], lambda found: found["value"] == value)

    def waiting(self, name: str, controller: Controller, for_s: float = 3600.0) -> list[Any]:
        """A proposal that waits, as `Decide` takes it: id, shown hash, revision."""
        self.until(name, "Line.Controller.Stage", "")  # what was deployed before has been kept
        proposal = self.line.propose(controller, "the web is another", for_s)
        self.line.until(proposal, "waiting", 120.0)
        path = f"Line.Proposals.{proposal}"
        self.until(name, f"{path}.Id", proposal)
        return self.values(name, *(f"{path}.{one}" for one in ("Id", "ShownHash", "BaseRevision")))

    def other(self) -> Controller:
        """Another than the one in service."""
        first = self.line.first
        return design_lqg(task_of(self.line.line)) if self.line.in_service() == config_hash(first) else first


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Panel]:
    folder = tmp_path_factory.mktemp("operator")
    with OperatorLine(folder, SPANS) as line:
        line.run()
        line.operate()
        arguments = line.endpoint, line.pki, folder / "client"
        with Spoken("operator_client.js", *arguments, log=folder / "client.log") as client:
            yield Panel(line, client)
        assert not any(line.children.log(name).read_text().count("Traceback") for name in ("operator", "gateway"))


@pytest.fixture
def panel(served: Panel) -> Panel:
    served.line.run_again()
    return served


def test_the_server_offers_two_policies_encrypted_and_no_anonymous_user(panel: Panel) -> None:
    found = panel.client("endpoints")
    assert sorted(one["policy"] for one in found) == sorted(POLICIES)
    assert all(one["mode"] == "SignAndEncrypt" and one["tokens"] == ["UserName"] for one in found)


@pytest.mark.parametrize("policy", POLICIES)
def test_it_finds_everything_of_the_line_by_browsing(panel: Panel, policy: str) -> None:
    with panel.as_("otto", policy=policy, **OTTO):
        found = panel.client("browse", "otto")
    kinds = {path: kind for path, (kind, _) in found.items()}
    assert {kinds[path] for path in (*MEASURED, *KEPT)} == {"Variable"}
    methods = {path for path, kind in kinds.items() if kind == "Method"}
    assert methods == {
        f"Line.{name}"
        for name in ("Decide", "Rollback", "Arm", "Start", "Hold", "Stop", "SetTension", "SetSpeed", "SelectRecipe",
                     "AcknowledgeAlarm", "ShelveAlarm", "Archive", "LineChanged",
                     "Confirm")
    }  # fmt: skip
    assert all(node.endswith(f";s={path}") for path, (_, node) in found.items() if path in MEASURED)


@pytest.mark.parametrize(
    ("path", "code", "symbol", "low", "high"),
    [
        ("Line.Spans.2.Tension", b"NEW", "N", 2.0, 60.0),
        ("Line.Rollers.1.Torque", b"NU", "N·m", -60.0, 60.0),
        ("Line.Rollers.1.Speed", b"MTS", "m/s", 0.0, 0.12),
        ("Line.Rollers.1.Radius", b"MTR", "m", 0.0, 1.0),
        ("Line.Controller.LatenessP99", b"SEC", "s", 0.0, 0.1),
    ],
)
def test_units_have_the_codes_of_the_unece_and_ranges_are_the_lines(
    panel: Panel, path: str, code: bytes, symbol: str, low: float, high: float
) -> None:
    with panel.as_("otto", **OTTO):
        found = panel.client("analog", "otto", path)
    assert found["unit"] == int.from_bytes(code, "big") and found["symbol"] == symbol
    assert found["of"] == "http://www.opcfoundation.org/UA/units/un/cefact"
    assert (found["low"], found["high"]) == (low, high)


def test_fifty_variables_are_told_and_those_that_are_measured_go_on_being_told(panel: Panel) -> None:
    paths = [*MEASURED, *KEPT]
    assert len(paths) >= 50
    with panel.as_("vera", **VERA):
        assert panel.client("watch", "vera", paths) == {"refused": []}

        def told(found: Any) -> bool:
            return len(found) == len(paths) and all(found[path]["changes"] >= 5 for path in MEASURED)

        seen = until(lambda: panel.client("seen", "vera"), told)
    assert {one["last"]["status"] for one in seen.values()} == {"Good"}
    for path in MEASURED:
        assert seen[path]["first"]["at"] < seen[path]["last"]["at"], path
    tension_n = [seen[f"Line.Spans.{k}.Tension"]["last"]["value"] for k in range(1, SPANS + 1)]
    setpoint_n = [seen[f"Line.Spans.{k}.Setpoint"]["last"]["value"] for k in range(1, SPANS + 1)]
    assert all(abs(tension - setpoint) < 3.0 for tension, setpoint in zip(tension_n, setpoint_n, strict=True))


@pytest.mark.parametrize("policy", POLICIES)
def test_a_proposal_is_announced_approved_once_and_deployed(panel: Panel, policy: str) -> None:
    line, controller = panel.line, panel.other()
    with panel.as_("otto", policy=policy, **OTTO):
        panel.client("watch", "otto", ["Line.Controller.InService"])
        (before,) = panel.values("otto", "Line.Controller.Revision")
        shown = panel.waiting("otto", controller)
        proposal, shown_hash, revision = shown
        events = until(lambda: panel.client("events", "otto"), lambda found: _of(found, "ProposalWaitingEventType"))
        (event,) = _of(events, "ProposalWaitingEventType")
        assert (event["ProposalId"], event["ShownHash"], event["BaseRevision"]) == (proposal, shown_hash, revision)
        path = f"Line.Proposals.{proposal}"
        difference, rules, passed, reason = panel.values(
            "otto", *(f"{path}.{name}" for name in ("Difference", "Rule", "RulePassed", "Reason"))
        )
        assert difference and len(rules) > 5 and all(passed) and reason == "\u201cthe web is another\u201d"
        first = panel.client("call", "otto", "Decide", *shown, True, "as discussed")
        assert first["status"] == "Good" and first["ok"], first
        panel.until("otto", "Line.Controller.InService", config_hash(controller))
        (after,) = panel.values("otto", "Line.Controller.Revision")
        assert after == before + 1 == revision + 1
        with line.unchanged("refused-decision"):
            second = panel.client("call", "otto", "Decide", *shown, True, "once more")
        assert second["status"] == "Good" and not second["ok"] and proposal[:12] in second["sentence"], second
        told = until(lambda: panel.client("events", "otto"), lambda found: {"approved", "deployed"} <= _kinds(found))
        (approved,) = [one for one in _of(told, "AuditRecordEventType") if one["Kind"] == "approved"]
        assert "otto" in approved["Who"]
    runs = line.configuration()
    assert (runs.hash, runs.epoch) == (config_hash(controller), after)
    records = [one for one in line.records() if one.what.get("proposal") == proposal]
    assert [one.kind for one in records if one.kind in ("approved", "deployed")] == ["approved", "deployed"]
    (approval,) = [one for one in records if one.kind == "approved"]
    assert "otto" in approval.who.name and approval.who.certificate == line.fingerprint(PANEL)
    assert approval.what["shown"] == shown_hash and approval.what["comment"] == "as discussed"


def test_a_proposal_is_a_dialog_that_is_answered_once(panel: Panel) -> None:
    line, controller = panel.line, panel.other()
    with panel.as_("otto", **OTTO):
        proposal, shown_hash, _ = panel.waiting("otto", controller)
        found = until(
            lambda: panel.client("conditions", "otto"), lambda found: any(one["Retain"] for one in found.values())
        )
        ((dialog, told),) = [(name, one) for name, one in found.items() if one["Retain"]]
        assert proposal in dialog and shown_hash in dialog and told["DialogState.Id"] is True
        assert told["EventType"] == "ns=0;i=2830" and told["ResponseOptionSet"] == ["approve", "reject"]
        assert all(row in told["Prompt"] for row in panel.values("otto", f"Line.Proposals.{proposal}.Difference")[0])
        assert panel.client("respond", "otto", dialog, 2) == "BadDialogResponseInvalid"
        assert panel.client("respond", "otto", dialog, 0) == "Good"
        panel.until("otto", "Line.Controller.InService", config_hash(controller))
        ended = until(lambda: panel.client("conditions", "otto")[dialog], lambda one: not one["Retain"])
        assert ended["DialogState.Id"] is False
        with line.unchanged():
            assert panel.client("respond", "otto", dialog, 0) == "BadNodeIdInvalid"
    (approval,) = [one for one in line.records() if one.kind == "approved" and one.what.get("proposal") == proposal]
    assert "otto" in approval.who.name and approval.who.certificate == line.fingerprint(PANEL)
    assert approval.what["shown"] == shown_hash


def test_a_recipe_is_selected_and_the_set_points_go_there(panel: Panel) -> None:
    setpoints = [f"Line.Spans.{k}.Setpoint" for k in range(1, SPANS + 1)]
    recipes = {one.name: list(one.tension_n) for one in panel.line.line.recipes}
    with panel.as_("otto", **OTTO):
        first, second = panel.values("otto", "Line.Operation.Recipes")[0]
        for name in (second, first):
            answer = panel.client("call", "otto", "SelectRecipe", name)
            assert answer["status"] == "Good" and answer["ok"], answer
            until(lambda: panel.values("otto", *setpoints), lambda found, name=name: found == recipes[name])
        panel.until("otto", "Line.Operation.Stands", True)
        with panel.line.unchanged("operated"):
            wrong = panel.client("call", "otto", "SelectRecipe", f"{first}s")
        assert wrong["status"] == "Good" and not wrong["ok"] and first in wrong["sentence"]


@pytest.mark.parametrize("policy", POLICIES)
def test_the_past_of_a_tension_is_read(panel: Panel, policy: str) -> None:
    runs_since = datetime.now(UTC).isoformat(timespec="milliseconds")  # before it, the web may have hung slack

    def told() -> list[Any]:
        found = panel.client("history", "vera", "Line.Spans.1.Tension", 10)
        assert found["status"] in ("Good", "GoodNoData") and len(found["values"]) <= 200
        at = [one["at"] for one in found["values"]]
        assert at == sorted(at)
        return [one for one in found["values"] if one["at"] > runs_since]

    with panel.as_("vera", policy=policy, **VERA):
        values = until(told, lambda values: len(values) > 10)
    assert all(one["type"] == "Double" and 2.0 < one["value"] < 60.0 for one in values), values


def test_a_viewer_looks_and_changes_nothing_and_the_audit_knows_that_it_was_tried(panel: Panel) -> None:
    with panel.as_("otto", **OTTO), panel.as_("vera", **VERA):
        shown = panel.waiting("otto", panel.other())
        with panel.line.unchanged("refused-person", "refused-person"):
            for method, arguments in (("Decide", [*shown, True, ""]), ("Stop", [])):
                answer = panel.client("call", "vera", method, *arguments)
                assert answer == {"status": "BadUserAccessDenied", "ok": None, "sentence": None}
        records = panel.line.records()[-2:]
        assert [one.what["command"] for one in records] == ["decide", "stop"]
        assert all("vera" in one.who.name and one.who.certificate == panel.line.fingerprint(PANEL) for one in records)
        assert panel.client("write", "vera", "Line.Spans.1.Setpoint", 3.0) == "BadUserAccessDenied"
        assert panel.client("write", "otto", "Line.Spans.1.Setpoint", 3.0) == "BadUserAccessDenied"
        assert panel.client("call", "otto", "Decide", *shown, False, "enough")["ok"]


def test_what_was_not_shown_is_not_decided_on(panel: Panel) -> None:
    with panel.as_("otto", **OTTO):
        shown = panel.waiting("otto", panel.other())
        proposal, shown_hash, revision = shown
        for wrong, recorded in (
            ([proposal, shown_hash[::-1], revision], ["refused-decision"]),
            ([proposal, proposal, revision], ["refused-decision"]),
            ([proposal, "", revision], []),  # what is none is not even sent
            ([proposal, shown_hash, revision + 1], ["refused-decision"]),
            ([shown_hash, shown_hash, revision], ["refused-decision"]),
        ):
            with panel.line.unchanged(*recorded):
                answer = panel.client("call", "otto", "Decide", *wrong, True, "")
            assert answer["status"] == "Good" and not answer["ok"] and answer["sentence"], (wrong, answer)
        assert panel.values("otto", f"Line.Proposals.{proposal}.Stage") == ["waiting"]
        assert panel.client("call", "otto", "Decide", *shown, False, "not now")["ok"]
        with panel.line.unchanged("refused-decision"):  # a rejection is a decision, too
            assert not panel.client("call", "otto", "Decide", *shown, True, "or now")["ok"]


def test_what_has_expired_is_not_approved(panel: Panel) -> None:
    with panel.as_("otto", **OTTO):
        began_s = time.monotonic()
        earlier = panel.waiting("otto", panel.other())  # what a first verdict compiles is there from then on
        for_s = 10.0 + 3.0 * (time.monotonic() - began_s)
        assert panel.client("call", "otto", "Decide", *earlier, False, "not this one")["ok"]
        shown = panel.waiting("otto", panel.other(), for_s)
        path = f"Line.Proposals.{shown[0]}.Stage"
        until(lambda: panel.client("read", "otto", [path])[path], lambda found: found["status"] != "Good", 60.0 + for_s)
        panel.line.look_on(lambda: panel.line.shown(shown[0]).stage, lambda stage: stage == "expired")
        with panel.line.unchanged("refused-decision"):
            answer = panel.client("call", "otto", "Decide", *shown, True, "too late")
        assert answer["status"] == "Good" and not answer["ok"] and "expired" in answer["sentence"], answer
    refusal = next(one for one in reversed(panel.line.records()) if one.kind == "refused-decision")
    assert refusal.what["proposal"] == shown[0] and "expired" in refusal.what["because"]
    assert "otto" in refusal.who.name and refusal.who.certificate == panel.line.fingerprint(PANEL)


@pytest.mark.parametrize(
    ("options", "answer"),
    [
        ({}, "BadIdentityTokenRejected"),
        (OTTO | {"password": "three new rollers"}, "BadUserAccessDenied"),
        (OTTO | {"user": "olga"}, "BadUserAccessDenied"),
        (OTTO | {"policy": "None", "mode": "None"}, "BadSecurityModeRejected"),
        (OTTO | {"mode": "Sign"}, "disconnected by third party"),
        (OTTO | {"policy": "Basic256"}, "disconnected by third party"),
        (OTTO | {"uri": "urn:somebody:else"}, "BadCertificateUriInvalid"),
    ],
    ids=[
        "anonymously",
        "wrong-password",
        "unknown-name",
        "without-encryption",
        "signed-only",
        "old-policy",
        "wrong-uri",
    ],
)
def test_nobody_comes_in(panel: Panel, options: dict[str, str], answer: str) -> None:
    with panel.line.unchanged():
        assert answer in panel.refused(**options)
    with panel.as_("otto", **OTTO):  # and who may, does afterwards
        assert panel.values("otto", "Line.Operation.State") == ["RUN"]


def test_a_stranger_is_turned_away_and_their_certificate_kept_to_be_looked_at(panel: Panel) -> None:
    line = panel.line
    line.make_stranger()
    with line.unchanged():
        assert "disconnected by third party" in panel.refused(certificate=f"opcua-client-{STRANGER}", **OTTO)
    fingerprint = line.fingerprint(STRANGER)
    log = line.children.log("operator")
    until(log.read_text, lambda text: f"r2rgate pki trust {line.pki / REJECTED}" in text)
    assert [path.name for path in (line.pki / REJECTED).iterdir()] == [f"{fingerprint[:32]}.der"]


def _of(events: list[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    return [one for one in events if one["EventType"] == kind]


def _kinds(events: list[dict[str, Any]]) -> set[str]:
    return {one["Kind"] for one in _of(events, "AuditRecordEventType")}
