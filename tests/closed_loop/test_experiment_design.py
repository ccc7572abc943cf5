"""What a designed experiment promises, held against the simulated line: intervals, tensions, refusals."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.cli.stepped import CommandRefused, SteppedLoop
from gateway.cli.stepped_experiment import run_experiment
from gateway.control.design import design_lqg, design_lqi, task_of
from gateway.control.rollout import Course, Setup
from gateway.core.experiment import ExperimentRefused, Leg, setpoints
from gateway.core.recording import Recording, recording_of
from gateway.core.telemetry import frame_dtype
from gateway.core.theta import Noise
from gateway.core.web_model import WebModel
from gateway.identification import experiment_information as information
from gateway.identification.assessment import assess
from gateway.identification.experiment_design import PREFERRED_S, Wanted, _Drawing, design_experiment
from gateway.identification.experiment_foresight import Foresight
from tests.closed_loop.conftest import demo_line
from tests.closed_loop.recorded import per_roller, real_plant
from tests.closed_loop.test_experiment import BASE, SPEED, asked, producing, swinging

ONES = np.ones(6)
S_REAL = WebModel(2200.0, 1.2 * ONES, 0.035 * ONES, 1.0 * ONES, 15.0 * ONES)
SETUP = Setup(0.01, 0.01, 1)


@pytest.fixture(scope="module")
def designed():
    line = demo_line()
    return design_experiment(line, design_lqi(task_of(line)))


def changed(spans=6, **tables):
    """The demonstration line with other values in some tables."""
    line = demo_line(spans)
    return line.model_copy(update={name: getattr(line, name).model_copy(update=new) for name, new in tables.items()})


def run(experiment, seed, plant=None, lead=0) -> Recording:
    """The recording of a complete run on S_real, or another plant, with so many periods before it."""
    loop = producing(seed=seed, plant=plant)
    loop.step(lead)
    found = run_experiment(loop, experiment)
    assert found.samples == experiment.periods(0.01) and loop.truth.recorder.unsafe_total == 0
    frames = np.frombuffer(b"".join(loop.frames[-found.samples - lead :]), frame_dtype(6))
    return recording_of(frames, 0.01, found.source)


def predicted(experiment, model=S_REAL, noise=None):
    """S^-1/2 psi of a run at SPEED, and the information of the data alone."""
    moves = np.vstack((BASE, setpoints(experiment, BASE, 0.01)))
    line = demo_line()
    course = Course(moves, np.full(len(moves), SPEED))
    found = information.closed_loop(design_lqi(task_of(line)), [model], course, SETUP)
    parts = information.sensitivities(found, 0, noise or Noise(), SETUP, (), coulomb=False)
    return parts, np.einsum("kmi,kmj->ij", parts, parts)


def least_squares_stiffness_per_length(recording: Recording) -> float:
    """EA/L of T_i - T_i(0) = EA/L int (v_i - v_{i-1}) dt + 1/L int (T_{i-1} v_{i-1} - T_i v_i) dt, by least squares."""
    speed = np.column_stack((recording.unwind_speed_m_per_s, recording.speed_m_per_s))
    tension = np.column_stack((0.0 * recording.time_s, recording.tension_n))

    def integral(values):
        return np.vstack((np.zeros((1, 6)), np.cumsum(0.5 * recording.period_s * (values[1:] + values[:-1]), axis=0)))

    stretch = integral(np.diff(speed, axis=1))
    carried = integral(tension[:, :-1] * speed[:, :-1] - tension[:, 1:] * speed[:, 1:])
    begins = np.kron(np.eye(6), np.ones((recording.samples, 1)))
    rows = np.column_stack((stretch.T.ravel(), carried.T.ravel(), begins))
    return float(np.linalg.lstsq(rows, recording.tension_n.T.ravel(), rcond=None)[0][0])


@pytest.mark.parametrize("amplitude_n", [0.5, 2.0])
def test_a_simple_fit_scatters_as_the_information_says(amplitude_n):
    experiment = asked(amplitude_n=[amplitude_n] * 6, legs=[Leg(duration_s=5.0)], seed=3)
    truth = 2200.0 / 1.2
    errors = np.array([least_squares_stiffness_per_length(run(experiment, seed)) for seed in range(10)]) / truth - 1.0
    scatter = np.sqrt(np.mean(errors**2))
    _, told = predicted(experiment)
    widths = information.half_widths(told + information.prior_precision(demo_line(), coulomb=False))
    bound = widths["stiffness_per_length"] / 1.96
    # No unbiased fit is better; ten seeds tell a standard deviation to 25 %, and a simple fit is not the best.
    assert 0.7 * bound < scatter < 2.0 * bound


def test_one_step_of_the_best_fit_from_the_truth_scatters_as_the_information_says_in_every_direction():
    """theta - theta_true = I^-1 sum psi' S^-1 e, e the innovations of the Kalman predictor of the truth."""
    experiment = asked(amplitude_n=[2.0] * 6, legs=[Leg(duration_s=5.0)], seed=3)
    noise = Noise(acceleration_m_per_s1_5=5e-2 * 0.001**0.5)
    parts, told = predicted(experiment, noise=noise)
    plants = information.plants_of([S_REAL])
    _, gain, root = information.stationary_filter(S_REAL, BASE, SPEED, noise, 0.01, list(range(12)))
    scores, squares = [], []
    lead = 300  # after which the filter has forgotten how it began
    for seed in range(10):
        recording = run(experiment, seed, lead=lead)
        y = np.hstack((recording.tension_n, recording.speed_m_per_s))
        x, score, square = y[0], 0.0, []
        for k in range(1, recording.samples):
            acting = recording.torque_nm[k - 2 if k > 1 else 0]
            x = information.period_ahead(plants, x[None], acting[None, None], np.array([SPEED]), 0.01)[0]
            whitened = root @ (y[k] - x)
            if k >= lead:
                score = score + parts[k - lead + 1].T @ whitened
                square.append(whitened @ whitened)
            x = x + gain @ (y[k] - x)
        scores.append(score)
        squares.append(np.mean(square) / 12.0)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.03)  # the innovations are what the filter says
    ratios = np.array(scores) @ np.linalg.inv(np.linalg.cholesky(told)).T  # standard normal, if so
    assert np.abs(ratios.mean(axis=0)).max() < 4.0 / np.sqrt(10.0)
    assert 0.5 < np.mean(ratios**2) < 1.7  # of 50 numbers: 4 standard deviations


def test_the_design_tells_what_is_wanted_and_keeps_tensions_where_it_says(designed):
    wanted = Wanted()
    assert all(width <= wanted.of(name) for name, width in designed.worst.items())
    assert all(designed.expected[name] <= width for name, width in designed.worst.items())
    experiment = designed.experiment
    assert experiment.step_max_n <= demo_line().limits.tension_step_max_n
    assert len({leg.speed_m_per_s for leg in experiment.legs}) == 2
    assert 3.0 <= designed.foreseen.tension_min_n < designed.foreseen.tension_max_n <= 59.0
    assert designed.foreseen.deviation_n < experiment.abort.deviation_n < 18.0


@pytest.mark.parametrize("deviation_n", [1.0, 12.0, 17.9])
def test_an_experiment_is_aborted_beyond_what_is_foreseen_and_before_a_limit(designed, deviation_n):
    line = demo_line()
    base = np.array(line.recipes[0].tension_n)
    drawing = _Drawing(Foresight(line, design_lqi(task_of(line)), base, SPEED), Wanted(), 2.0, 0)
    abort = drawing.with_abort(designed.experiment, replace(designed.foreseen, deviation_n=deviation_n)).abort
    room = min(base.min() - line.limits.tension_min_n, line.limits.tension_max_n - base.max())
    assert deviation_n < abort.deviation_n <= room


def test_on_plants_of_the_tolerances_tensions_go_no_further_than_was_foreseen(designed):
    plants = [real_plant(), per_roller(real_plant(), 0.1, 1), per_roller(real_plant(), 0.1, 2)]
    for seed, plant in enumerate(plants):
        recording = run(designed.experiment, seed, plant)
        away = np.abs(recording.tension_n - BASE).max()
        assert designed.experiment.amplitude_n[0] < away < designed.foreseen.deviation_n


def test_a_line_that_cannot_bear_it_ends_it_and_stepped_time_says_so(designed):
    with pytest.raises(CommandRefused, match="aborted: "):
        run_experiment(producing(plant=swinging()), designed.experiment)
    with pytest.raises(CommandRefused, match="the experiment is not run; .*the experiment has 1 amplitudes"):
        run_experiment(producing(), asked(amplitude_n=[1.0]))


def test_more_precision_takes_more_movement_or_time():
    line = demo_line(2)  # the same rules, a fifth of the time
    config = design_lqi(task_of(line))

    def cost(found):
        legs = sum(leg.duration_s for leg in found.experiment.legs)
        return found.experiment.amplitude_n[0] ** 2 * legs

    coarse = design_experiment(line, config, wanted=Wanted(0.02, 0.10))
    fine = design_experiment(line, config, wanted=Wanted(0.0045, 0.03))
    assert cost(coarse) < cost(fine)
    assert coarse.experiment.legs[1].duration_s - 2.0 == PREFERRED_S  # and the way from speed to speed


def test_tensions_move_by_more_than_noise_though_less_would_tell_enough():
    line = demo_line(2)
    config = design_lqi(task_of(line))
    found = design_experiment(line, config, wanted=Wanted(0.05, 0.5))
    needs_n = 5.0 * np.sqrt(2.0) * 0.1  # what the assessment of data wants
    assert found.foreseen.change_n > needs_n and found.experiment.amplitude_n[0] > 0.25
    assert "0.25 N would tell what is wanted, but tensions would move hardly more than by noise" in found.reasons[0]
    plant = real_plant().model_copy(update={"spans": 2})
    loop = SteppedLoop(line, config, plant, 0)
    loop.begin_in_production(np.array(line.recipes[0].tension_n), line.recipes[0].speed_m_per_s)
    loop.step(20)
    assert assess(run_experiment(loop, found.experiment), line).refusals == ()


@pytest.mark.parametrize(
    ("tables", "options", "said"),
    [
        ({"limits": {"tension_max_n": 37.1}}, {}, "the band is too narrow: span 2 stands at 36 N"),
        ({"limits": {"tension_min_n": 25.8}}, {}, "the band is too narrow: already an amplitude of 0.25 N makes"),
        ({}, {"speeds_m_per_s": [0.02], "wanted": Wanted(0.001, 0.03)}, "a second speed: at one, viscous and dry"),
        ({}, {"wanted": Wanted(1e-5, 0.03)}, "tell too little: EA/L"),
        ({}, {"wanted": Wanted(0.005, 1e-4)}, "radii measured by tape"),
        ({}, {"speeds_m_per_s": [0.05, 0.12]}, "a line within the tolerances takes 68 Nm"),
        ({}, {"speeds_m_per_s": []}, "legs at no speed"),
        ({}, {"tension_n": [30.0]}, "tensions of"),
        ({"control": {"period_s": 0.02, "latency_s": 0.02}}, {}, "the controller is for another line"),
    ],
)
def test_what_cannot_be_done_is_refused_with_the_reason(tables, options, said):
    with pytest.raises(ExperimentRefused, match=said):
        design_experiment(changed(2, **tables), design_lqi(task_of(demo_line(2))), **options)


def test_a_line_without_steps_gets_ramps_and_one_with_a_smooth_shape_more_time():
    line = changed(limits={"tension_step_max_n": 0.0}, moves={"shape": "minimum-jerk"})
    found = design_experiment(line, design_lqg(task_of(line)), wanted=Wanted(0.01, 0.05))
    assert found.experiment.rate_n_per_s == line.moves.tension_rate_n_per_s
    moves = np.abs(np.diff(setpoints(found.experiment, BASE, 0.01), axis=0))
    assert moves.max() <= line.moves.tension_rate_n_per_s * 0.01 + 1e-9
    assert any("no steps are allowed" in reason for reason in found.reasons)


def test_draw_spans_stay_where_they_are():
    from gateway.core.line import Line

    line: Line = demo_line(3)
    spans = [line.spans[0], line.spans[1].model_copy(update={"control": "draw"}), *line.spans[2:]]
    cells = [cell for cell in line.load_cells if cell.span != 2]
    line = line.model_copy(update={"spans": spans, "load_cells": cells})
    found = design_experiment(line, design_lqg(task_of(line)), wanted=Wanted(0.02, 0.10))
    assert found.experiment.amplitude_n[1] == 0.0 and found.experiment.amplitude_n[0] > 0.0
    none = line.model_copy(update={"spans": [span.model_copy(update={"control": "draw"}) for span in spans]})
    with pytest.raises(ExperimentRefused, match="no span has a load cell"):
        design_experiment(none, design_lqg(task_of(line)))
