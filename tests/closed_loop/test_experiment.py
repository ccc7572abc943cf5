"""Experiments in the loop, in stepped time: what was foreseen is sent, and whatever happens the line comes back."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.experiment import Abort, Experiment, Leg, setpoints
from gateway.core.messages import (
    AbortExperiment,
    Hold,
    RunExperiment,
    SelectRecipe,
    SetSpeed,
    SetTension,
    Start,
    Stop,
)
from gateway.core.states import LoopState, Phase
from gateway.loop.experiment import Experiments
from tests.closed_loop.conftest import demo_line, real_plant, stepped

BASE = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])
SPEED = 0.05


def asked(**changes):
    given = {
        "format": 1,
        "name": "try",
        "amplitude_n": [1.5] * 6,
        "dwell_s": 0.1,
        "legs": [Leg(duration_s=2.0)],
        "abort": Abort(deviation_n=10.0, saturated_share=0.9, reversal_share=0.9),
    }
    return Experiment(**(given | changes))


def producing(line=None, plant=None, seed=1) -> SteppedLoop:
    line = line or demo_line()
    loop = SteppedLoop(line, design_lqi(task_of(line)), plant or real_plant(), seed)
    loop.begin_in_production(BASE, SPEED)
    loop.step(20)
    return loop


def shaped(shape="ramp", **limits):
    line = demo_line()
    return line.model_copy(
        update={
            "moves": line.moves.model_copy(update={"shape": shape}),
            "limits": line.limits.model_copy(update=limits),
        }
    )


def begin(loop, **changes):
    reply = loop.command(RunExperiment(experiment=asked(**changes)))
    assert reply.ok, reply.reasons
    return asked(**changes)


def sent(loop, periods):
    return np.array([frame.tension_setpoint_n for frame in loop.recorded()[-periods:]])


def at_base(loop):
    found = loop.cycle.setpoints
    return found.at_rest() and np.array_equal(found.tension_n, BASE) and found.speed_m_per_s == SPEED


@pytest.mark.parametrize("shape", ["ramp", "minimum-jerk"])
@pytest.mark.parametrize("rate", [None, 20.0])
def test_what_was_foreseen_is_sent_period_by_period_and_then_the_base(shape, rate):
    loop = producing(shaped(shape))
    legs = [Leg(duration_s=2.0), Leg(duration_s=2.0, speed_m_per_s=0.08)]
    run = begin(loop, legs=legs, rate_n_per_s=rate, seed=7)
    periods = run.periods(0.01)
    loop.step(periods)
    assert np.allclose(sent(loop, periods), setpoints(run, BASE, 0.01), atol=1e-5)  # frames carry floats of 4 bytes
    assert loop.cycle.setpoints.speed_m_per_s == 0.08
    assert loop.told[-1] == ("experiment-end", "experiment try complete; set-points go back to where they stood")
    assert [kind for kind, _ in loop.told].count("experiment-progress") == 9
    loop.step(200)
    assert at_base(loop)
    steps = np.abs(np.diff(sent(loop, 201), axis=0))
    assert steps[1:].max() <= 20.0 * 0.01 + 1e-5  # on the line's ramp
    assert loop.truth.recorder.unsafe_total == 0 and not loop.transitions
    true_n = loop.truth.recorder.recording().tension_n
    assert np.abs(true_n - BASE).max() < 6.0


def test_a_real_line_refuses():
    loop = producing()
    cycle = loop.cycle
    cycle.experiments = Experiments(cycle.setpoints, cycle.limits, lambda: loop.now_s, None, simulated=False)
    reply = loop.command(RunExperiment(experiment=asked()))
    assert not reply.ok and "is judged and approved first" in reply.reasons[0]
    loop.step(50)
    assert at_base(loop) and cycle.experiments.run is None


def test_it_begins_only_in_run_at_rest_and_alone():
    loop = stepped()
    loop.step(3)
    asked_here = loop.command(RunExperiment(experiment=asked()))
    assert [(one.code, one.parameters) for one in asked_here.findings] == [("needs-running", {"phase": "silent"})]
    assert [one.code for one in loop.command(AbortExperiment()).findings] == ["no-experiment"]
    loop = producing()
    assert loop.command(SetTension(span=1, tension_n=30.0)).ok
    loop.step()
    assert "still on their way" in loop.command(RunExperiment(experiment=asked())).reasons[0]
    loop.step(100)
    begin(loop)
    twice = loop.command(RunExperiment(experiment=asked()))
    assert [one.code for one in twice.findings] == ["experiment-under-way"]
    held = producing()
    held.command(Hold())
    assert "holding" in held.command(RunExperiment(experiment=asked())).text
    far = producing().command(
        RunExperiment(experiment=asked(amplitude_n=[9.0, 0, 0, 0, 0, 23.5 + 5.0], abort=Abort(deviation_n=40.0)))
    )
    assert not far.ok and any("span 6" in reason for reason in far.reasons)


@pytest.mark.parametrize(
    ("command", "told"),
    [
        (AbortExperiment(), "operator's abort"),
        (Hold(), "the line left RUN: HOLD"),
        (Stop(), "the line left RUN: operator's stop"),
        (SetTension(span=2, tension_n=37.0), "a set-point was changed"),
        (SetSpeed(speed_m_per_s=0.06), "a set-point was changed"),
        (SelectRecipe(name="velocity"), "a set-point was changed"),
    ],
)
def test_the_operators_word_ends_it(command, told):
    loop = producing()
    begin(loop)
    loop.step(57)
    assert loop.cycle.experiments.run is not None
    assert loop.command(command).ok
    assert loop.cycle.experiments.run is None
    assert loop.told[-1] == (
        "experiment-abort",
        f"experiment try aborted: {told}; set-points go back to where they stood",
    )
    loop.step(150)
    target = loop.cycle.setpoints.tension_target_n
    assert np.array_equal(loop.cycle.setpoints.tension_n, target)
    expected = {2: 37.0} if isinstance(command, SetTension) else {}
    if not isinstance(command, SelectRecipe):
        assert target.tolist() == [expected.get(i + 1, value) for i, value in enumerate(BASE.tolist())]


def test_what_is_refused_does_not_end_it_and_a_step_is():
    loop = producing()
    begin(loop)
    loop.step(30)
    assert not loop.command(SetTension(span=2, tension_n=99.0)).ok
    reply = loop.command(SetTension(span=2, tension_n=37.0, step=True))
    assert not reply.ok and [one.code for one in reply.findings] == ["step-in-experiment"]
    assert loop.cycle.experiments.run is not None
    assert loop.command(AbortExperiment()).ok
    reply = loop.command(SetTension(span=2, tension_n=37.0, step=True))
    assert not reply.ok and [one.code for one in reply.findings] == [
        "step-too-soon"
    ]  # or it would add to the experiment's own


def blind(loop, monkeypatch, periods, span=2):
    """A load cell gives nothing for so many periods from now on."""
    take, end = loop.truth.sample, loop.periods + periods

    def sample(now_s):
        found = take(now_s)
        if loop.periods < end:
            tension = found.tension_n.copy()
            tension[span] = np.nan
            return replace(found, tension_n=tension)
        return found

    monkeypatch.setattr(loop.truth, "sample", sample)


def test_one_lost_sample_is_borne_and_two_in_a_row_are_not(monkeypatch):
    loop = producing()
    run = begin(loop)
    loop.step(30)
    blind(loop, monkeypatch, 1)
    loop.step(run.periods(0.01) - 30)
    assert loop.cycle.experiments.run is not None  # a period in which nothing was controlled does not count
    loop.step(1)
    assert loop.told[-1][0] == "experiment-end"
    loop = producing()
    begin(loop)
    loop.step(30)
    blind(loop, monkeypatch, 2)
    loop.step(2)
    assert "2 periods without a usable signal, allowed: 1" in loop.told[-1][1]
    loop.step(100)
    assert at_base(loop) and loop.cycle.machine.phase is Phase.RUNNING


def swinging():
    """A plant on which the line's controller is too fast: it chatters as soon as anything moves."""
    plant = real_plant()
    rollers = plant.rollers.model_copy(update={"radius_m": 0.048, "inertia_kg_m2": 0.665, "friction_nms_per_rad": 2.5})
    web = plant.web.model_copy(update={"stiffness_n": 3120.0, "length_m": 0.7})
    return plant.model_copy(update={"rollers": rollers, "web": web})


@pytest.mark.parametrize(
    ("shares", "told"),
    [
        ({"saturated_share": 0.6, "reversal_share": 1.0}, "a torque was at a limit in more than 60%"),
        ({"saturated_share": 1.0, "reversal_share": 0.5}, "a torque reversed by 5 Nm in more than 50%"),
    ],
)
def test_a_loop_that_swings_ends_it_by_its_torques_and_a_sound_one_does_not(shares, told):
    abort = Abort(deviation_n=1000.0, window_s=0.3, **shares)
    loop = producing(plant=swinging())
    begin(loop, abort=abort)
    loop.step(199)
    kind, text = next(told for told in loop.told if told[0] != "experiment" and told[0] != "experiment-progress")
    assert kind == "experiment-abort" and f"{told} of the periods of 0.3 s" in text
    loop = producing()
    begin(loop, abort=abort)
    loop.step(200)
    assert loop.told[-1][0] == "experiment-end"


def test_a_tension_that_goes_astray_ends_it_and_set_points_come_back():
    loop = producing(plant=swinging())
    begin(loop, abort=Abort(deviation_n=6.0, saturated_share=1.0, reversal_share=1.0))
    loop.step(199)
    kind, text = next(told for told in loop.told if told[0] != "experiment" and told[0] != "experiment-progress")
    assert kind == "experiment-abort"
    assert "the tension of span " in text and text.split("; ")[0].endswith("allowed: 6 N")
    assert np.array_equal(loop.cycle.setpoints.tension_target_n, BASE)


def happens(loop, what, patch, periods):
    match what:
        case "silent cell":
            blind(loop, patch, periods)
        case "lost drive":
            loop.truth.take_off(1, loop.now_s)
        case "no permissive":
            loop.truth.plc.permissive = False
        case "nothing":
            pass
        case command:
            assert loop.command(command).ok


ORDERS = [AbortExperiment(), Hold(), Stop(), SetTension(span=3, tension_n=22.0), SetSpeed(speed_m_per_s=0.03)]
EVENTS = ["nothing", "silent cell", "lost drive", "no permissive"]


@settings(max_examples=30)
@given(
    st.sampled_from([*ORDERS, *EVENTS]),
    st.integers(0, 99),
    st.integers(1, 5),
    st.integers(0, 2**31),
    st.sampled_from(["ramp", "minimum-jerk"]),
    st.sampled_from([None, 20.0]),
    st.sampled_from([None, 0.06]),
)
def test_whatever_happens_set_points_come_back(what, after, periods, seed, shape, rate, speed):
    loop = producing(shaped(shape))
    begin(loop, seed=seed, rate_n_per_s=rate, legs=[Leg(duration_s=1.0, speed_m_per_s=speed)])
    loop.step(after)
    with pytest.MonkeyPatch.context() as patch:
        happens(loop, what, patch, periods)
        loop.step(250)
    base, target_speed = BASE.copy(), SPEED
    if isinstance(what, SetTension):
        base[2] = what.tension_n
    if isinstance(what, SetSpeed):
        target_speed = what.speed_m_per_s
    found = loop.cycle.setpoints
    assert loop.cycle.experiments.run is None and loop.told[-1][0] in ("experiment-end", "experiment-abort")
    assert np.array_equal(found.tension_target_n, base)
    assert found.speed_target_m_per_s == target_speed
    if loop.cycle.machine.state is LoopState.HOLD:
        loop.command(Start())
        loop.step(250)
    if loop.cycle.machine.state is LoopState.RUN:
        assert np.array_equal(found.tension_n, base) and found.speed_m_per_s == target_speed
