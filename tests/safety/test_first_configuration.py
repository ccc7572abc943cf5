"""What speaks against a configuration that nobody has judged: from tensions, set-points and what a law asks for."""

import numpy as np
import pytest

from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from safety.actions import Action
from safety.first_configuration import FirstState, first_limits, look_at_first

N = 3
LINE = load_line(line_template(N, "line.toml"), "line.toml")
LIMITS = first_limits(LINE)
SETPOINT_N = np.array([28.0, 36.0, 20.0])
STILL = np.zeros(N)


def told(errors_n, asks_nm, setpoint_n=SETPOINT_N, limits=LIMITS):
    """The first finding of a course of errors (k, n) of tensions, and of torques that are asked for; nothing before."""
    state, sent_nm = FirstState(), STILL
    for error_n, asked_nm in zip(errors_n, asks_nm, strict=True):
        found = look_at_first(limits, state, setpoint_n + error_n, setpoint_n, asked_nm, sent_nm)
        if found:
            return found
        sent_nm = np.clip(asked_nm, sent_nm - limits.step_nm, sent_nm + limits.step_nm)
    return []


def of_span(span, values):
    course = np.zeros((len(values), N))
    course[:, span] = values
    return course


GROWS_N = 0.25 * 1.5 ** np.arange(14)


@pytest.mark.parametrize("span", range(N))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_tension_that_grows_and_is_driven_on_is_found_before_it_leaves_its_band(span, sign):
    error_n = sign * GROWS_N
    (found,) = told(of_span(span, error_n), of_span(span, 20.0 * error_n))
    assert (found.rule, found.action) == ("first-diverges", Action.BRAKE)
    assert found.parameters is not None and found.parameters["span"] == span + 1
    tension_n = float(found.parameters["tension_n"])
    assert LINE.limits.tension_min_n < tension_n < LINE.limits.tension_max_n


def test_what_is_driven_back_is_left_alone_however_it_grows():
    assert not told(of_span(0, GROWS_N[:10]), of_span(0, -4.0 * GROWS_N[:10]))


def test_what_comes_back_by_itself_is_left_alone():
    assert not told(of_span(0, GROWS_N[:10][::-1]), of_span(0, 4.0 * GROWS_N[:10]))


def test_small_errors_are_noise():
    small_n = 0.1 * 1.2 ** np.arange(10)
    assert not told(of_span(0, small_n), of_span(0, 30.0 * small_n))


def test_a_span_without_a_load_cell_says_nothing():
    blind = first_limits(
        LINE.model_copy(update={"spans": [LINE.spans[0].model_copy(update={"control": "draw"}), *LINE.spans[1:]]})
    )
    assert not told(of_span(0, GROWS_N), of_span(0, 4.0 * GROWS_N), limits=blind)


def test_while_tensions_come_up_from_below_their_band_nothing_is_too_low():
    low_n = np.full(N, 1.0)
    assert not told(of_span(0, -0.02 * np.arange(10)), of_span(0, -np.arange(10.0)), setpoint_n=low_n)


def test_a_span_is_up_once_it_has_been_above_the_lower_edge_for_the_window() -> None:
    low_n, window = LINE.limits.tension_min_n, LIMITS.window

    def falls_after(periods_up: int) -> list[str]:
        up_n = np.full(periods_up, SETPOINT_N[0])
        tension_n = np.concatenate(([0.5 * low_n], up_n, SETPOINT_N[0] - GROWS_N))
        error_n = tension_n - SETPOINT_N[0]
        asks_nm = np.where(np.arange(len(error_n)) > periods_up, 20.0 * error_n, 0.0)
        return [each.rule for each in told(of_span(0, error_n), of_span(0, asks_nm))]

    assert falls_after(window + 1) == ["first-diverges"]
    assert falls_after(window // 2) == []


def flips_nm(size_nm, periods=60):
    return of_span(1, size_nm * (-1.0) ** np.arange(periods))


def test_torques_that_are_asked_for_from_edge_to_edge_chatter():
    (found,) = told(np.zeros((60, N)), flips_nm(6.0 * LIMITS.step_nm))
    assert (found.rule, found.action) == ("first-chatters", Action.BRAKE)
    assert found.parameters is not None and float(found.parameters["times"]) >= 6.0


def test_noise_that_a_law_answers_to_within_what_a_torque_may_do_is_no_chattering():
    assert not told(np.zeros((60, N)), flips_nm(1.5 * LIMITS.step_nm))


def test_one_great_step_is_no_chattering():
    asked_nm = np.zeros((60, N))
    asked_nm[20:, 2] = 1e6
    assert not told(np.zeros((60, N)), asked_nm)
