"""Rules that hold a model against recent data: is it still valid, and is nothing late?"""

from dataclasses import replace
from math import inf, nan
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gateway.control.prediction import gains_of, imagined, innovations, predict, stretch_of, whitened
from gateway.core.line_model import noise_of, theta_of
from gateway.core.theta import Noise
from safety import predicting
from safety.excitation import excited_parts, newest, recent, same_speed
from safety.findings import at_least, at_most, told
from safety.predicting import Foretold, foretold, with_swings
from safety.rules import alignment, validity
from tests.safety.case_support import case_of, gains, refused, with_state


def test_validity_at_its_limits(of, context, case, redesigned):
    value = validity.check(case)[0].value
    assert value == pytest.approx(1.0, abs=0.1)

    def found(**gate):
        return validity.check(case_of(gains(redesigned, context), context, of, **gate))[0]

    assert found(innovation_low=0.5, innovation_high=value + 1e-9).passed
    assert not found(innovation_low=0.5, innovation_high=value - 1e-9).passed
    assert found(innovation_low=value - 1e-9, innovation_high=1.9).passed
    assert not found(innovation_low=value + 1e-9, innovation_high=1.9).passed


def test_one_load_cell_that_the_model_does_not_explain_is_enough(of, context, redesigned):
    def found(**noise):
        model = of.model.model_copy(update={"noise": of.model.noise.model_copy(update=noise)})
        return refused(
            validity.check(case_of(gains(redesigned, context), context.model_copy(update={"model": model}), of))
        )

    assert "up to 1.5" in found(tension_n=0.06)[0]
    assert "takes the noise for greater" in found(tension_n=0.25)[0]


@pytest.mark.parametrize(
    ("value", "each", "limit", "text"),
    [
        (0.9, [1.0, 0.5, 1.51], (at_most, 1.51, 1.5), "is 1.51 of speed 2; allowed: up to 1.5: identify again"),
        (
            1.1, [1.0, 0.49, 1.5], (at_least, 0.49, 0.5),
            "is 0.49 of tension 2; allowed: 0.5 and more: the model takes the noise for greater than it is",
        ),
        (0.9, [1.0, 0.5, 1.5], (at_least, 0.9, 0.8), "is 0.900; allowed: 0.8 to 1.2"),
        (1.0, [1.0, 0.5, 1.5], (at_most, 1.0, 1.2), "is 1.000; allowed: 0.8 to 1.2"),
        (1.25, [1.0, 1.0, 1.0], (at_most, 1.25, 1.2), "is 1.250; allowed: 0.8 to 1.2"),
    ],
)  # fmt: skip
def test_validity_tells_first_of_what_is_loud_then_of_what_is_quiet_then_of_all(
    of, case, monkeypatch, value, each, limit, text
):
    names = ["tension 1", "tension 2", "speed 2"]
    monkeypatch.setattr(validity, "foretold_of", lambda *_: [])
    monkeypatch.setattr(validity, "by_speed", lambda _, _line: [(0.0512, [])])
    monkeypatch.setattr(validity, "seconds", lambda _: 12.34)
    monkeypatch.setattr(validity, "normalised", lambda _: value)
    monkeypatch.setattr(validity, "normalised_by_output", lambda _: (names, np.array(each)))
    finding, figure, bound = limit
    said = f"normalised innovation squared at 0.0512 m/s over 12.3 s {text}"
    assert validity.of_model(case, of.model, "proposed") == [finding("proposed", figure, bound, "", said)]


def test_models_that_cannot_be_looked_at_are_not_valid(of, context, redesigned):
    silent = of.model.model_copy(update={"noise": None})
    case = case_of(gains(redesigned, context), context.model_copy(update={"model": silent}), of)
    unknown = "the model says nothing of the noise, so nobody can tell what it explains"
    assert validity.check(case)[0] == told("model validity", False, unknown)
    without = "there are no data by which channels could be compared: see model validity"
    assert alignment.check(case) == [told("alignment", False, without)]
    none = case_of(gains(redesigned, context), context.model_copy(update={"model": None}), of)
    assert validity.check(none) == [
        told("model validity", False, "no model is accepted, and none is needed for a first configuration")
    ]
    assert alignment.check(none) == [
        told("alignment", False, "no model is accepted by which channels could be compared")
    ]


def test_data_that_are_too_old_or_too_quiet_are_told_from_each_other(of, context, redesigned):
    still = replace(of, recording=replace(of.recording, tension_n=np.full_like(of.recording.tension_n, 30.0)))

    def found(*ages_d):
        recorded = [f"2026-08-{20 - age_d}T14:00:00+00:00" for age_d in ages_d]
        (data,) = still.context().data
        asked = still.context(
            now="2026-08-20T15:00:00+00:00", data=[data.model_copy(update={"recorded": one}) for one in recorded]
        )
        return validity.check(case_of(gains(redesigned, asked), asked, still))

    lacking = (
        "none has 2 s at one speed in which every tension moves by 2 times its noise; run an experiment at 0.05 m/s or "
        "more (r2rgate experiment), then propose again"
    )
    for ages_d, had in (
        ((), "0 recordings"),
        ((0, 1), "2 recordings"),
        ((0, 1, 8), "3 recordings, 1 of them older than 604800 s"),
        ((8, 0, 9), "3 recordings, 2 of them older than 604800 s"),
    ):
        text = f"no recent data show the model: of {had}, {lacking}"
        assert found(*ages_d) == [told("model validity", False, text)]


@pytest.mark.parametrize(("factor", "share", "more"), [(1.0, 0.05, 0.0), (0.2, 0.0, 2e-3)])
def test_the_line_runs_no_faster_than_data_have_shown_but_for_a_twentieth_or_two_millimetres_a_second(
    of, redesigned, factor, share, more
):
    at = replace(of, recording=replace(of.recording, unwind_speed_m_per_s=factor * of.recording.unwind_speed_m_per_s))

    def found(speed_m_per_s):
        context = with_state(at.context(), speed_m_per_s=speed_m_per_s)
        return validity.check(case_of(gains(redesigned, context), context, at))[-1]

    (part,) = excited_parts(at.recording, at.line)
    shown = part.speed_m_per_s
    most = (1.0 + share) * shown + more
    faster = most + 1e-9
    said = f"data have shown the model up to {shown:.3g} m/s; the line runs at {most:g} m/s"
    assert found(most) == at_most("model validity", most, most, "m/s", said)
    said += f": run an experiment at {faster:g} m/s or more (r2rgate experiment), then propose again"
    assert found(faster) == at_most("model validity", faster, most, "m/s", said)
    assert not found(faster).passed


def test_parts_at_one_speed_are_judged_together(of, context, redesigned):
    twice = of.context(data=[*context.data, *context.data])
    found = validity.check(case_of(gains(redesigned, context), twice, of))
    assert len(found) == 2 and "over 5.2 s" in found[0].text


@pytest.mark.parametrize(("shaken_m_per_s", "way"), [(1e-3, "held"), (5e-3, "linear")])
def test_between_samples_the_unwinder_goes_the_way_that_explains_more(of, case, shaken_m_per_s, way):
    (part,) = excited_parts(of.recording, of.line)
    recording = part.recording
    shaken = np.random.default_rng(1).standard_normal(recording.samples) * shaken_m_per_s
    recording = replace(recording, unwind_speed_m_per_s=recording.unwind_speed_m_per_s + shaken)
    (found,) = foretold(case.believed, case.noise, [replace(part, recording=recording)])
    said = {way: predict(case.believed, case.noise, stretch_of(recording, way)) for way in ("linear", "held")}
    likely = {way: one.log_likelihood.sum() for way, one in said.items()}
    assert max(likely, key=likely.get) == way == found.predicted.stretch.unwinder
    assert found.predicted.log_likelihood.sum() == max(likely.values()) > min(likely.values()) + 0.5


@pytest.mark.parametrize("channel", ["tension_n", "speed_m_per_s"])
def test_a_channel_that_is_late_is_found(of, context, redesigned, channel):
    values = getattr(of.recording, channel).copy()
    values[1:, 2] = values[:-1, 2]
    late = replace(of, recording=replace(of.recording, **{channel: values}))
    given = gains(redesigned, late.context())
    found = alignment.check(case_of(given, late.context(), late))[0]
    assert not found.passed and found.value > 0.004
    # A speed that is late and a torque that is early are one and the same to its roller.
    assert found.text.startswith("tension 3" if channel == "tension_n" else ("speed 3", "torque 3"))


def test_alignment_at_its_limit_and_data_that_do_not_tell(of, context, case, redesigned):
    def found(**gate):
        return alignment.check(case_of(gains(redesigned, context), context, of, **gate))[0]

    assert found().passed and found().value < 0.001
    assert "do not tell" in found(alignment_max_s=1e-6).text and not found(alignment_max_s=1e-6).passed


def test_alignment_tells_of_the_channel_that_is_late_at_the_least_by_most(of, case, monkeypatch):
    def found(late_s, spread_s, of_case=case):
        figures = (np.array(late_s + [0.0] * 8), np.array(spread_s + [1.0] * 8))
        monkeypatch.setattr(alignment, "lateness", lambda *_: figures)
        return alignment.of_model(of_case, of.model, "proposed")

    # The first is late by more, and nobody knows it as well; the last is not known at all.
    late_s, spread_s = [4e-3, -3e-3, *[1e-4] * 7, 9e-3], [1e-3, 2e-4, *[1e-4] * 7, 2e-3]
    text = (
        "tension 2 tells -3.0 ms late, within 0.4 ms; allowed: gate.alignment_max_s, 2 ms either way, as far as its "
        "interval goes; 9 of 18 channels tell"
    )
    assert found(late_s, spread_s) == [at_most("proposed", 3e-3 - 1.96 * 2e-4, 2e-3, "s", text)]
    # 60 s late says itself to the tenth of a millisecond, and what is known as well as it must be is known.
    (told_late,) = found([60.0, *[0.0] * 9], [1e-4, *[2e-3 / 1.96] * 9])
    assert told_late.text.startswith("tension 1 tells +60000.0 ms late, within 0.2 ms;")
    assert told_late.text.endswith("10 of 18 channels tell")
    (told_late,) = found([60.0, *[0.0] * 9], [1.0, *[1e-4] * 9])
    assert told_late.text.endswith("9 of 18 channels tell")
    gate = case.line.gate.model_copy(update={"alignment_max_s": 1.0})
    wide = replace(case, line=case.line.model_copy(update={"gate": gate}))
    (told_late,) = found([60.0, *[0.0] * 9], [0.5, *[1e-4] * 9], wide)
    assert told_late.text.startswith(
        "tension 1 tells +60000.0 ms late, within 980.0 ms; allowed: gate.alignment_max_s, 1000 ms"
    )
    text = "the data do not tell whether channels are aligned: a longer or larger experiment"
    assert found(late_s, [2e-3] * 10) == [told("proposed", False, text)]


def test_alignment_looks_at_the_newest_data_only(of, case, monkeypatch):
    asked: list[float] = []
    kept = alignment.foretold_of

    def foretold_of(of_case, model, noise, most_s):
        asked.append(most_s)
        return kept(of_case, model, noise, most_s)

    monkeypatch.setattr(alignment, "foretold_of", foretold_of)
    alignment.of_model(case, of.model)
    assert asked == [alignment.MOST]


def test_what_is_kept_of_a_prediction_is_of_the_noise_that_is_asked_for(of, case):
    own = noise_of(of.model)
    other = replace(own, tension_n=2.0 * own.tension_n)
    calm, loud = (predicting.normalised(predicting.foretold_of(case, of.model, noise)) for noise in (own, other))
    assert loud < 0.9 * calm
    assert predicting.normalised(predicting.foretold_of(case, of.model, own)) == calm


@pytest.mark.parametrize(("latency_s", "same"), [(0.004, True), (0.01, False), (0.02, False)])
def test_a_torque_that_acts_within_a_period_is_held_against_the_slope_before_it_alone(of, case, latency_s, same):
    theta = replace(theta_of(of.model), latency_s=latency_s)
    (predicted, *_) = (one.predicted for one in alignment.foretold_of(case, of.model, Noise(), alignment.MOST))
    (before, after), _ = alignment.sensitivities(theta, predicted)
    torques = slice(-predicted.stretch.n, None)
    assert np.array_equal(before[: torques.start], after[: torques.start])
    assert np.array_equal(before[torques], after[torques]) == same


def test_lateness_is_that_of_least_squares_over_all_parts(case, monkeypatch):
    # By hand: 1*2 + 1*4 of one part and 2*3 of the other, over 1 + 1 + 4. The second channel shows nothing. The third
    # explains 6**2 / 2 by the slope from before and (2*2 + 3*4)**2 / 13 by that to the next: 19.7, which is more. The
    # fourth shows little, 0.5*2 over 0.25, and is told all the same.
    little, none = [[0.5], [0.0]], [[0.0]]
    before = [[[1.0], [1.0]], [[0.0], [0.0]], [[1.0], [1.0]], little], [[[2.0]], none, none, none]
    after = [[[1.0], [1.0]], [[0.0], [0.0]], [[2.0], [3.0]], little], [[[2.0]], none, none, none]
    white = [[2.0], [4.0]], [[3.0]]
    parts = [(np.array([before[k], after[k]]), np.array(white[k])) for k in (0, 1)]
    monkeypatch.setattr(alignment, "sensitivities", lambda _, predicted: predicted.figures)
    monkeypatch.setattr(alignment, "channels", lambda _: ["one", "other", "third", "fourth"])
    found: list[Any] = [SimpleNamespace(predicted=SimpleNamespace(stretch=None, figures=one)) for one in parts]
    with np.errstate(all="raise"):  # nobody is bothered with a channel that shows nothing
        late_s, spread_s = alignment.lateness(case.believed, found)
    assert late_s == pytest.approx([2.0, 0.0, 16.0 / 13.0, 4.0]) and spread_s == pytest.approx(
        [6.0**-0.5, inf, 13.0**-0.5, 2.0]
    )


@pytest.mark.parametrize(
    ("channel", "later", "told_late_ms"), [("tension_n", 1, 10.5), ("torque_nm", 1, 10.0), ("torque_nm", -1, -10.0)]
)
def test_what_is_told_a_period_late_or_early_tells_just_that(of, redesigned, channel, later, told_late_ms):
    values = getattr(of.recording, channel).copy()
    values[:, 2] = np.roll(values[:, 2], later)
    late = replace(of, recording=replace(of.recording, **{channel: values}))
    (found,) = alignment.check(case_of(gains(redesigned, late.context()), late.context(), late))
    name, _, number = found.text.partition(" tells ")
    assert name == f"{channel.partition('_')[0]} 3" and float(number.split()[0]) == pytest.approx(told_late_ms, abs=0.6)
    assert found.text.endswith("18 of 18 channels tell") and not found.passed


def test_rollers_out_of_round_are_known_as_they_were_learned(of, case):
    round_theta, stretch = theta_of(of.model), stretch_of(case.excited[0].recording)
    noise, swing = Noise(), np.zeros((6, 2))
    swing[2] = 1e-2, -5e-3
    gains_ = gains_of(round_theta, noise, stretch)
    random = np.random.default_rng(1).standard_normal((stretch.predictions, len(stretch.outputs)))
    innovation = np.einsum("kij,kj->ki", gains_.factor[gains_.which], random)
    measured = imagined(round_theta, replace(stretch, swing=swing), gains_, innovation).measured
    eccentric = replace(round_theta, eccentricity=np.array([0.0, 0.0, 1.5e-2, 0.0, 0.0, 0.0]))
    predicted = predict(eccentric, noise, replace(stretch, measured=measured))
    known = with_swings(predicted)  # from half a turn
    assert known.swing[2] == pytest.approx(swing[2], abs=1e-3) and not known.swing[[0, 1, 3, 4, 5]].any()
    white, as_round = (
        np.square(whitened(innovations([round_theta], one, predicted.gains)[0], predicted.gains)).mean()
        for one in (known, replace(stretch, measured=measured))
    )
    assert white < 1.1 and as_round > 1.1
    late_s, _ = alignment.lateness(eccentric, [Foretold(case.excited[0], predicted)])
    assert np.abs(late_s).max() < 1e-3


def test_a_measured_latency_is_what_is_judged_by(of, context, redesigned):
    slow = context.model_copy(update={"latency_s": 0.017})
    case = case_of(gains(redesigned, context), slow, of)
    assert case.latency_s == case.believed.latency_s == 0.017
    assert {theta.latency_s for theta in case.corners} == {0.017}


def test_excited_parts_are_at_one_speed_and_move(of):
    recording = of.recording
    (part,) = excited_parts(recording, of.line)
    assert part.speed_m_per_s == pytest.approx(0.05, abs=1e-4) and part.movement_n > 1.0
    standing = replace(recording, tension_n=np.where(np.arange(6) == 3, 30.0, recording.tension_n))
    assert excited_parts(standing, of.line) == []
    half = recording.samples // 2
    speed = np.where(np.arange(recording.samples) < half, 0.05, 0.1)
    assert excited_parts(replace(recording, unwind_speed_m_per_s=speed), of.line) == []
    draws = replace(recording, tension_n=np.full_like(recording.tension_n, nan))
    assert excited_parts(draws, of.line)[0].movement_n == inf


def test_old_and_future_data_do_not_count(of, context):
    def kept(now):
        return len(recent(context.model_copy(update={"now": now}), [of.recording], 604_800.0))

    assert kept("2026-08-10T14:00:00+00:00") == 1
    assert kept("2026-08-10T14:00:01+00:00") == 0
    assert kept("2026-08-03T13:59:59+00:00") == 0


def test_of_much_data_the_newest_are_looked_at_and_every_speed(of):
    (part,) = excited_parts(of.recording, of.line)
    slow = replace(part, speed_m_per_s=0.01)
    assert newest([part] * 5 + [slow] * 5, of.line, 250.0) == [part, part, slow]
    part_s = part.recording.samples * part.recording.period_s
    assert (
        newest([part] * 3, of.line, part_s / 0.02) == [part]
        and newest([part] * 3, of.line, (part_s + 0.5) / 0.02) == [part] * 2
    )
    assert same_speed(0.004, 0.002, of.line) and same_speed(0.002, 0.004, of.line), "as far apart as one speed may be"
    assert (
        same_speed(0.05, 0.0524, of.line) and same_speed(0.002, 0.0039, of.line) and not same_speed(0.1, 0.106, of.line)
    )
