"""What the audit has on proposals, read from a folder and told: every end there is, and what is lost."""

from pathlib import Path
from typing import Any

import pytest

from gateway.cli.line_records import LineRecords, read_records, unconfirmed_in, verdicts_in
from gateway.cli.report import Story
from gateway.cli.report_adaptations import adaptations_section, changes_of, named_of, proposals_section, started_with
from gateway.core.audit_record import Who, head_of
from gateway.core.controller import config_hash
from gateway.core.judge_context import JudgeContext, LineState
from gateway.core.judge_context import canonical as canonical_context
from gateway.core.proposal import Evidence, GainsChange, Promise, Proposal, canonical, proposal_hash
from gateway.core.verdict import RuleFinding, Verdict
from gateway.core.verdict import canonical as canonical_verdict
from gateway.supervisor.audit import Audit
from gateway.supervisor.audit_file import FILE_NAME, AuditFile
from tests.unit.deployer_support import FIRST, LINE, controller, proposal

ANNA = Who(name="anna (operator, page)", uid=1000, pid=7, certificate="ab" * 32)
BERT = Who(name="bert (engineer, OPC UA)", uid=1000, pid=7)
GATEWAY = Who(name="gateway")
BASE = config_hash(FIRST)
AT_S = 1.8e9


class Recording:
    """An audit that is written step by step, half a second each."""

    def __init__(self, folder: Path) -> None:
        self.now_s = AT_S
        self.audit = Audit(folder, wall_clock=lambda: self.now_s)
        self.audit.start()
        self.append("found-in-service", GATEWAY, {"configuration": BASE, "last_known_good": BASE, "epoch": 0})

    def append(self, kind: str, who: Who, what: dict[str, Any], **blobs: bytes) -> None:
        self.now_s += 0.5
        self.audit.append_and_wait(kind, who, {"at_s": self.now_s, **what}, blobs)

    def proposed(self, one: Proposal) -> str:
        hash_ = proposal_hash(one)
        assert isinstance(one.change, GainsChange)
        what = {
            "proposal": hash_, "change": "gains", "author": one.author, "base": one.base, "created": one.created,
            "changes": config_hash(one.change.controller), "expires": one.expires, "expires_s": AT_S + 600.0,
        }  # fmt: skip
        self.append("proposed", BERT, what, proposal=canonical(one))
        return hash_

    def judged(self, hash_: str, accepted: bool = True, **more: bytes) -> None:
        state = LineState(state="RUN", tension_n=[30.0] * LINE.n, speed_m_per_s=0.02)
        context = JudgeContext(format=1, now="2027-01-15T08:00:00+00:00", state=state, in_service=FIRST)
        finding = RuleFinding(rule="delay margin", passed=accepted, text="the loop stands less", value=0.003,
                              limit=0.004, margin=-0.001, unit="s")  # fmt: skip
        verdict = Verdict(
            format=1, proposal=hash_, payload=hash_, context="0" * 64, line="0" * 64, kind="gains", seed=1,
            accepted=accepted, findings=[finding], judged=context.now, program_version="0",
        )  # fmt: skip
        blobs = {"verdict": canonical_verdict(verdict), "context": canonical_context(context), **more}
        what = {"proposal": hash_, "verdict": head_of(blobs["verdict"]), "because": "" if accepted else "too little"}
        self.append("accepted" if accepted else "refused", GATEWAY, what, **blobs)

    def step(self, kind: str, hash_: str, who: Who = GATEWAY, **what: Any) -> None:
        self.append(kind, who, {"proposal": hash_, **what})

    def deployed(self, hash_: str, epoch: int = 1) -> None:
        self.step("approved", hash_, ANNA, shown="c" * 64, comment="calmer", by="person")
        self.step("deploying", hash_, ANNA, epoch=epoch, region={"speed_max_m_per_s": 0.05})
        self.step("deployed", hash_, epoch=epoch)

    def close(self) -> None:
        assert self.audit.close()


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    return Recording(tmp_path)


def stories(records: LineRecords) -> list[Story]:
    proposals, changes = records.proposals, changes_of(records.proposals, {})
    named = named_of(records, started_with(records))
    return list(adaptations_section(proposals, changes, [], named, {}).stories)


def said(story: Story, part: str) -> str:
    return "; ".join(text for name, texts in story.facts for text in texts if name == part)


def test_a_change_that_was_kept_is_told_from_its_reason_to_its_end(recording: Recording, tmp_path: Path) -> None:
    one = proposal(1, BASE, AT_S).model_copy(
        update={
            "reason": "Span 2 <swings>.",
            "evidence": [Evidence(what="innovation", value=1.02), Evidence(what="interaction 0123456789abcdef")],
            "predicted": [Promise(scenario="tension", rmse_n=2.5)],
        }
    )
    hash_ = recording.proposed(one)
    recording.judged(hash_)
    recording.deployed(hash_)
    recording.step("keeping", hash_, epoch=1)
    recording.now_s += 9.0
    recording.step("kept", hash_, epoch=1)
    recording.close()
    records = read_records(tmp_path)
    assert records.found.sound and not records.problems
    (story,) = stories(records)
    assert story.title == f"Adapt1: controller {hash_[:12]}, kept"
    assert story.quote == "Span 2 <swings>." and story.lead == "The reason that rules gave:"
    assert said(story, "Diagnosis") == "Rests on: innovation, 1.02"
    assert said(story, "Change").startswith("antiwindup is ")
    assert "promised for tension: RMSE 2.5 N" in said(story, "Change")
    assert "accepted by 1 rules" in said(story, "Verdict") and story.verdict is not None
    assert said(story, "Decision") == (
        f"2027-01-15 08:00:02: anna (operator, page) approves proposal {hash_[:12]}: “calmer”, certificate "
        f"abababababab, over what was shown as cccccccccccc"
    )
    assert "epoch 1, on probation" in said(story, "On the line")
    assert "judged for speed up to 0.05 m/s" in said(story, "On the line")
    assert said(story, "Result") == f"2027-01-15 08:00:13: proposal {hash_[:12]} is kept, after 10.0 s on probation"


def test_what_was_taken_back_says_why_and_has_no_name_of_its_own(recording: Recording, tmp_path: Path) -> None:
    hash_ = recording.proposed(proposal(1, BASE, AT_S))
    recording.judged(hash_)
    recording.deployed(hash_)
    recording.step("rolled-back", hash_, epoch=1, to=BASE, because="tension 2 strays by 9 N")
    recording.close()
    records = read_records(tmp_path)
    (story,) = stories(records)
    assert story.title == f"Controller {hash_[:12]}, rolled-back"
    assert "tension 2 strays by 9 N, after 0.5 s on probation" in said(story, "Result")
    assert [one.name for one in named_of(records, started_with(records))] == ["Initial"]
    assert records.book.in_service == BASE


@pytest.mark.parametrize(
    ("kind", "what", "decided_by", "told"),
    [
        ("rejected", {"comment": "not on Friday"}, "anna (operator, page)", "rejects proposal"),
        ("expired", {"because": "nobody decided"}, "-", "has expired: nobody decided"),
        ("superseded", {"because": "something else runs"}, "-", "is superseded: something else runs"),
        ("approved", {"by": "verdict", "like": "d" * 64}, "its verdict alone", "passes by its verdict alone"),
    ],
)
def test_every_way_to_decide_is_told(
    recording: Recording, tmp_path: Path, kind: str, what: dict[str, Any], decided_by: str, told: str
) -> None:
    hash_ = recording.proposed(proposal(1, BASE, AT_S))
    recording.judged(hash_)
    recording.step(kind, hash_, ANNA, **what)
    recording.close()
    records = read_records(tmp_path)
    assert told in said(stories(records)[0], "Decision")
    (row,) = proposals_section(records.proposals, changes_of(records.proposals, {})).tables[0].rows
    assert row[4] == decided_by and row[3] == "accepted by 1 rules"


def test_two_people_are_told_one_after_the_other(recording: Recording, tmp_path: Path) -> None:
    hash_ = recording.proposed(proposal(1, BASE, AT_S))
    recording.judged(hash_)
    recording.step("approved-once", hash_, ANNA, shown="c" * 64, name=ANNA.name, approver=["anna"], by="person")
    recording.step("approved", hash_, BERT, shown="c" * 64, first=ANNA.name, by="person")
    recording.close()
    decision = said(stories(read_records(tmp_path))[0], "Decision")
    assert decision.index("as the first of two") < decision.index("bert") < decision.index("as the second, after anna")


def test_configurations_are_named_in_the_order_in_which_they_were_kept(recording: Recording, tmp_path: Path) -> None:
    base = BASE
    for epoch, number in enumerate((1, 2, 1), 1):
        hash_ = recording.proposed(proposal(number, base, AT_S, nonce=epoch))
        recording.judged(hash_)
        recording.deployed(hash_, epoch)
        recording.step("keeping", hash_, epoch=epoch)
        recording.step("kept", hash_, epoch=epoch)
        base = config_hash(controller(number))
    recording.close()
    records = read_records(tmp_path)
    named = named_of(records, started_with(records))
    assert [(one.name, one.hash) for one in named] == [
        ("Initial", BASE), ("Adapt1", config_hash(controller(1))), ("Adapt2", config_hash(controller(2))),
    ]  # fmt: skip
    assert [story.title.partition(":")[0] for story in stories(records)] == ["Adapt1", "Adapt2", "Adapt1"]


def test_what_a_record_calls_not_done_was_not(recording: Recording, tmp_path: Path) -> None:
    hash_ = recording.proposed(proposal(1, BASE, AT_S))
    recording.judged(hash_)
    recording.step("rejected", hash_, ANNA, comment="")
    with AuditFile(tmp_path) as file:
        last = file.last()
    recording.append("not-done", GATEWAY, {"sequences": [last], "because": "interrupted"})
    recording.close()
    (one,) = read_records(tmp_path).proposals
    assert one.shown.stage == "waiting" and [step.kind for step in one.steps] == ["proposed", "accepted"]


def test_a_proposal_whose_content_is_lost_is_said_to_be_and_hides_no_other(
    recording: Recording, tmp_path: Path
) -> None:
    first, second = (recording.proposed(proposal(k, BASE, AT_S)) for k in (1, 2))
    recording.judged(second, accepted=False)
    recording.close()
    content = (tmp_path / FILE_NAME).read_bytes()
    (tmp_path / FILE_NAME).write_bytes(content.replace(canonical(proposal(1, BASE, AT_S))[:40], b"x" * 40, 1))
    records = read_records(tmp_path)
    lost = {one[:12] for one in (first, second)} - {one.hash[:12] for one in records.proposals}
    assert len(lost) == 1 and any(f"proposal {lost.pop()} cannot be told" in one for one in records.problems)
    assert not records.found.sound


def test_without_an_audit_there_is_nothing_but_that(tmp_path: Path) -> None:
    records = read_records(tmp_path)
    assert not records.found.sound and records.proposals == [] and verdicts_in(tmp_path) == {}
    assert list(tmp_path.iterdir()) == []


def test_who_answers_for_what_is_in_service_is_told_until_somebody_does(tmp_path: Path) -> None:
    recording = Recording(tmp_path)
    (said,) = unconfirmed_in(read_records(tmp_path).book)
    assert said.startswith("Unconfirmed: ") and BASE[:12] in said and "r2rgate confirm" in said
    recording.append("confirmed", ANNA, {"configuration": BASE, "because": "it holds"})
    assert unconfirmed_in(read_records(tmp_path).book) == []
    other = {"configuration": "5" * 64, "last_known_good": BASE, "epoch": 3, "explained": False, "confined": True}
    recording.append("found-in-service", GATEWAY, other)
    (said,) = unconfirmed_in(read_records(tmp_path).book)
    assert "no record says" in said
    assert recording.audit.close()
