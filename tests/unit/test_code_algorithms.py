"""What the calls compute, against figures made another way: python-control, plain rollouts, sines that were put in."""

from dataclasses import replace

import control
import numpy as np
import pytest

from agents.code.algorithms import carry_out
from agents.code.job import Believed, Job
from gateway.control.design import design_lqr, design_mpc, design_pid, lqr_weights, task_of
from gateway.control.rollout import Course, Setup, plants_of, simulate_slowly
from gateway.core.controller_laws import LqrConfig
from gateway.core.recording import Recording
from gateway.core.theta import Noise
from gateway.core.web_model import linearise, nominal_model, reference_speeds
from tests.unit.code_support import LINE, in_service, job, value
from tests.unit.model_support import model as line_model
from tests.unit.regression_support import shaken, true_model

PERIOD_S = LINE.control.period_s


def refusals(document: Job) -> str:
    found = carry_out(document)
    assert not found.figures and not found.failed
    return "; ".join(found.refused)


# margins


def poles(config: LqrConfig, extra_periods: int = 0, gain: float = 1.0) -> float:
    """The greatest modulus of the loop's poles, by python-control alone. The latency is a period, and `extra` more."""
    task, n = task_of(LINE), LINE.n
    speeds = reference_speeds(task.model, task.tension_n, task.unwind_speed_m_per_s)
    A, B = linearise(task.model, task.tension_n, speeds, task.unwind_speed_m_per_s)
    eye, none = np.eye(n), np.zeros((n, n))
    plant = control.c2d(control.ss(A, B, np.eye(2 * n), np.zeros((2 * n, n))), PERIOD_S)
    delay = control.ss(none, eye, eye, none, PERIOD_S)
    for _ in range(1 + extra_periods):
        plant = control.series(delay, plant)
    of_state, of_input = np.array(config.gain_state), np.array(config.gain_input).reshape(n, n)
    law = control.ss(-of_input, -of_state, of_input, of_state, PERIOD_S)
    return float(np.abs(control.feedback(gain * plant, law).poles()).max())


def test_margins_are_those_of_python_control() -> None:
    task = task_of(LINE)
    slow = design_lqr(task, replace(lqr_weights(task), torque_per_nm2=2.0))
    found = carry_out(job({"call": "margins"}, slow))
    assert value(found, "spectral radius of a period") == pytest.approx(poles(slow), rel=1e-3)
    assert value(found, "decay of the slowest mode") == pytest.approx(-np.log(poles(slow)) / PERIOD_S, rel=0.01)
    config = design_lqr(task, replace(lqr_weights(task), torque_per_nm2=0.05))
    found = carry_out(job({"call": "margins"}, config))
    gain = value(found, "gain margin, all drives together")
    assert gain < 20.0 and poles(config, gain=0.998 * gain) < 1.0 < poles(config, gain=1.003 * gain)
    stands = value(found, "delay margin beyond the latency") * 1e-3
    for extra in range(5):
        assert (poles(config, extra) < 1.0) is (extra * PERIOD_S <= stands + 1e-9)


def test_a_loop_that_is_unstable_is_told_as_that() -> None:
    task = task_of(LINE)
    found = carry_out(job({"call": "margins"}, design_pid(task, 1.5, 1.0)))
    assert value(found, "spectral radius of a period") > 1.0 and "the loop is unstable" in found.words
    assert value(found, "gain margin, all drives together") == 0.0
    assert next(one for one in found.figures if one.name == "error left by noise").value is None


# simulate, compare


def rmse_n(spans: int = LINE.n) -> float:
    """Of the step of the suite, with the law itself and nothing compiled, and the noise of the same seed."""
    task = task_of(LINE)
    before, after = np.array(LINE.recipes[0].tension_n), np.array(LINE.recipes[0].tension_n)
    span = (spans - 1) // 2
    up = min(LINE.limits.tension_step_max_n, LINE.limits.tension_max_n - 1.0 - before[span])
    down = min(LINE.limits.tension_step_max_n, before[span] - LINE.limits.tension_min_n - 1.0)
    after[span] += up if up >= down else -down
    periods, change = round(15.0 / PERIOD_S), round(1.0 / PERIOD_S)
    tension = np.repeat([before, after], [change, periods - change], axis=0)
    course = Course(tension, np.full(periods, LINE.recipes[0].speed_m_per_s), change)
    noise = task.noise
    setup = Setup(
        PERIOD_S, LINE.control.latency_s, 2, LINE.limits.torque_nm, LINE.limits.torque_rate_nm_per_s, noise.tension_n,
        noise.speed_m_per_s, noise.acceleration_m_per_s1_5, seed=3,
    )  # fmt: skip
    run = simulate_slowly(in_service(), plants_of([nominal_model(LINE)]), course, setup, record=True)
    return float(np.sqrt(np.square(run.tension_n[0] - tension).sum() / periods))


def test_a_simulation_is_that_of_the_law_itself() -> None:
    found = carry_out(job({"call": "simulate"}, in_service()))
    assert value(found, "tracking error, tension-step") == pytest.approx(rmse_n(), rel=0.02)  # of other noise
    more = carry_out(job({"call": "simulate", "plants": 6}, in_service()))
    assert value(more, "greatest tension") > value(found, "greatest tension")
    assert value(more, "tracking error, tension-step") == value(found, "tracking error, tension-step")


def test_controllers_are_compared_in_the_same_noise() -> None:
    ours, other = in_service(), design_pid(task_of(LINE))
    found = carry_out(job({"call": "compare", "controllers": ["in-service", "call 1"]}, ours, other))
    for name, config in (("in-service", ours), ("call 1", other)):
        alone = carry_out(job({"call": "simulate"}, config))
        for figure in alone.figures:
            assert figure.value == next(one.value for one in found.figures if one.name == f"{name}: {figure.name}")


@pytest.mark.slow
def test_predictive_control_is_simulated_too() -> None:
    found = carry_out(job({"call": "simulate", "scenario": "speed-step"}, design_mpc(task_of(LINE))))
    assert 0.0 < value(found, "tracking error, speed-step") < 10.0


def test_a_scenario_that_the_line_does_not_have_is_refused_with_those_that_it_has() -> None:
    draw = LINE.model_copy(update={"spans": [s.model_copy(update={"control": "draw"}) for s in LINE.spans]})
    found = replace(job({"call": "simulate"}, in_service()), line=draw)
    assert "no scenario tension-step; allowed: speed-step" in refusals(found)


# design, tune


def test_a_design_is_turned_by_its_knobs_and_no_further_than_they_go() -> None:
    first = carry_out(job({"call": "design", "architecture": "lqi"}))
    calmer = carry_out(job({"call": "design", "architecture": "lqi", "knobs": {"torque_per_nm2": 5.0}}))
    assert first.controller == in_service()
    assert value(calmer, "torque chatter under noise") < value(first, "torque chatter under noise")
    assert value(calmer, "delay margin beyond the latency") > value(first, "delay margin beyond the latency")
    beyond = refusals(job({"call": "design", "architecture": "lqi", "knobs": {"antiwindup": 10.0}}))
    assert "knobs.antiwindup is 10; allowed: 0.0" in beyond and "0.01 to 1" in beyond


def test_a_few_turns_of_algorithm_1_are_no_worse_than_the_first_guess() -> None:
    found = carry_out(job({"call": "tune", "architecture": "lqi", "iterations": 3}))
    assert value(found, "cost J") <= value(found, "cost J at first")
    assert found.controller is not None and found.controller.kind == "lqi"


# identify, compare models


@pytest.fixture(scope="module")
def recording() -> Recording:
    return shaken(LINE, true_model(3), duration_s=8.0, noise=Noise(), amplitude_nm=8.0)


@pytest.mark.slow
def test_physics_are_found_with_intervals(recording: Recording) -> None:
    found = carry_out(job({"call": "identify"}, recordings=(recording,)))
    for name, truth in (("stiffness_per_length", 2200.0 / 1.2), ("radius_per_inertia", 0.035)):
        assert value(found, f"{name}, from") < truth < value(found, f"{name}, to")
        assert value(found, name) == pytest.approx(truth, rel=0.05)
    assert value(found, "of tension: R2 a second ahead") > 0.8 and len(found.figures) <= 64


def test_what_nothing_can_be_made_from_is_refused_with_what_would_help(recording: Recording) -> None:
    assert "experiment: every" in refusals(job({"call": "identify"}, recordings=(recording.part(0, 100),)))


def test_of_two_models_the_true_one_is_ahead(recording: Recording) -> None:
    document = {"call": "compare", "models": ["in-service", "nominal"]}
    true = Believed("accepted", line_model(3))
    both = replace(job(document, recordings=(recording,)), models=(true, Believed("nominal", None)))
    found = carry_out(both)
    errors = [value(found, f"model {k}: of tension: mean absolute error a second ahead") for k in (1, 2)]
    assert errors[0] < 0.5 * errors[1] and "a second ahead model 1 has the lesser error" in found.words
    assert 0.8 < value(found, "model 1: normalised innovation squared") < 1.2
    again = Believed("by its hash", true.model and true.model.model_copy(deep=True))
    for one, other in ((both.models[1], both.models[1]), (true, again)):
        assert "two that differ" in refusals(replace(both, models=(one, other)))


# spectrum


def swinging(*sines: tuple[float, float], seconds: float = 20.0, seed: int = 0) -> Recording:
    """A line that stands still in its set-points but for sines (amplitude in N, Hz) in the tension of span 2."""
    generator = np.random.default_rng(seed)
    samples, n = round(seconds / PERIOD_S), LINE.n
    time_s = PERIOD_S * np.arange(samples)
    tension = 30.0 + 0.1 * generator.standard_normal((samples, n))
    for amplitude_n, frequency_hz in sines:
        tension[:, 1] += amplitude_n * np.sin(2.0 * np.pi * frequency_hz * time_s + generator.uniform(0.0, 6.0))
    speed, flat = np.full((samples, n), 0.1), np.zeros((samples, n))
    return Recording(
        time_s, tension, flat + 30.0, speed, flat, flat, speed[:, 0], np.ones(samples, dtype=np.bool_), PERIOD_S, "made"
    )


def spectrum(recording: Recording, index: int = 2):
    return carry_out(job({"call": "spectrum", "channel": "tension", "index": index}, recordings=(recording,)))


@pytest.mark.parametrize("frequency_hz", [1.0, 3.337, 17.513, 41.975])
def test_a_sine_is_found_where_and_as_large_as_it_is(frequency_hz: float) -> None:
    found = spectrum(swinging((0.5, frequency_hz)))
    assert value(found, "peak 1: frequency") == pytest.approx(frequency_hz, abs=0.005)
    assert value(found, "peak 1: amplitude") == pytest.approx(0.5, rel=0.05)


def test_two_sines_are_two_the_greater_first() -> None:
    found = spectrum(swinging((0.3, 5.0), (0.6, 9.0)))
    assert value(found, "peak 1: frequency") == pytest.approx(9.0, abs=0.01)
    assert value(found, "peak 2: frequency") == pytest.approx(5.0, abs=0.01)


def test_a_roller_is_known_by_its_turning() -> None:
    turn_hz = 0.1 / (2.0 * np.pi * float(nominal_model(LINE).radius_m[0]))
    whose = [word for word in spectrum(swinging((0.5, 2.0 * turn_hz))).words if word.startswith("peak 1")]
    assert "roller 1 (2 times a turn)" in whose[0]
    nobody = [word for word in spectrum(swinging((0.5, 7.7))).words if word.startswith("peak 1")]
    assert "matches no roller" in nobody[0]


def test_noise_alone_has_hardly_ever_a_peak() -> None:
    found = [spectrum(swinging(seed=seed)) for seed in range(20)]
    assert sum(len(one.figures) > 1 for one in found) <= 1


def test_a_channel_that_is_not_there_or_not_known_is_refused() -> None:
    good = swinging((0.5, 5.0))
    assert "allowed: 1 to 3" in refusals(
        job({"call": "spectrum", "channel": "tension", "index": 4}, recordings=(good,))
    )
    gone = good.tension_n.copy()
    gone[::100, 1] = np.nan
    document = {"call": "spectrum", "channel": "tension", "index": 2}
    assert "in a row" in refusals(job(document, recordings=(replace(good, tension_n=gone),)))
    later = replace(good, time_s=good.time_s + np.where(np.arange(good.samples) < 500, 0.0, 3.0))
    assert any("15 s" in word for word in carry_out(job(document, recordings=(later,))).words), (
        "the piece behind the gap"
    )
