"""The demonstration without its processes: its line, its side of the gate, its tables and its page."""

import asyncio
import json
import os
import signal
from dataclasses import replace
from datetime import UTC, datetime
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from gateway.cli import demo_line
from gateway.cli.demo import run_demo
from gateway.cli.demo_analysis import Evidence, summary_of
from gateway.cli.demo_cases import MOST_REPEATS, Window, again_after_stops
from gateway.cli.demo_chain import Measured, beyond, name_of
from gateway.cli.demo_chain_page import page
from gateway.cli.demo_chain_table import print_chain
from gateway.cli.demo_failed import DemoFailed
from gateway.cli.demo_line import Ports, Setup, line_text
from gateway.cli.demo_people import let_in
from gateway.cli.demo_result import DemoResult, paper_improvement_pct
from gateway.cli.demo_stay import told
from gateway.cli.lifetime import uninterrupted
from gateway.commissioning.past import Step, named
from gateway.control.design import design_lqi, task_of
from gateway.core.controller import config_hash
from gateway.core.deployment import Region
from gateway.core.line_file import load_line
from gateway.core.people import ROLES
from gateway.core.proposal import GainsChange
from gateway.core.scenario import PAPER
from gateway.mailbox.paths import OPERATOR_DATA
from gateway.operator.opcua.trust import TrustList, from_file
from gateway.operator.users import FILE_NAME, UsersFile
from sim_plant.judge import UNSAFE
from sim_plant.recording import Recording
from tests.unit.test_report import Page

PORTS = Ports(41000, 41001, 41002, 41003)
LINE = load_line(line_text(PORTS), "line.toml")
CONFIGS = [
    design_lqi(replace(task_of(LINE), unwind_speed_m_per_s=0.01 * k)).model_copy(update={"antiwindup": 0.1 * k})
    for k in (1, 2, 3)
]


def test_its_line_says_what_it_states_and_nothing_else_of_the_template_is_lost(monkeypatch):
    gate = LINE.gate
    assert (gate.first_speed_max_m_per_s, gate.first_step_max_n, gate.probation_s) == (0.1, 24.0, 10.0)
    assert {roller.friction_nms_per_rad.tolerance for roller in LINE.rollers} == {0.6}
    assert (gate.cool_down_s, gate.first_corner_share, gate.autonomy) == (30.0, 0.4, "approve-all")
    assert "port = 41000" in line_text(PORTS) and all(why in line_text(PORTS) for *_, why in demo_line.STATED)
    monkeypatch.setattr(demo_line, "STATED", (("# no such key = 1", "x = 1", "because"),))
    with pytest.raises(DemoFailed, match="no such key"):
        line_text(PORTS)


@pytest.mark.parametrize(
    ("region", "said"),
    [
        (Region(), ("", "")),
        (Region(speed_max_m_per_s=0.1, tension_step_max_n=24.0, speed_step_max_m_per_s=0.09), ("", "")),
        (Region(speed_max_m_per_s=0.0999), ("", "the speed is 0.1 m/s")),
        (Region(tension_step_max_n=23.9), ("the step of tension is 24 N", "")),
        (Region(speed_step_max_m_per_s=0.0899), ("", "the step of speed is 0.09 m/s")),
    ],
)
def test_a_case_runs_only_on_what_was_judged_for_it(region, said):
    for case, begins in zip(PAPER, said, strict=True):
        found = beyond(case, region)
        assert found.startswith(begins) and bool(found) == bool(begins)


class Side:
    """A gate with these proposals; `wait_for` and `ready` are noted."""

    def __init__(self, *shown):
        self.shown, self.done = list(shown), []

    async def proposals(self):
        return self.shown

    async def ready(self):
        self.done.append("ready")

    async def wait_for(self, proposal):
        self.done.append(f"waited for {proposal}")


def shown_as(hash_, stage, config=None, step=Step.REDESIGN):
    change = SimpleNamespace(kind="model") if config is None else GainsChange(controller=config)
    proposal = SimpleNamespace(change=change, kind=change.kind, evidence=[named(step, 0)], author="rules")
    return SimpleNamespace(proposal_hash=hash_, stage=stage, why="", proposal=proposal, verdict=None)


def test_each_redesign_that_is_kept_is_measured_once_and_before_the_chain_goes_on():
    side = Side(shown_as("a", "refused", CONFIGS[0]), shown_as("0", "kept", CONFIGS[0], Step.FIRST))

    async def measure(config, shown):
        side.done.append(f"measured {shown.proposal_hash}")

    async def decide(shown):
        side.done.append(f"decided {shown.proposal_hash}")

    async def run():
        measured = Measured(side, decide, measure, side.done.append)
        await measured.ready()
        side.shown += [shown_as("b", "kept", CONFIGS[1]), shown_as("c", "done"), shown_as("d", "kept")]
        await measured.ready()
        side.shown.append(shown_as("e", "waiting", CONFIGS[2]))
        await measured.wait_for("e")
        side.shown[-1].stage = "probation"
        await measured.wait_for("e")
        await measured.wait_for("e")
        side.shown += [shown_as("f", "kept", CONFIGS[1])]  # the same, judged for more
        await measured.measure_kept()

    asyncio.run(run())
    assert side.done == [
        "ready", "measured b", "ready", "decided e", "  it controls the line, on probation", "waited for e",
        "waited for e",
    ]  # fmt: skip


def example() -> DemoResult:
    """The published one, of the configurations here."""
    with open("docs/examples/demo-result.json", encoding="utf-8") as file:
        document = json.load(file)
    for one, config in zip(document["configurations"], CONFIGS, strict=True):
        brought = [change for change in document["chain"]["changes"] if change["configuration"] == one["controller"]]
        one["controller"] = config_hash(config)
        for change in brought:
            change["configuration"] = one["controller"]
    return DemoResult.model_validate_json(json.dumps(document))


class Stopping:
    """An operator of a line that stops by itself, or does not stop where something else is wrong."""

    def __init__(self, stops):
        self.stops, self.told, self.begun = stops, [], 0

    async def has_stopped(self):
        return self.stops

    async def recover(self, story, why):
        self.told.append((story, why))

    async def begin(self):
        self.begun += 1


@pytest.mark.parametrize(
    ("fails", "stops", "runs", "told"),
    [(0, True, 1, 0), (1, True, 2, 1), (MOST_REPEATS, True, 3, 2), (MOST_REPEATS + 1, True, 3, 2), (1, False, 1, 0)],
)
def test_what_a_stop_has_ended_is_done_again_so_often_and_what_is_wrong_otherwise_is_not(fails, stops, runs, told):
    operator, made = Stopping(stops), []

    async def do():
        made.append(len(made))
        if len(made) <= fails:
            raise DemoFailed("late")
        return "done"

    if fails <= MOST_REPEATS and (stops or not fails):
        assert asyncio.run(again_after_stops(operator, do, "the case once more")) == "done"
    else:
        with pytest.raises(DemoFailed, match="late"):
            asyncio.run(again_after_stops(operator, do, "the case once more"))
    assert (len(made), operator.begun) == (runs, told)
    assert operator.told == told * [("the case once more: late", "late")]


def test_improvements_are_from_one_configuration_to_the_next_here_and_in_the_paper():
    result = example()
    first, second = (result.rmse_n(k, "tension") for k in (0, 1))
    assert first is not None and second is not None
    assert result.improvement_pct(0, "tension") is None
    assert result.improvement_pct(1, "tension") == pytest.approx(100.0 * (first - second) / first)
    assert paper_improvement_pct("Adapt1", "tension") == pytest.approx(39.59, abs=0.01)
    assert paper_improvement_pct("Adapt2", "velocity") == pytest.approx(43.18, abs=0.01)
    assert paper_improvement_pct("Initial", "velocity") is None and paper_improvement_pct("Adapt3", "tension") is None
    assert [name_of(k) for k in range(3)] == ["Initial", "Adapt1", "Adapt2"]


def test_the_table_fits_a_terminal_and_says_who_approved():
    console = Console(width=80, record=True, file=StringIO())
    result = example()
    print_chain(result, console)
    text = console.export_text()
    assert result.chain is not None and result.chain.audit.head in text and "script-operator (operator, opc-ua)" in text
    table = text[: text.index("on truth:")]
    assert "…" not in table and "paper" in table and max(map(len, table.splitlines())) <= 80
    assert f"{result.rmse_n(1, 'velocity'):.3f}" in table and "-39.6%" in table


def test_the_page_holds_every_figure_and_a_case_that_was_not_run(tmp_path):
    """On 20 s of a line that stands, but for the set-points of the tension case, three times."""
    result, n, periods = example(), LINE.n, 6000
    time_s = np.arange(periods * 10) * 1e-3
    setpoint = np.tile(PAPER[0].tension_n, (periods, 1))
    windows = []
    for k, config in enumerate(CONFIGS):
        setpoint[2000 * k + 100 : 2000 * k + 1600] = PAPER[0].tension_end_n
        windows.append(Window(PAPER[0], config, 20.0 * k, 20.0 * k + 15.5))
    still = np.zeros((periods * 10, n))
    recording = Recording(n, time_s, np.repeat(setpoint, 10, axis=0), still, still, np.full(periods * 10, 0.01), [])
    history = {
        "time_s": np.arange(periods) * 1e-2,
        "tension_setpoint_n": setpoint,
        "speed_setpoint_m_per_s": np.full(periods, 0.01),
    }
    evidence = Evidence(recording, time_s, history, {"plant": "s-real"})
    shown = Page(page(Setup(tmp_path, LINE, CONFIGS[0], 1), result, windows, evidence, []))
    assert shown.open == []
    for one in result.configurations:
        assert all(
            f"{case.rmse_n:.4f}" in shown.words and f"{case.ratio_to_stepped:.3f}" in shown.words for case in one.cases
        )
    assert "It was not run." in shown.words and "script-operator (operator, opc-ua)" in shown.words
    chain = result.chain
    assert chain is not None and chain.audit.head in shown.words
    refused = [text for one in chain.changes for text in one.against]
    assert refused and all(text in shown.words for text in refused)
    read = [one.approved_over for one in chain.changes if one.approved_by]
    assert read and all(text and text in shown.words for text in read)
    assert all(" ".join(one.reason.split()) in shown.words for one in chain.asked)
    for title in ("Initial → Adapt1", "Adapt1 → Adapt2", "Selection, with its justification"):
        assert title in shown.words
    for k in (1, 2):
        assert f"to {result.rmse_n(k, 'tension'):.3f} N" in shown.words
    assert all(why in shown.words for *_, why in demo_line.STATED)


def test_who_stays_is_told_where_to_go_and_that_commands_take_other_folders_in_quotes(tmp_path):
    setup = Setup(tmp_path / "my line", LINE, CONFIGS[0], 1)
    text = "\n".join(told(setup, "amber-fern", "ab" * 32, "/tmp/r2rgate-x"))
    for wanted in (LINE.operator.page, LINE.operator.opc_ua, "amber-fern", "r2rgate approve abababababab", "Ctrl-C"):
        assert wanted in text
    assert f"--control '{tmp_path}/my line/recording'" in text and "--run-dir /tmp/r2rgate-x" in text
    assert "r2rgate approve" not in "\n".join(told(setup, "amber-fern", "", "/tmp/r2rgate-x"))


def test_a_folder_that_another_demonstration_uses_is_left_alone(tmp_path, capsys):
    (tmp_path / "data").mkdir()
    with demo_line.alone_in(tmp_path):
        assert run_demo(tmp_path, 1, "lqi") == 2
    assert (tmp_path / "data").is_dir() and "another demonstration uses" in capsys.readouterr().out


def test_what_is_ended_in_order_is_not_interrupted():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever runs the tests may have it ignored
    try:
        with uninterrupted():
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.slow
def test_who_is_let_in_has_a_certificate_that_is_trusted_and_a_password_that_is_a_good_one(tmp_path):
    alone, people = (let_in(LINE, tmp_path / name, people=name == "b") for name in ("a", "b"))
    users = [UsersFile(tmp_path / name / OPERATOR_DATA / FILE_NAME).current() for name in ("a", "b")]
    assert [one.name for one in users[0].entries()] == ["script-operator"] and alone.password == ""
    assert [users[1].check(role, people.password) for role in ROLES] == list(ROLES)
    script = people.script
    assert users[1].check(script.user, script.password) == "operator" and alone.script.password != script.password
    pki = tmp_path / "b" / OPERATOR_DATA / "pki"
    trusted = TrustList(pki, print, lambda: datetime.now(UTC))
    trusted.look()
    assert trusted.why_not(from_file(Path(script.certificate).read_bytes())) == ""


def test_what_the_simulated_line_has_seen_so_far_is_counted_as_at_its_end(tmp_path):
    setup = Setup(tmp_path, LINE, CONFIGS[0], 1)
    events = [{"kind": "recording", "plant": "s-real"}, *({"kind": "unsafe", "what": "tension-band"},) * 2]
    empty = np.empty((0, LINE.n))
    found = summary_of(setup, Recording(LINE.n, np.empty(0), empty, empty, empty, np.empty(0), events))
    assert found["plant"] == "s-real" and found["unsafe_events"]["tension-band"] == 2
    assert sum(found["unsafe_events"].values()) == 2 and len(found["unsafe_events"]) == len(UNSAFE)
