"""What is no number, and what was not seen, counts for nothing: in metrics, designs, experiments and approvals."""

from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.commissioning.convergence import Convergence, SpanFigures
from gateway.commissioning.redesign import Figures, no_worse
from gateway.commissioning.selection import Candidate, ranked
from gateway.control.design import DesignRefused
from gateway.control.design.margins import Margins, require_margin
from gateway.core.controller import config_hash
from gateway.core.experiment import Abort, Experiment, Leg
from gateway.core.metrics import overshoot_pct, settling_time_paper_s, settling_time_s
from gateway.core.signals import Inputs, Quality
from gateway.identification.coloured_regression import least_known
from gateway.identification.structure_choice import _known  # pyright: ignore[reportPrivateUsage]
from gateway.identification.whiteness import strongest_line
from gateway.loop.experiment import ExperimentRun
from gateway.loop.setpoints import Setpoints
from gateway.loop.standstill import Standstill
from safety.limits import envelope_limits
from tests.closed_loop.recorded import demonstration_line
from tests.unit.deployer_gateway import run, started
from tests.unit.deployer_support import FIRST, hash_of, proposal

LINE = demonstration_line()
TIME_S = 0.01 * np.arange(300)
SETPOINT_N = np.full((300, 3), 30.0)


@given(st.integers(0, 2), st.integers(100, 299))
def test_a_tension_that_is_no_number_has_not_settled(span: int, last: int) -> None:
    tension_n = SETPOINT_N.copy()
    tension_n[last, span] = nan
    found = settling_time_s(TIME_S, tension_n, SETPOINT_N, 0.5)
    assert found[span] >= TIME_S[last] - 0.5 and np.delete(found, span).tolist() == [0.0, 0.0]
    assert settling_time_paper_s(TIME_S, tension_n, SETPOINT_N) >= TIME_S[last]
    assert np.isnan(overshoot_pct(TIME_S, tension_n, SETPOINT_N, 0.5)[span])
    tension_n[:, span] = nan
    assert settling_time_s(TIME_S, tension_n, SETPOINT_N, 0.5)[span] == inf


def test_nothing_has_settled_where_there_is_no_sample_after_the_change() -> None:
    assert settling_time_s(TIME_S, SETPOINT_N, SETPOINT_N, 4.0).tolist() == [inf] * 3


FINE = SpanFigures(rmse_n=0.1, overshoot_pct=1.0, settling_s=0.5, setpoint_n=30.0)


@given(st.sampled_from(["rmse_n", "overshoot_pct", "settling_s", "setpoint_n"]))
def test_a_span_whose_figure_is_no_number_has_not_converged(name: str) -> None:
    assert FINE.converged and not FINE.model_copy(update={name: nan}).converged


def test_what_was_measured_of_no_span_has_not_converged_and_a_gap_that_is_no_number_is_one() -> None:
    one = Convergence(spans={"1": FINE}, predicted={"1": FINE}, rmse_n=0.1, gap=0.0)
    assert one.settled
    assert not one.model_copy(update={"spans": {}}).converged
    assert not one.model_copy(update={"gap": nan}).settled


@given(st.permutations(["a", "b", "c", "d"]))
def test_a_score_that_is_no_number_is_never_the_least(order: list[str]) -> None:
    scores = {"a": 2.0, "b": 1.0, "c": nan, "d": None}
    candidates = [
        Candidate(
            architecture=name, title=name, hash="", values={}, trial=None, compute_s=None, refused="", score=None,
            terms=[],
        ).model_copy(update={"score": scores[name]})
        for name in order
    ]  # fmt: skip
    assert [one.architecture for one in ranked(candidates)][:2] == ["b", "a"]


@given(st.integers(0, 2), st.booleans())
def test_a_design_whose_figure_is_no_number_is_worse(figure: int, before: bool) -> None:
    fine = [1.0, 1.0, 1.0]
    spoilt = [nan if i == figure else one for i, one in enumerate(fine)]
    one, other = (fine, spoilt) if before else (spoilt, fine)
    assert no_worse(LINE, Figures(*fine), Figures(*fine))
    assert not no_worse(LINE, Figures(*one), Figures(*other))


@given(st.floats(allow_nan=True))
def test_a_cost_or_an_evidence_that_is_no_number_is_never_the_best(value: float) -> None:
    assert least_known(value) == (inf if np.isnan(value) else value)
    assert _known(value) == (-inf if np.isnan(value) else value)


@pytest.mark.parametrize("name", ["spectral_radius", "delay_margin_s"])
def test_margins_that_are_no_number_are_none(name: str) -> None:
    found = Margins(0.9, 1.0, 0.1, 0.1, 0.1)
    require_margin(found)
    with pytest.raises(DesignRefused):
        require_margin(replace(found, **{name: nan}))


def test_a_line_in_innovations_that_are_no_numbers_is_none() -> None:
    white = np.random.default_rng(1).normal(size=(500, 2))
    assert strongest_line(white, 0.01) is None
    white[:, 1] = nan
    white[:, 0] += 3.0 * np.sin(0.3 * np.arange(500))
    found = strongest_line(white, 0.01)
    assert found is not None and found.output == 0


def experiment_run() -> tuple[ExperimentRun, Inputs]:
    setpoints, inputs = Setpoints(LINE.recipes[0], 0.02), Inputs(LINE.n)
    setpoints.begin_at(np.array(LINE.recipes[0].tension_n))
    asked = Experiment(
        format=1, amplitude_n=[1.0] * LINE.n, dwell_s=0.1, legs=[Leg(duration_s=1.0)], abort=Abort(deviation_n=8.0)
    )
    limits = replace(envelope_limits(LINE), measured=np.array([1.0] * (LINE.n - 1) + [0.0]))
    for i, tension_n in enumerate(LINE.recipes[0].tension_n[:-1]):
        inputs.tension.put(i, tension_n, 0.0)
    return ExperimentRun(asked, setpoints, limits), inputs


def test_an_experiment_goes_on_without_the_tension_of_a_span_that_has_no_load_cell() -> None:
    one, inputs = experiment_run()
    assert one.against(inputs, np.zeros(LINE.n), 0) == ""
    inputs.tension.put(LINE.n - 1, LINE.recipes[0].tension_n[-1] + 8.5, 0.0)  # a cell that only indicates
    assert f"span {LINE.n} is 8.5 N away" in one.against(inputs, np.zeros(LINE.n), 0)


@given(st.integers(0, LINE.n - 2))
def test_an_experiment_ends_where_a_tension_is_no_number(span: int) -> None:
    one, inputs = experiment_run()
    inputs.tension.value[span] = nan
    assert f"the tension of span {span + 1} is nan" in one.against(inputs, np.zeros(LINE.n), 0)


@given(st.integers(0, LINE.n))
def test_what_moves_at_no_known_speed_does_not_stand_still(which: int) -> None:
    inputs, still = Inputs(LINE.n), Standstill(LINE, 0.002, 30)
    inputs.unwind_speed.put(0, 0.0, 0.0)
    for i in range(LINE.n):
        inputs.speed.put(i, 0.0, 0.0)
    periods = 31
    assert [still.look(inputs, asked=False) for _ in range(periods)][-1]
    (inputs.speed.value if which < LINE.n else inputs.unwind_speed.value)[which % LINE.n] = nan
    assert inputs.speed.quality[0] == Quality.GOOD and not still.look(inputs, asked=False)


@run
async def test_a_proposal_that_expires_at_no_time_has_expired():
    gateway = await started()
    one = proposal(1, config_hash(FIRST), gateway.loop.now_s)
    assert (await gateway.propose(one)).ok
    gateway.deployer.book.entries[hash_of(one)] = replace(gateway.deployer.book.entries[hash_of(one)], expires_s=nan)
    reply = await gateway.decide(one)
    assert not reply.ok and "expired" in reply.reasons[0]
