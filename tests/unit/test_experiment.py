"""Experiments as data: what will be sent is known before it is sent, and stays inside what was allowed."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from gateway.core.experiment import (
    Abort,
    Experiment,
    ExperimentRefused,
    Leg,
    canonical,
    course,
    experiment_hash,
    parse_experiment,
    reasons_against,
    setpoints,
    signs,
    speed_goals,
)
from gateway.core.experiment_torques import Turns, at_limit, lasting_periods
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.messages import RunExperiment, in_words, parse_command

BASE = np.array([28.0, 36.0, 20.0])


def experiment(**changes):
    given = {
        "format": 1,
        "amplitude_n": [2.0, 1.0, 0.0],
        "dwell_s": 0.1,
        "legs": [Leg(duration_s=3.0)],
        "abort": Abort(deviation_n=8.0),
    }
    return Experiment(**(given | changes))


@st.composite
def experiments(draw):
    amplitude = draw(st.lists(st.floats(0.0, 10.0), min_size=3, max_size=3).filter(any))
    legs = st.builds(Leg, duration_s=st.floats(0.01, 5.0), speed_m_per_s=st.none() | st.floats(0.0, 1.0))
    return experiment(
        amplitude_n=amplitude,
        shape=draw(st.sampled_from(["binary", "uniform"])),
        dwell_s=draw(st.floats(0.001, 3.0)),
        rate_n_per_s=draw(st.none() | st.floats(0.1, 100.0)),
        seed=draw(st.integers(0, 2**63 - 1)),
        legs=draw(st.lists(legs, min_size=1, max_size=4)),
        abort=Abort(deviation_n=max(amplitude) + 1.0),
    )


@given(experiments(), st.sampled_from([0.001, 0.002, 0.01, 0.05]))
def test_set_points_stay_within_their_amplitude_for_all_that_may_be_asked(asked, period_s):
    sent = setpoints(asked, BASE, period_s)
    assert sent.shape == (asked.periods(period_s), 3)
    assert (np.abs(sent - BASE) <= np.array(asked.amplitude_n) + 1e-9).all()
    steps = np.abs(np.diff(np.vstack((BASE, sent)), axis=0)).max()
    most = asked.step_max_n if asked.rate_n_per_s is None else asked.rate_n_per_s * period_s
    assert steps <= most + 1e-9
    if asked.rate_n_per_s is None:  # levels change at dwells only
        moved = np.flatnonzero((sent[1:] != sent[:-1]).any(axis=1)) + 1
        assert not (moved % max(1, round(asked.dwell_s / period_s))).any()


@given(experiments())
def test_what_is_sent_is_the_same_every_time_and_depends_on_nothing_else(asked):
    read = parse_experiment(canonical(asked))
    assert read == asked and experiment_hash(read) == experiment_hash(asked)
    assert (setpoints(read, BASE, 0.01) == setpoints(asked, BASE, 0.01)).all()
    assert setpoints(asked, BASE + 1.0, 0.01) - 1.0 == pytest.approx(setpoints(asked, BASE, 0.01))


def test_levels_come_from_splitmix64_as_published():
    words = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431, 16408922859458223821]
    asked = experiment(seed=1234567)
    found = np.concatenate([signs(asked, 0), signs(asked, 1)])
    assert found[:5].tolist() == [1.0 if word < 2**63 else -1.0 for word in words]
    even = experiment(seed=1234567, shape="uniform")
    assert signs(even, 0)[0] == (words[0] >> 11) / 2.0**52 - 1.0


def test_levels_are_balanced_and_differ_between_spans_and_seeds():
    levels = np.array([signs(experiment(seed=5), j) for j in range(4000)])
    assert set(levels.ravel()) == {-1.0, 1.0}
    assert np.abs(levels.mean(axis=0)).max() < 0.06  # 4 standard deviations
    correlation = levels.T @ levels / len(levels) - np.eye(3)
    assert np.abs(correlation).max() < 0.06
    other = np.array([signs(experiment(seed=6), j) for j in range(4000)])
    assert abs(np.mean(levels * other)) < 0.04
    even = np.array([signs(experiment(seed=5, shape="uniform"), j) for j in range(4000)])
    assert np.abs(even).max() <= 1.0 and np.var(even) == pytest.approx(1.0 / 3.0, abs=0.02)


def test_legs_follow_each_other_with_their_speeds():
    legs = [Leg(duration_s=1.0, speed_m_per_s=0.05), Leg(duration_s=2.0), Leg(duration_s=1.0, speed_m_per_s=0.1)]
    asked = experiment(legs=legs)
    goals = speed_goals(asked, 0.01, 0.01)
    assert goals.tolist() == [0.05] * 100 + [0.01] * 200 + [0.1] * 100
    assert [speed for _, speed in course(asked, BASE, 0.01, 0.01)] == goals.tolist()
    assert asked.duration_s == 4.0 and asked.periods(0.01) == 400


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"amplitude_n": [0.0, 0.0]}, "nothing would move"),
        ({"amplitude_n": [9.0]}, "more than the greatest amplitude, 9 N"),
        ({"legs": [Leg(duration_s=400.0), Leg(duration_s=400.0)]}, "the legs take 800 s; allowed: 600 s"),
        ({"amplitude_n": [-1.0]}, "greater than or equal to 0"),
        ({"dwell_s": float("nan")}, "finite"),
        ({"colour": 1}, "colour"),
        ({"seed": 2**63}, "less than or equal"),
    ],
)
def test_what_makes_no_sense_is_refused_with_the_reason(changes, said):
    with pytest.raises(ValidationError, match=said):
        experiment(**changes)
    document = json.loads(canonical(experiment())) | json.loads(
        json.dumps(changes, default=lambda leg: leg.model_dump())
    )
    with pytest.raises(ExperimentRefused):
        parse_experiment(json.dumps(document).encode())


def test_a_line_has_a_say_in_what_is_sent():
    line = load_line(line_template(3, "line.toml"), "line.toml")
    assert not reasons_against(experiment(), line, BASE, 0.01)

    def against(base=BASE, **changes):
        return " ".join(reasons_against(experiment(**changes), line, base, 0.01))

    assert "the line 3 spans" in against(amplitude_n=[1.0])
    assert "span 2 would go from 58.5 to 60.5 N; allowed: 3 to 59 N" in against(np.array([28.0, 59.5, 20.0]))
    assert "span 1 would go from 2 to 6 N" in against(np.array([4.0, 36.0, 20.0]))
    wide = {"amplitude_n": [13.0, 0.0, 0.0], "abort": Abort(deviation_n=20.0)}
    assert "step by up to 26 N; allowed: limits.tension_step_max_n, 24 N" in against(**wide)
    assert not against(**wide, rate_n_per_s=20.0)
    assert "at 21 N/s; allowed: moves.tension_rate_n_per_s, 20 N/s" in against(rate_n_per_s=21.0)
    assert "a leg runs at 0.2 m/s; allowed: 0 to 0.12 m/s" in against(legs=[Leg(duration_s=1.0, speed_m_per_s=0.2)])
    drawn = line.model_copy(update={"spans": [line.spans[0].model_copy(update={"control": "draw"}), *line.spans[1:]]})
    assert "span 1 is draw-controlled" in " ".join(reasons_against(experiment(), drawn, BASE, 0.01))


def test_a_torque_turns_round_when_it_comes_back_by_what_counts_in_however_many_periods():
    turns, seen = Turns(np.zeros(1), 1.0), []
    for torque in (3.0, 3.5, 3.0, 6.0, 5.4, 4.9, 4.0, 4.9, 5.1, 1.0):
        seen.append(bool(turns.after(np.array([torque]))[0]))
    assert seen == [False, False, False, False, False, True, False, False, True, True]


def test_noise_turns_torques_round_no_more_than_it_does_and_each_by_itself():
    """Against a zigzag that is counted by its extremes."""
    torque = np.cumsum(np.random.default_rng(3).normal(size=(400, 2)), axis=0)
    turns = Turns(torque[0], 2.0)
    found = np.sum([turns.after(row) for row in torque[1:]], axis=0)
    for column, count in zip(torque.T.tolist(), found.tolist(), strict=True):
        extremes, way = [column[0]], 0
        for value in column:
            if way * (value - extremes[-1]) > 0 or (way == 0 and abs(value - extremes[0]) > 2.0):
                if way == 0:
                    way = 1 if value > extremes[0] else -1
                    extremes.append(value)
                else:
                    extremes[-1] = value
            elif way and abs(value - extremes[-1]) > 2.0:
                extremes.append(value)
                way = -way
        assert count == len(extremes) - 2 > 20


@pytest.mark.parametrize(("period_s", "lasting"), [(0.001, 10), (0.002, 5), (0.01, 1), (0.05, 1)])
def test_a_torque_is_at_a_limit_after_a_way_of_10_ms_whatever_the_period(period_s, lasting):
    assert lasting_periods(period_s) == lasting
    reach = lasting * period_s * 1000.0
    before = np.array([0.0, 0.0, 0.0, 60.0])
    moved = np.array([reach, -reach, 0.9 * reach, 60.0])
    assert at_limit(moved, before, 60.0, reach).tolist() == [True, True, False, True]


def test_the_largest_experiment_fits_into_a_command():
    legs = [Leg(duration_s=12.345678901, speed_m_per_s=0.123456789)] * 20
    asked = experiment(amplitude_n=[1.2345678901234567] * 60, legs=legs, description="x" * 400)
    command = RunExperiment(experiment=asked)
    assert parse_command(command.model_dump_json().encode()) == command
    assert in_words(command) == f"experiment experiment ({experiment_hash(asked)[:12]})"
