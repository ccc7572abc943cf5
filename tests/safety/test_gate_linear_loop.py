"""Rules on the linear loop at the corners of what is believed: decay and delay margin."""

from dataclasses import replace
from math import inf
from types import SimpleNamespace

import numpy as np
import pytest

from gateway.control.design import design_lqi, design_scheduled, task_of
from gateway.control.design.task import linear
from gateway.core.line import Parameter
from gateway.core.line_model import noise_of
from gateway.core.theta import Noise
from safety.findings import at_least
from safety.rules import decay, delay_margin
from tests.safety.case_support import case_of, gains


def test_decay_at_its_limit(of, context, redesigned):
    def found(**gate):
        return decay.check(case_of(gains(redesigned, context), context, of, **gate))[0]

    rate = found().value
    assert found(decay_min_per_s=rate - 1e-9).passed and not found(decay_min_per_s=rate + 1e-9).passed


def test_gains_without_end_have_no_decay(of, context, redesigned, monkeypatch):
    monkeypatch.setattr(decay, "closed_loop", lambda form, plant: np.full((3, 3), inf))
    found = decay.check(case_of(gains(redesigned, context), context, of))[0]
    assert not found.passed and found.value is None


def judged_between(monkeypatch, module, slow_m_per_s, fast_m_per_s):
    speeds = SimpleNamespace(slow_m_per_s=slow_m_per_s, fast_m_per_s=fast_m_per_s)
    monkeypatch.setattr(module, "judged_of", lambda _: speeds)


def drawn(of, length_m):
    """The line with span 2 by draw, of a length that is known."""
    length = Parameter(value=length_m, tolerance=1e-300)
    spans = [span.model_copy(update={"control": "draw", "length_m": length}) if i == 1 else span
             for i, span in enumerate(of.line.spans)]  # fmt: skip
    return replace(of, line=of.line.model_copy(update={"spans": spans}))


def test_decay_is_told_where_there_is_the_least_room_to_what_is_allowed(case, monkeypatch):
    judged_between(monkeypatch, decay, 0.01, 0.05)

    def found(believed, others=((0.25, 0.05), (0.25, 0.05))):  # rate and limit, each slow and fast
        def figure(which):
            return lambda theta, speed: (believed if theta is case.believed else others)[speed == 0.05][which]

        monkeypatch.setattr(decay, "decay_per_s", lambda _, __, theta, speed: figure(0)(theta, speed))
        monkeypatch.setattr(decay, "_least", lambda _, theta, speed: figure(1)(theta, speed))
        return decay.check(case)

    text = (
        "the slowest mode decays at 0.4 1/s at 0.05 m/s on the worst of 9 plants that the line may be; allowed: 0.35 "
        "1/s and more (gate.decay_min_per_s)"
    )
    assert found(((0.3, 0.1), (0.4, 0.35))) == [at_least("decay", 0.4, 0.35, "1/s", text)]
    text = (
        "the loop is unstable at 0.01 m/s on the worst of 9 plants that the line may be; allowed: 0.05 1/s and more "
        "(gate.decay_min_per_s)"
    )
    for rate in (0.0, -1.0):
        assert found(((rate, 0.05), (2.0, 0.05))) == [at_least("decay", rate, 0.05, "1/s", text)]


@pytest.mark.parametrize(("fast_m_per_s", "said", "least"), [(0.05, "0.05", 0.0125), (0.5, "0.5", 0.05)])
def test_of_a_draw_span_half_of_what_it_has_by_itself_is_enough(
    of, context, redesigned, monkeypatch, fast_m_per_s, said, least
):
    bare, of = context.model_copy(update={"model": None}), drawn(of, 2.0)
    judged_between(monkeypatch, decay, 0.01, fast_m_per_s)
    monkeypatch.setattr(decay, "decay_per_s", lambda *_: 1.0)
    text = (
        f"the slowest mode decays at 1 1/s at {said} m/s on the worst of 9 plants that the line may be; allowed: "
        f"{least} 1/s and more (gate.decay_min_per_s, or half of what a draw span has by itself)"
    )
    assert decay.check(case_of(gains(redesigned, bare), bare, of)) == [at_least("decay", 1.0, least, "1/s", text)]


def test_only_a_draw_span_is_looked_at_just_above_standstill(of, context, case, monkeypatch):
    looked_at: list[float] = []

    def seen(task):
        looked_at.append(task.unwind_speed_m_per_s)
        return linear(task)

    monkeypatch.setattr(decay, "linear", seen)
    assert decay.decay_per_s(case.controller, case, case.believed, 0.0) > 1.0
    bare, of = context.model_copy(update={"model": None}), drawn(of, 2.0)
    by_draw = case_of(gains(design_lqi(task_of(of.line)), bare), bare, of)
    # Its tension goes out with the web that leaves the span: at rest it would stay for ever.
    assert decay.decay_per_s(by_draw.controller, by_draw, by_draw.believed, 0.0) == pytest.approx(1e-6 / 2.0, rel=0.02)
    assert looked_at == [0.0, 1e-6]


def test_delay_margin_is_told_of_the_speed_at_which_the_loop_stands_least(of, context, redesigned, monkeypatch):
    late = context.model_copy(update={"latency_s": 0.15})
    case = case_of(gains(redesigned, late), late, of, delay_margin_min_s=0.12)
    judged_between(monkeypatch, delay_margin, 0.01, 0.05)

    def found(slow_s, fast_s):
        stood_s = {(0.01, 0.24): slow_s, (0.05, 0.24): fast_s}  # looked at up to twice the limit
        monkeypatch.setattr(delay_margin, "stands_s", lambda _, speed, most_s: stood_s[speed, most_s])
        return delay_margin.check(case)

    text = (
        "the loop stands 230.0 ms beyond a latency of 150.0 ms, at 0.05 m/s; allowed: gate.delay_margin_min_s, 120 ms, "
        "and more"
    )
    assert found(0.24, 0.23) == [at_least("delay margin", 0.23, 0.12, "s", text)]
    text = (
        "the loop stands 240.0 ms or more beyond a latency of 150.0 ms, at 0.01 m/s; allowed: gate.delay_margin_min_s, "
        "120 ms, and more"
    )
    assert found(0.24, 0.24) == [at_least("delay margin", 0.24, 0.12, "s", text)]


@pytest.mark.parametrize(("fast_m_per_s", "speeds"), [(0.03, [0.01, 0.02, 0.03]), (0.07, [0.01, 0.02, 0.05, 0.07])])
def test_of_a_schedule_each_law_up_to_the_fastest_speed_is_asked_for_its_delay_margin(
    of, context, monkeypatch, fast_m_per_s, speeds
):
    schedule = design_scheduled(of.task(), design_lqi, [0.02, 0.05])
    judged_between(monkeypatch, delay_margin, 0.01, fast_m_per_s)
    asked: list[float] = []
    monkeypatch.setattr(delay_margin, "stands_s", lambda _, speed, __: asked.append(speed) or 0.008)
    delay_margin.check(case_of(gains(schedule, context), context, of))
    assert asked == speeds


@pytest.mark.parametrize(
    ("rates_per_s", "most_s", "stood_s"),
    [
        ([1.0] * 20, 0.008, 0.008),
        ([1.0] * 20, 0.0001, 0.001),  # one step is looked at whatever the limit
        ([1.0] * 8 + [-1.0] * 9, 0.008, 0.007),
        ([1.0] * 3 + [0.0] + [1.0] * 9, 0.008, 0.002),
        ([-1.0] + [1.0] * 9, 0.008, -0.001),
        ([1.0] * 10, 0.0084, 0.009),  # as far as is asked for, and not a part of a millisecond less
    ],
)
def test_the_loop_stands_up_to_the_last_millisecond_before_the_first_that_does_not_decay(
    case, monkeypatch, rates_per_s, most_s, stood_s
):
    monkeypatch.setattr(delay_margin, "decay_per_s", lambda *given: rates_per_s[round(given[-1] / 0.001)])
    assert delay_margin.stands_s(case, 0.05, most_s) == pytest.approx(stood_s, abs=1e-12)


def test_delay_margin_at_its_limit_for_a_law_and_for_a_schedule(of, context, redesigned):
    def stood(config, **gate):
        return delay_margin.check(case_of(gains(config, context), context, of, **gate))[0]

    found = stood(redesigned, delay_margin_min_s=0.05)
    assert not found.passed and 0.004 < found.value < 0.05
    assert stood(redesigned, delay_margin_min_s=found.value).passed
    assert not stood(redesigned, delay_margin_min_s=found.value + 5e-4).passed
    assert stood(redesigned).passed and "or more" in stood(redesigned).text
    schedule = design_scheduled(of.task(), design_lqi, [0.02, 0.05])
    assert stood(schedule).passed
    assert decay.check(case_of(gains(schedule, context), context, of))[0].passed


def test_the_linear_loop_is_that_of_what_is_believed_and_of_the_set_points_of_now(of, context, case):
    task = case.task(case.believed, 0.03)
    assert task.tension_n.tolist() == context.state.tension_n != of.line.recipes[0].tension_n
    assert task.noise == noise_of(context.model) != Noise()
    assert task.unwind_speed_m_per_s == 0.03 and task.model == case.believed.web
