"""Load cells whose zero, factor or decimals change, on the real wires in virtual time; the truth of the web judges."""

import numpy as np
import pytest

from gateway.core.messages import Start
from gateway.core.states import LoopState, Phase
from gateway.loop.wiring import CONTRADICTED, FILE, Wiring
from safety.actions import Action
from safety.cell_balance import CODE
from sim_plant.faults.parse import parse_fault
from sim_plant.faults.stepped import injector_of
from tests.bench.harm_lines import drawn
from tests.bench.harm_runs import begun
from tests.closed_loop.virtual_line import VirtualLine

BOUND_S = 1.0  #: from the change to the stop


@pytest.fixture
def line():
    with VirtualLine() as line:
        line.begin_in_production()
        line.step(300)
        yield line


@pytest.fixture
def at_rest():
    with VirtualLine() as line:
        line.step(50)
        yield line


def inject(line: VirtualLine, text: str) -> None:
    line.truth.faults.injector.add(parse_fault(text), line.truth.faults.now_s())


def codes(line: VirtualLine) -> list[str]:
    return [finding.rule for finding in line.findings]


def at_most_n(line: VirtualLine, seconds: float) -> float:
    """The greatest true tension until then (N)."""
    most_n = 0.0
    for _ in range(round(seconds / line.period_s)):
        line.step()
        most_n = max(most_n, float(line.truth.world.tension_n.max()))
    return most_n


@pytest.mark.parametrize("span", [1, 3, 6])
@pytest.mark.parametrize("fault", ["offset by_n=-12", "offset by_n=12", "cell-factor factor=0.5",
                                   "cell-factor factor=0.1"])  # fmt: skip
def test_a_cell_that_changes_in_production_is_stopped_before_the_web_is_hurt(line, span, fault):
    inject(line, f"load-cell {span} {fault}")
    most_n = at_most_n(line, BOUND_S)
    assert line.cycle.machine.phase in (Phase.BRAKING, Phase.UNLOADING, Phase.OFF), codes(line)
    assert most_n <= line.line.limits.tension_max_n


@pytest.mark.parametrize("share", [-0.5, 0.5])
@pytest.mark.parametrize(("seed", "span"), [(41100, 2), (41100, 4), (41129, 5)])
def test_on_a_stiff_web_where_any_jump_may_be_true_torques_name_the_cell(seed, span, share, tmp_path):
    """From then on nothing starts before it is proved again, also where the loop starts anew."""
    loop = begun(seed, 0.5)
    loop.step(300)
    wiring = loop.cycle.wiring
    wiring.path = tmp_path / FILE
    add = injector_of(loop.truth).add
    add(parse_fault(f"load-cell {span} offset by_n={share * drawn(seed).size.tension_n:.6g}"), loop.truth.world.now_s)
    most_n = 0.0
    for _ in range(round(BOUND_S / loop.line.control.period_s)):
        loop.step()
        most_n = max(most_n, float(loop.truth.world.tension_n.max()))
    assert most_n <= loop.line.limits.tension_max_n
    told = [found for _, found in loop.stopped_by if found.rule == CODE]
    assert [(found.action, found.parameters["span"]) for found in told] == [(Action.BRAKE, span)]
    assert np.sign(told[0].parameters["off_n"]) == np.sign(share)
    assert loop.step_until(Phase.OFF, loop.line.longest_stop_s)
    assert [one.code for one in wiring.against] == [CODE]
    assert wiring.behind and wiring.settle(wiring.contradicted)
    anew = Wiring(loop.line, {}, tmp_path)
    anew.read(lambda text: None)
    assert CODE in [one.code for one in anew.against]
    wiring.write(wiring.proof)
    wiring.take_written()
    assert not wiring.against and wiring.settle(wiring.contradicted) and not (tmp_path / CONTRADICTED).exists()


def test_a_file_of_contradicted_cells_that_is_spoilt_asks_for_a_proof_once(at_rest, tmp_path):
    proved = at_rest.cycle.wiring.proof

    def read() -> Wiring:
        wiring = Wiring(at_rest.line, {}, tmp_path)
        wiring.read(lambda text: None)
        return wiring

    read().write(proved)
    assert read().proof == proved
    (tmp_path / CONTRADICTED).write_text("{")
    spoilt = read()
    assert [one.code for one in spoilt.against] == ["wiring-unproved"]
    assert [one.rule for one in spoilt.unusable] == ["file-unusable"]
    spoilt.write(proved)
    spoilt.take_written()
    assert spoilt.behind and spoilt.settle(spoilt.contradicted) and read().proof == proved


@pytest.mark.parametrize("span", [1, 4])
def test_what_shows_less_than_nothing_is_not_armed_nor_started(at_rest, span):
    inject(at_rest, f"load-cell {span} offset by_n=-8 for 0.2")
    at_rest.step(5)
    refused = at_rest.arm()
    assert not refused.ok and [(one.code, one.parameters["span"]) for one in refused.findings] == [
        ("load-cell-below-zero", span)
    ]
    at_rest.step(30)
    assert at_rest.arm().ok
    inject(at_rest, f"load-cell {span} offset by_n=-8")
    at_rest.step(5)
    assert not at_rest.command(Start()).ok and at_rest.cycle.machine.state is LoopState.READY


def test_a_broken_web_blames_no_cell(line):
    inject(line, "web 3 web-break")
    line.step(300)
    assert line.cycle.machine.state is LoopState.STOP and CODE not in codes(line)
    assert not line.cycle.wiring.against


@pytest.mark.parametrize("fault", ["drive 3 torque-share share=0.8", "web 4 friction-rise factor=2",
                                   "web 2 slip factor=0.5"])  # fmt: skip
def test_what_is_wrong_elsewhere_blames_no_cell(line, fault):
    inject(line, fault)
    line.step(800)
    assert CODE not in codes(line)


def test_moves_of_every_kind_blame_no_cell(line):
    setpoints, dice = line.cycle.setpoints, np.random.default_rng(3)
    for k in range(8):
        setpoints.speed_target_m_per_s = float(dice.uniform(0.0, line.line.limits.speed_max_m_per_s))
        setpoints.tension_target_n = 28.0 * dice.uniform(0.8, 1.2, line.line.n)
        line.step(250)
        assert line.cycle.machine.phase is Phase.RUNNING, (k, line.cycle.machine.reason)
    assert not line.findings
