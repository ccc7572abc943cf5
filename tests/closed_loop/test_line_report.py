"""`r2rgate report` of a line that a real chain has changed, in stepped time: its page against what the stores hold.

The page is read by a parser of its own, and by what decodes its numbers; the command runs as a process.
"""

import asyncio
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gateway.cli.commission import commission
from gateway.cli.commission_stepped import BEGIN, SteppedGate, impatient
from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.audit_record import Who
from gateway.core.controller import config_hash
from gateway.core.interactions import pack
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.messages import Event
from gateway.core.proposal import GainsChange
from gateway.core.verdict import Verdict
from gateway.mailbox.paths import GATEWAY_DATA
from gateway.operator.page.told import used
from gateway.supervisor.audit import Audit
from gateway.supervisor.audit_file import FILE_NAME as AUDIT
from gateway.supervisor.audit_file import AuditFile
from gateway.supervisor.baselines import FILE_NAME as BASELINES
from gateway.supervisor.baselines import Measured, MeasuredRun, begin_baselines
from gateway.supervisor.configurations import FILE_NAME as CONFIGURATIONS
from gateway.supervisor.configurations import Origin, begin_configurations
from gateway.supervisor.historian import FILE_NAME as HISTORY
from gateway.supervisor.interactions import Interactions
from sim_plant.drawn import random_plant
from tests.unit.test_demo_asked import interaction
from tests.unit.test_historian import writer_of
from tests.unit.test_report import Page, decoded

pytestmark = [pytest.mark.timeout(300)]  # seconds of stepped time, and whatever is compiled at its first use

SPANS, SEED = 3, 71_000
TEXT = line_template(SPANS, "line.toml")
LINE = impatient(load_line(TEXT, "line.toml"))


class Interrupted(BaseException):
    """The rest of the chain takes a minute, and tells nothing more."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A line's folder, with its file beside the data: a first configuration that was kept, an experiment that waits."""
    folder = tmp_path_factory.mktemp("line")
    (folder / "line.toml").write_text(TEXT)
    data = folder / "data" / GATEWAY_DATA
    data.mkdir(parents=True)
    loop = SteppedLoop(LINE, design_lqi(task_of(LINE)), random_plant(SEED, SPANS), SEED)
    loop.begin_in_production(np.array(LINE.recipes[0].tension_n), LINE.recipes[0].speed_m_per_s)
    approvals = 0

    def approves(shown: object) -> bool:
        nonlocal approvals
        approvals += 1
        if approvals == 2:
            raise Interrupted
        return True

    async def chain() -> None:
        async with SteppedGate(loop, data, SEED, approves) as side:
            await commission(LINE, side)

    with pytest.raises(Interrupted):
        asyncio.run(chain())
    writer = writer_of(data / HISTORY, wall_ahead_s=BEGIN.timestamp(), spans=SPANS)
    alarm = Event(time_s=1.0, kind="alarm", text="load-cell: a load cell cannot be trusted: span 2 <b>", data={})
    writer.store(loop.frames, [alarm], BEGIN.timestamp())
    writer.disconnect()
    one = interaction(1, "adaptation", option="pid-calm", reason="Span 3 swings.")
    Interactions(data).keep(pack(one), one)
    run = MeasuredRun(
        LINE.site, LINE.line, kept(data)[-1], None, "measurement", BEGIN.timestamp() + 60.0,
        Measured(1.234, 7.5, float("inf"), 4321.0), {},
    )  # fmt: skip
    with begin_baselines(data / BASELINES) as database:
        database.set_baseline(database.add(run).number, BEGIN.timestamp() + 61.0, "rules", "a test")
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    """A copy, to be spoiled."""
    shutil.copytree(made, tmp_path / "line", ignore=shutil.ignore_patterns("report.html"))
    return tmp_path / "line"


def records(data: Path) -> list[dict]:
    """As they lie there."""
    with AuditFile(data) as file:
        return [json.loads(row.content) for row in file.rows()]


def kept(data: Path) -> list[str]:
    """Hashes of configurations, in the order in which they were kept."""
    proposed = {one["what"]["proposal"]: one["what"] for one in records(data) if one["kind"] == "proposed"}
    return [proposed[one["what"]["proposal"]]["changes"] for one in records(data) if one["kind"] == "kept"]


def report(folder: Path, *words: str) -> tuple[int, str, str]:
    """Exit code, what was said, and the page."""
    out = folder / "report.html"
    arguments = ["report", "--line", str(folder / "line.toml"), "--data-dir", str(folder / "data"), "--out", str(out)]
    done = subprocess.run(
        [sys.executable, "-m", "gateway.cli", *arguments, *words], capture_output=True, text=True, timeout=280,
        check=False,
    )  # fmt: skip
    return done.returncode, done.stdout + done.stderr, out.read_text() if out.exists() else ""


@pytest.fixture(scope="module")
def reported(made: Path) -> tuple[str, str]:
    """What was said, and the page."""
    code, said, text = report(made)
    assert code == 0, said
    return said, text


def test_it_is_one_page_that_asks_nothing_of_any_network(reported: tuple[str, str]) -> None:
    said, text = reported
    page = Page(text)
    assert page.open == []
    assert not {"link", "img", "iframe", "object", "base", "form"} & {tag for tag, _ in page.elements}
    assert [script for script in page.all("script") if "src" in script] == []
    assert all(call not in text for call in ("fetch(", "XMLHttpRequest", "@import", "url("))
    assert "simulating Initial, " in said and "audit sound" in said


def test_every_proposal_stands_there_with_who_decided_over_what_and_what_it_came_to(
    made: Path, reported: tuple[str, str]
) -> None:
    words = " ".join(Page(reported[1]).words.split())
    stored = records(made / "data" / GATEWAY_DATA)
    by_kind = {kind: [one for one in stored if one["kind"] == kind] for kind in {one["kind"] for one in stored}}
    assert len(by_kind["kept"]) == 1 and len(by_kind["proposed"]) >= 2
    for one in by_kind["proposed"]:
        assert one["what"]["proposal"][:12] in words
    (approved,) = by_kind["approved"]
    short = approved["what"]["proposal"][:12]
    assert f"engineer approves proposal {short}, over what was shown as {approved['what']['shown'][:12]}" in words
    (deployed,) = by_kind["deployed"]
    on_probation_s = by_kind["kept"][0]["wall_s"] - deployed["wall_s"]
    assert f"proposal {short} is kept, after {on_probation_s:.1f} s on probation" in words
    assert f"First: controller {short}, kept" in words and "Experiment" in words and ", waiting" in words
    assert f"{len(by_kind['proposed'])} changes of how the line is controlled were proposed" in words


def test_every_rule_and_margin_stands_there_as_the_stored_verdict_has_it(made: Path, reported: tuple[str, str]) -> None:
    verdicts = [
        Verdict.model_validate_json(content)
        for one in records(made / "data" / GATEWAY_DATA)
        if "verdict" in one["blobs"]
        and (content := blob(made / "data" / GATEWAY_DATA, one["blobs"]["verdict"])) is not None
    ]
    page = Page(reported[1])
    told = page.data["verdicts"]
    assert len(told) == len(verdicts) >= 2
    for one, verdict in zip(told, verdicts, strict=True):
        assert [(each["rule"], each["value"], each["limit"], each["margin"], each["passed"], each["used"])
                for each in one["findings"]] == [
            (each.rule, each.value, each.limit, each.margin, each.passed, used(each)) for each in verdict.findings
        ]  # fmt: skip
        assert all(" ".join(each.text.split()) in page.words for each in verdict.findings)
    assert len([places for places in page.all("div") if places.get("data-part") == "findings"]) == len(told)


def blob(data: Path, id_: str) -> bytes | None:
    with AuditFile(data) as file:
        return file.blob(id_)


def test_configurations_are_shown_in_the_same_cases_each_with_its_course_and_rmse(
    made: Path, reported: tuple[str, str]
) -> None:
    """The RMSE that the page says is that of the course that it draws."""
    text = reported[1]
    page = Page(text)
    sections = page.data["sections"]
    drawn = [one for one in sections if len(one["charts"]) == 2 * SPANS]
    assert len(drawn) == 2  # steps of tension and of speed: with three spans it cannot run those of the paper
    stated = iter(stated_rmse_n(page))
    for section in drawn:
        tension = [decoded(chart["values"]) for chart in section["charts"][:SPANS]]
        for k in range(3):
            squared = sum(np.square(rows[k] - rows[-1]) for rows in tension)
            rmse_n = float(np.sqrt(np.mean(squared)))
            assert rmse_n == pytest.approx(next(stated), rel=1e-4)
    with AuditFile(made / "data" / GATEWAY_DATA) as file:
        payload = next(
            file.blob(one["what"]["proposal"]) for one in records(made / "data" / GATEWAY_DATA) if one["kind"] == "kept"
        )
    change = GainsChange.model_validate(json.loads(payload or b"")["change"])
    assert config_hash(change.controller) == kept(made / "data" / GATEWAY_DATA)[-1]
    assert "the nominal model of the line's file: no model is accepted" in page.words
    assert "it was judged up to" in page.words  # a first configuration is let through for small steps only


def stated_rmse_n(page: Page) -> list[float]:
    """Behind each configuration's name and law: three in each of two cases."""
    found = re.findall(r"(Initial|First|MPC baseline) (?:LQI|MPC) (\d+\.\d+)", page.words)
    assert [name for name, _ in found] == 2 * ["Initial", "First", "MPC baseline"]
    return [float(value) for _, value in found]


def test_what_was_measured_stands_apart_and_is_marked(made: Path, reported: tuple[str, str]) -> None:
    page = Page(reported[1])
    assert "First measurement 1.234 7.5 never 4321 the baseline" in page.words
    (around,) = [one for one in page.data["sections"] if len(one["charts"]) == 1]
    (chart,) = around["charts"]
    tension = decoded(chart["values"])
    time_s = decoded(around["groups"][chart["group"]])
    assert tension.shape[0] == SPANS and (np.diff(time_s) > 0.0).all() and time_s.min() < 0.0 < time_s.max()
    setpoint = np.array(LINE.recipes[0].tension_n)
    assert np.abs(np.nanmedian(tension, axis=1) - setpoint).max() < 2.0
    assert "Measured: First takes over at 0 s" in page.words


def test_alarms_questions_and_the_state_of_the_audit_stand_there(made: Path, reported: tuple[str, str]) -> None:
    words = Page(reported[1]).words
    assert "load-cell: a load cell cannot be trusted: span 2 <b>" in words
    assert "Span 3 swings." in words and "pid-calm" in words
    last = records(made / "data" / GATEWAY_DATA)[-1]
    with AuditFile(made / "data" / GATEWAY_DATA) as file:
        head = [row.head for row in file.rows()][-1]
    assert head in words and f"The audit is sound: {last['sequence']} records." in words


def test_an_audit_that_was_tampered_with_is_told_first_and_the_rest_all_the_same(folder: Path) -> None:
    path = folder / "data" / GATEWAY_DATA / AUDIT
    content = path.read_bytes()
    assert b'"by":"person"' in content
    path.write_bytes(content.replace(b'"by":"person"', b'"by":"parson"'))
    code, said, text = report(folder)
    assert code == 1 and "NOT SOUND" in said
    words = Page(text).words
    told = words[words.index("How this was made") : words.index("As its file and the records")]
    assert "The audit is NOT SOUND" in told and "is damaged" in told
    assert "record 7, deploying, does not follow from those before" in told  # the approval before it is damaged
    assert "First: controller" in words and "First measurement 1.234 7.5 never" in words
    assert "approves proposal" not in words
    assert len(Page(text).data["verdicts"]) >= 2


def test_an_audit_that_is_no_database_any_more_leaves_what_else_there_is(folder: Path) -> None:
    (folder / "data" / GATEWAY_DATA / AUDIT).write_bytes(b"no database" * 1000)
    code, said, text = report(folder)
    assert code == 1 and "NOT SOUND" in said
    words = Page(text).words
    assert "NOT SOUND" in words and "cannot be trusted: span 2" in words and "measurement 1.234 7.5" in words


def test_it_is_read_beside_what_writes_it_and_left_as_it_was(folder: Path) -> None:
    data = folder / "data" / GATEWAY_DATA
    writing = Audit(data)
    writing.start()
    writer = writer_of(data / HISTORY, wall_ahead_s=BEGIN.timestamp(), spans=SPANS)
    writer.store([], [Event(time_s=2.0, kind="alarm", text="cycles-late: just now", data={})], BEGIN.timestamp())
    try:
        before = stores(data)
        code, said, text = report(folder)
        assert stores(data) == before
        audit = writing.append_and_wait("gateway-start", Who(name="gateway"), {"version": "1"})
        writer.store([], [Event(time_s=3.0, kind="alarm", text="still written", data={})], BEGIN.timestamp())
    finally:
        writer.disconnect()
        assert writing.close()
    assert code == 0, said
    assert "cycles-late: just now" in Page(text).words and audit is not None


def stores(data: Path) -> dict[str, bytes]:
    """Without the history: whoever opens its file here lets go of the locks of whoever writes it here."""
    return {one.name: one.read_bytes() for one in data.iterdir() if one.is_file() and not one.name.startswith(HISTORY)}


def test_a_line_on_which_nothing_was_ever_proposed_shows_what_controls_it(tmp_path: Path) -> None:
    (tmp_path / "line.toml").write_text(TEXT)
    data = tmp_path / "data" / GATEWAY_DATA
    data.mkdir(parents=True)
    controller = design_lqi(task_of(LINE))
    hash_ = config_hash(controller)
    with begin_configurations(data / CONFIGURATIONS) as storage:
        storage.store(LINE.site, LINE.line, controller, Origin(1.0, "loop", "the line was started with it"))
    found = {"configuration": hash_, "last_known_good": hash_, "epoch": 0, "because": "start", "explained": True}
    audit = Audit(data)
    audit.start()
    audit.append_and_wait("found-in-service", Who(name="gateway"), found)
    assert audit.close()
    code, said, text = report(tmp_path)
    assert code == 0, said
    words = Page(text).words
    assert "Nothing has been proposed on this line: how it is controlled has not changed." in words
    assert f"Initial {hash_[:12]}, epoch 0, unconfirmed" in words and "Initial LQI" in words
    assert f"Unconfirmed: {hash_[:12]} controls the line as a first configuration" in words
    assert "Caution: of alarms, and of tensions around deployments, nothing is told: there is no history at" in words


def test_a_time_without_a_change_says_so_and_shows_what_is_in_service(folder: Path) -> None:
    code, said, text = report(folder, "--since", "1s")
    assert code == 0, said
    page = Page(text)
    assert "Nothing has been proposed on this line since" in page.words and "how it is controlled has not" in page.words
    assert "MPC baseline MPC" in page.words and "First LQI" in page.words and "Initial LQI" not in page.words
    assert "verdicts" not in page.data and "There were none in this time" in page.words


@pytest.mark.parametrize(
    ("spoil", "words", "said"),
    [
        (lambda folder: shutil.rmtree(folder / "data"), (), "there is no folder"),
        (lambda folder: (folder / "data" / GATEWAY_DATA / AUDIT).unlink(), (), "there is no audit in"),
        (lambda folder: None, ("--since", "yesterday"), "allowed is a date and time such as"),
        (lambda folder: None, ("--out", "/nowhere/report.html"), "--out /nowhere/report.html cannot be written"),
        (lambda folder: other(folder / "line.toml"), (), "has the records of demo/line-1"),
    ],
)
def test_refusals_say_what_is_wrong_and_leave_no_page(folder: Path, spoil, words: tuple[str, ...], said: str) -> None:
    spoil(folder)
    code, answered, text = report(folder, *words)
    assert code == 2 and said in answered and not text, answered


def other(file: Path) -> None:
    """Another line's file."""
    file.write_text(file.read_text().replace(f'line = "{LINE.line}"', 'line = "another"'))
