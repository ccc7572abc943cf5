"""The proof of the wiring in stepped time: drawn lines, wired wrong in every way, judged by the truth of the web."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.messages import Arm, Drill, KeepProof, Prove, Start, Stop
from gateway.core.states import LoopState, Phase
from gateway.core.wiring_proof import Answer
from gateway.loop.commands import proof_to_keep
from gateway.loop.proving import PROVED
from gateway.loop.refused import Refused
from sim_plant.faults.parse import parse_fault
from sim_plant.faults.stepped import injector_of
from sim_plant.plant import load_plant
from tests.bench.harm import one
from tests.bench.harm_lines import drawn
from tests.closed_loop.conftest import demo_line, real_plant

SEED = 41018  #: of a line with four spans
STIFF = 41016  #: of one whose web is so stiff that its encoders hardly tell a roller's way
SHARE = 0.25  #: of the greatest tension: 20 % and what overshoots
LONGEST_S = 900.0


class Proved:
    """A line whose wiring has been proved, with `faults` in it from the beginning."""

    def __init__(self, faults: Sequence[str] = (), loop: SteppedLoop | None = None, slack_m: float = 0.0) -> None:
        self.loop = loop or drawn_loop()
        self.most_share = self.fastest_m_per_s = 0.0
        for span in range(1, self.loop.line.n + 1) if slack_m else ():
            self.loop.truth.world.slacken_web(span, slack_m)
        self.loop.step(3)
        drill(self.loop)
        for fault in faults:
            injector_of(self.loop.truth).add(parse_fault(fault), self.loop.truth.world.now_s)
        reply = self.loop.arm()
        assert reply.ok, reply.reasons
        assert self.loop.step_until(Phase.READY, 1.0)

    def prove(self) -> "Proved":
        reply = self.loop.command(Prove())
        assert reply.ok, reply.reasons
        for _ in range(round(LONGEST_S / self.loop.line.control.period_s)):
            self.loop.step()
            self._look()
            if self.phase is Phase.OFF:
                return self
        raise AssertionError(f"still {self.phase.name}")

    def _look(self) -> None:
        world, limits = self.loop.truth.world, self.loop.line.limits
        self.most_share = max(self.most_share, float(world.tension_n.max()) / limits.tension_max_n)
        self.fastest_m_per_s = max(self.fastest_m_per_s, float(np.abs(world.surface_speed_m_per_s).max()))

    @property
    def phase(self) -> Phase:
        return self.loop.cycle.machine.phase

    @property
    def found(self) -> list[tuple[str, object]]:
        """Code and number (span or roller) of everything that ended it."""
        told = [finding for _, finding in self.loop.stopped_by]
        return [(each.rule, each.parameters.get("span", each.parameters.get("roller"))) for each in told]

    @property
    def outcome(self) -> dict[str, list[dict[str, object]]]:
        return next(event.data for event in self.loop.events if event.kind == "proved")


def drill(loop: SteppedLoop) -> None:
    """Of the watchdogs, before any torque."""
    reply = loop.arm(Drill())
    assert reply.ok, reply.reasons
    assert loop.step_until(Phase.OFF, 10.0) and loop.cycle.drill.watchdogs


def drawn_loop(seed: int = SEED) -> SteppedLoop:
    found = drawn(seed)
    return SteppedLoop(found.line, design_lqi(task_of(found.line)), found.plant, seed)


@pytest.mark.parametrize(("seed", "asks"), [(41003, {"speed-sign-unseen"}), (SEED, set())])
def test_a_line_that_is_wired_right_gives_no_finding(seed: int, asks: set[str]) -> None:
    """The way of 41003's first roller, 4 mm in 8 s, lies at what its encoder's noise may show."""
    proved = Proved(loop=drawn_loop(seed)).prove()
    assert proved.found == [] and proved.loop.cycle.machine.reason == PROVED
    assert proved.most_share <= SHARE
    outcome, n = proved.outcome, proved.loop.line.n
    assert [drive["roller"] for drive in outcome["drives"]] == list(range(1, n + 1))
    assert [cell["span"] for cell in outcome["cells"]] == list(range(1, n + 1))
    assert all(0.6 <= float(str(cell["factor"])) <= 1.6 for cell in outcome["cells"])
    assert all(min(cell["answered_to"]) == cell["span"] for cell in outcome["cells"])  # type: ignore[call-overload]
    assert {question["code"] for question in outcome["questions"]} <= asks


@pytest.mark.parametrize(("row", "seed"), [("wired-right", 50003), ("wired-right", 31017), ("drive-reversed", 50000)])
def test_lines_on_which_a_load_cell_was_taken_for_that_of_another_span(row: str, seed: int) -> None:
    """Pulled with half the torque; read while the web swung; taken to have answered to a jerk that passed."""
    outcome = one(row, seed)
    assert outcome is not None and not outcome.code.startswith("not named"), outcome


def test_what_a_stiff_web_cannot_show_is_asked_and_not_found() -> None:
    proved = Proved(loop=drawn_loop(STIFF)).prove()
    assert proved.found == [] and proved.most_share <= SHARE
    assert "speed-sign-unseen" in [question["code"] for question in proved.outcome["questions"]]


TENSION_N = drawn(SEED).size.tension_n

MISTAKES = {
    "load-cell 2 cell-factor factor=-1": [("cell-inverted", 2)],
    "load-cell 3 cell-factor factor=0": [("cell-silent", 3)],
    "load-cell 1 cell-factor factor=0.5": [("cell-factor-off", 1)],
    "load-cell 3 cell-factor factor=2": [("cell-factor-off", 3)],
    "load-cell 2 cells-swapped other=4": [("cells-swapped", 2)],
    "drive 4 reversed": [("drive-reversed", 4)],
    "drive 2 encoder-reversed": [("speed-reversed", 2)],
    f"load-cell 2 offset by_n={0.2 * TENSION_N:.6g}": [("cell-zero-off", 2)],
    f"load-cell 2 offset by_n={-0.2 * TENSION_N:.6g}": [("cell-zero-off", 2)],
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_named_and_hurts_nothing(mistake: str) -> None:
    proved = Proved([mistake]).prove()
    assert proved.found == MISTAKES[mistake], proved.loop.cycle.machine.reason
    assert proved.most_share <= SHARE
    assert proved.loop.truth.recorder.unsafe_events["torque-limit"] == 0
    assert not proved.loop.truth.world.torque_nm.any()
    assert [each["code"] for each in proved.outcome["findings"]] == [code for code, _ in MISTAKES[mistake]]


def test_slack_is_taken_up_slowly_and_hides_nothing() -> None:
    proved = Proved(["drive 3 reversed"], slack_m=0.02).prove()
    assert proved.found == [("drive-reversed", 3)], proved.loop.cycle.machine.reason
    assert proved.most_share <= SHARE


def test_a_drive_that_pulls_backwards_and_says_so_is_found() -> None:
    """Its torque as it reports it: the comparison of asked and given is sooner than any web."""
    proved = Proved(["drive 2 torque-share share=-1"]).prove()
    assert "torque-not-given" in [code for code, _ in proved.found] and proved.most_share <= SHARE


def test_without_a_web_the_drive_is_named_and_the_others_are_not_tried() -> None:
    proved = Proved([f"web {span} web-break" for span in range(1, 5)], slack_m=0.0).prove()
    assert proved.found == [("no-answer", 4)]
    assert proved.fastest_m_per_s <= 2.0 * proved.loop.cycle.proving.limits.speed_m_per_s


def test_rollers_that_so_little_torque_does_not_move_are_asked_about() -> None:
    line = demo_line()
    plant = load_plant("sim_plant/plants/realistic.toml")
    proved = Proved(loop=SteppedLoop(line, design_lqi(task_of(line)), plant, 1)).prove()
    assert proved.found == []
    asked = [question["code"] for question in proved.outcome["questions"]]
    assert asked.count("roller-did-not-move") == line.n and asked.count("cell-unseen") == line.n


def test_a_line_of_one_span_is_proved() -> None:
    line = demo_line(1)
    proved = Proved(loop=SteppedLoop(line, design_lqi(task_of(line)), real_plant(1), 1)).prove()
    assert proved.found == [] and proved.loop.cycle.machine.reason == PROVED


def test_a_span_without_a_load_cell_is_asked_about_or_shown_by_the_others() -> None:
    found = drawn(SEED)
    spans = [span.model_copy(update={"control": "draw"} if i == 1 else {}) for i, span in enumerate(found.line.spans)]
    cells = [cell for cell in found.line.load_cells if cell.span != 2]
    line = found.line.model_copy(update={"spans": spans, "load_cells": cells})
    proved = Proved(loop=SteppedLoop(line, design_lqi(task_of(line)), found.plant, SEED)).prove()
    assert proved.found == [], proved.loop.cycle.machine.reason
    assert [cell["span"] for cell in proved.outcome["cells"]] == [1, 3, 4]


def little_slack(draw: int | None = None, *, cell: bool = False) -> SteppedLoop:
    """Of two spans, soon proved. No load cell sees span `draw`, or one that only shows."""
    line = demo_line(2)
    spans = [
        each.model_copy(update={"slack_max_m": 0.002} | ({"control": "draw"} if i == draw else {}))
        for i, each in enumerate(line.spans, 1)
    ]
    cells = [each for each in line.load_cells if cell or each.span != draw]
    line = line.model_copy(update={"spans": spans, "load_cells": cells})
    plant = real_plant(2)
    plant = plant.model_copy(update={"effects": plant.effects.model_copy(update={"slack": True})})
    return SteppedLoop(line, design_lqi(task_of(demo_line(2))), plant, 1)


def test_a_load_cell_that_only_shows_is_proved_as_any_other() -> None:
    proved = Proved(loop=little_slack(2, cell=True)).prove()
    assert proved.found == [] and [cell["span"] for cell in proved.outcome["cells"]] == [1, 2]
    inverted = Proved(["load-cell 2 cell-factor factor=-1"], little_slack(2, cell=True)).prove()
    assert inverted.found == [("cell-inverted", 2)]


def test_a_load_cell_that_only_shows_and_is_lost_ends_the_proof() -> None:
    proved = Proved(loop=little_slack(2, cell=True))
    loop = proved.loop
    assert loop.command(Prove()).ok and loop.step_until(Phase.PROVING, 5.0)
    injector_of(loop.truth).add(parse_fault("load-cell 2 nan"), loop.truth.world.now_s)
    assert loop.step_until(Phase.OFF, 1.0)
    assert not [event for event in loop.events if event.kind == "proved"]


def test_nothing_is_kept_of_a_proof_that_leaves_a_drive_or_a_load_cell_out() -> None:
    """Whatever the stage has done: neither a pull has shown them, nor was a person asked."""
    proved = Proved(loop=little_slack()).prove()
    cycle, line = proved.loop.cycle, proved.loop.line
    judged = cycle.proving.judged
    assert judged is not None
    judged = replace(judged, questions=[])
    cycle.proving.judged = judged
    assert len(proof_to_keep(cycle, KeepProof()).drives) == line.n
    cycle.proving.judged = replace(judged, drives=judged.drives[1:], cells=judged.cells[:-1])
    left_out = [line.drives[0].name, line.load_cells[-1].name]
    unasked = [  # a word that nobody has asked for is none
        Answer(question=code, device=device, by="somebody")
        for code, device in zip(("drive-direction-unseen", "cell-unseen"), left_out, strict=True)
    ]
    for answers in ([], unasked):
        with pytest.raises(Refused) as refused:
            proof_to_keep(cycle, KeepProof(answers=answers))
        told = [(each.code, each.parameters["device"]) for each in refused.value.findings]
        assert told == [("device-unshown", device) for device in left_out]


# As a stage


def test_it_is_begun_from_ready_only_and_warns_before_anything_moves() -> None:
    line = drawn(SEED).line
    assert line.stages.start_warning_s > 0.0
    loop = drawn_loop()
    loop.step(3)
    assert not loop.command(Prove()).ok
    proved = Proved(loop=drawn_loop())
    plc, loop = proved.loop.truth.plc, proved.loop
    assert loop.command(Prove()).ok
    loop.step(3)
    assert plc.warning and proved.phase is Phase.WARNING
    assert loop.step_until(Phase.PROVING, line.stages.start_warning_s + 1.0)
    assert loop.cycle.machine.state is LoopState.RUN
    loop.step(2)
    assert not plc.warning and not loop.truth.plc.status(loop.now_s).running
    for command in (Prove(), Start(), Arm()):
        assert not loop.command(command).ok


def test_no_drive_pulls_before_the_watchdogs_were_drilled() -> None:
    loop = drawn_loop()
    loop.step(3)
    assert loop.arm().ok and loop.step_until(Phase.READY, 1.0)
    reply = loop.command(Prove())
    assert not reply.ok and [finding.code for finding in reply.findings] == ["not-drilled"]
    assert loop.cycle.machine.phase is Phase.READY
    assert loop.command(Stop()).ok
    drill(loop)
    assert loop.arm().ok and loop.step_until(Phase.READY, 1.0)
    assert loop.command(Prove()).ok


def test_a_line_that_is_switched_to_local_while_it_is_proved_stops_in_order() -> None:
    proved = Proved(loop=drawn_loop())
    loop = proved.loop
    assert loop.command(Prove()).ok and loop.step_until(Phase.PROVING, 5.0)
    while not loop.cycle.outputs.torque_nm.any():
        loop.step()
    loop.truth.plc.local = True
    assert loop.step_until(Phase.OFF, 1.0)
    assert [phase for _, phase, _ in loop.transitions[-2:]] == [Phase.UNLOADING, Phase.OFF]
    assert [finding.rule for _, finding in loop.stopped_by] == ["line-local"] and "local" in loop.cycle.machine.reason
    assert not [event for event in loop.events if event.kind == "proved"]


def test_it_is_refused_while_somebody_is_at_the_line() -> None:
    proved = Proved(loop=drawn_loop())
    proved.loop.truth.plc.local = True
    proved.loop.step(2)
    reply = proved.loop.command(Prove())
    assert not reply.ok and [finding.code for finding in reply.findings] == ["line-local"]


def test_a_stop_takes_torque_off_and_nothing_is_proved() -> None:
    proved = Proved(loop=drawn_loop())
    loop = proved.loop
    assert loop.command(Prove()).ok and loop.step_until(Phase.PROVING, 5.0)
    loop.step(200)
    assert loop.cycle.outputs.torque_nm.any()
    assert loop.command(Stop()).ok
    assert loop.step_until(Phase.OFF, 1.0)
    assert not [event for event in loop.events if event.kind == "proved"]
    assert loop.arm().ok and loop.step_until(Phase.READY, 1.0)
    assert proved.prove().found == []


def test_only_one_drive_has_torque_at_a_time_and_each_is_told() -> None:
    proved = Proved(loop=drawn_loop())
    loop = proved.loop
    assert loop.command(Prove()).ok
    while proved.phase is not Phase.OFF:
        loop.step()
        assert np.count_nonzero(loop.cycle.outputs.torque_nm) <= 1
    assert [event.data["roller"] for event in loop.events if event.kind == "proving"] == [4, 3, 2, 1]


# What the line's file says of the mounting


def mounted(direction: str = "forward", gear: float = 1.0, sign: str = "normal") -> SteppedLoop:
    """Drive 2 and load cell 3 are mounted so, as far as the line's file says."""
    found = drawn(SEED)
    drives = [
        drive.model_copy(update={"direction": direction, "gear": gear} if drive.roller == 2 else {})
        for drive in found.line.drives
    ]
    cells = [cell.model_copy(update={"sign": sign} if cell.span == 3 else {}) for cell in found.line.load_cells]
    line = found.line.model_copy(update={"drives": drives, "load_cells": cells})
    return SteppedLoop(line, design_lqi(task_of(line)), found.plant, SEED)


def test_what_is_mounted_the_other_way_round_is_right_once_the_file_says_so() -> None:
    mistakes = ["drive 2 reversed", "load-cell 3 cell-factor factor=-1"]
    found = Proved(mistakes).prove().found
    assert sorted(found) == [("cell-inverted", 3), ("drive-reversed", 2)]
    proved = Proved(mistakes, mounted("reversed", 2.5, "inverted"))
    assert proved.prove().found == []
    loop = proved.loop
    assert loop.arm().ok and loop.step_until(Phase.READY, 1.0)
    assert loop.command(Start()).ok and loop.step_until(Phase.RUNNING, 30.0), loop.cycle.machine.reason
    loop.step(200)
    assert np.abs(loop.truth.world.tension_n / np.array(loop.line.recipes[0].tension_n) - 1.0).max() < 0.1


def test_a_key_that_is_wrong_is_found_as_the_mistake_that_it_makes() -> None:
    assert Proved(loop=mounted(direction="reversed")).prove().found == [("drive-reversed", 2)]
    assert Proved(loop=mounted(sign="inverted")).prove().found == [("cell-inverted", 3)]
