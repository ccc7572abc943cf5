"""What pulls say of the wiring, judged by themselves: made of the balance that they are judged by, and spoilt."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest

from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from safety.proving import (
    NOTHING_SAID,
    TENSION_SHARE,
    Noise,
    ProvingLimits,
    Pull,
    factor_of,
    proving_limits,
    speed_sign_of,
    way_sign_of,
    zero_allowed_n,
)
from safety.proving_judgement import Judged, judge, judge_zeros
from safety.tensioning import tensioning_speed_m_per_s

N = 3
LINE = load_line(line_template(N, "line.toml"), "line.toml")
LIMITS = proving_limits(LINE)
NOISE = Noise(np.full(N, 0.01), np.full(N, 1e-5), np.full(N, 1e-6))
ZERO_N = np.zeros(N)
WINDOW_S, HALF = 0.5, 8  #: windows of a pull, and as many in which it gives way


def tensions_n(drive: int) -> np.ndarray:
    """(2 HALF, N), in the middle of each window: a drive pulls spans up to its own, then gives way."""
    up = 1.0 - np.exp(-np.arange(1, HALF + 1) / 3.0)
    course = np.concatenate((up, up[-1] * np.exp(-np.arange(1, HALF + 1) / 3.0)))
    spans = np.arange(N) <= drive
    return np.asarray(0.8 * LIMITS.tension_n[drive] * np.outer(course, spans))


def pulled(drive: int, limits: ProvingLimits = LIMITS, speed_sign: int = 1, direction: int = 1) -> Pull:
    """A pull whose balance comes out to the last digit; friction takes what tension does not."""
    shown = tensions_n(drive)
    most = float(limits.torque_nm[drive])
    torque = most * (np.arange(2 * HALF) < HALF)
    radius, friction = limits.prior[drive, 0], limits.prior[drive, 1]
    way = speed_sign * direction * (torque - radius * shown[:, drive]) / friction * WINDOW_S
    still = np.zeros(2 * HALF)  # no momentum, no dry friction
    windows = np.column_stack((torque * WINDOW_S, still + WINDOW_S, way, still, still, shown * WINDOW_S))
    return Pull(
        drive=drive, direction=direction, speed_sign=speed_sign, moved=True, held=False, torque_nm=direction * most,
        way_m=float(way[:HALF].sum()), start_n=np.zeros(N), end_n=shown[HALF - 1], windows=windows,
    )  # fmt: skip


def with_cells(pull: Pull, change: np.ndarray) -> Pull:
    """What the load cells show: `change` (N, N) of the tensions that there are."""
    windows = pull.windows.copy()
    windows[:, 5:] = windows[:, 5:] @ change.T
    return replace(pull, end_n=change @ pull.end_n, windows=windows)


def all_pulls(change: np.ndarray | None = None) -> list[Pull]:
    change = np.eye(N) if change is None else change
    return [with_cells(pulled(drive), change) for drive in reversed(range(N))]


def judged(pulls: list[Pull], line: Line = LINE, limits: ProvingLimits = LIMITS) -> Judged:
    return judge(line, limits, NOISE, ZERO_N, pulls)


def codes(of: Judged) -> list[tuple[str, object]]:
    told = [(finding.rule, finding.parameters) for finding in of.findings]
    return [(code, parameters.get("span", parameters.get("roller"))) for code, parameters in told]


def asked(of: Judged) -> list[tuple[str, object]]:
    return [(each.code, each.parameters.get("span", each.parameters.get("roller"))) for each in of.questions]


# Limits


def test_no_drive_pulls_more_than_the_share_at_its_smallest_radius() -> None:
    for roller, torque_nm in zip(LINE.rollers, LIMITS.torque_nm, strict=True):
        smallest_m = roller.radius_m.value * (1.0 - roller.radius_m.tolerance)
        assert 0.0 < torque_nm / smallest_m <= TENSION_SHARE * LINE.limits.tension_max_n
    assert LIMITS.speed_m_per_s <= tensioning_speed_m_per_s(LINE)


def test_a_weak_drive_and_a_span_that_stands_less_bound_what_is_pulled() -> None:
    weak = LINE.model_copy(update={"rollers": [each.model_copy(update={"torque_nm": 0.1}) for each in LINE.rollers]})
    assert (proving_limits(weak).torque_nm <= 0.1).all()
    tender = [span.model_copy(update={"tension_max_n": 12.0} if i == 0 else {}) for i, span in enumerate(LINE.spans)]
    limits = proving_limits(LINE.model_copy(update={"spans": tender}))
    # Whatever pulls span 3 pulls span 1, too.
    assert limits.tension_n[2] <= TENSION_SHARE * 12.0 and limits.tension_max_n[2] == LIMITS.tension_max_n[2]


# Zeros


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_zero_is_off_either_way_from_its_bound_on(sign: float) -> None:
    allowed = zero_allowed_n(LINE)
    assert judge_zeros(LINE, LIMITS, sign * allowed) == []
    found = judge_zeros(LINE, LIMITS, np.array([0.0, sign * 8.0, 0.0]))
    assert [(each.rule, each.parameters["cell"]) for each in found] == [("cell-zero-off", "load-cell-2")]
    unmeasured = replace(LIMITS, measured=np.array([True, False, True]))
    assert judge_zeros(LINE, unmeasured, np.array([0.0, sign * 8.0, 0.0])) == []


# Factors


@pytest.mark.parametrize("factor", [1.0, 0.5, 2.0])
def test_the_factor_of_a_load_cell_is_what_it_shows_of_a_newton(factor: float) -> None:
    pull = with_cells(pulled(1), np.diag([1.0, factor, 1.0]))
    found = factor_of(LIMITS, NOISE, pull, 1, 1, (2, 1))
    assert found.is_told() and found.value == pytest.approx(factor, rel=0.1)
    assert found.is_surely_off(1.4) == (factor != 1.0)


def test_nothing_is_said_of_a_factor_without_windows_or_tension() -> None:
    pull = pulled(1)
    assert factor_of(LIMITS, NOISE, replace(pull, windows=pull.windows[:2]), 1, 1, None) is NOTHING_SAID
    dead = with_cells(pull, np.diag([1.0, 0.0, 1.0]))
    assert factor_of(LIMITS, NOISE, dead, 1, 1, None).spread > 0.5
    assert factor_of(LIMITS, NOISE, pull, 1, -1, None) is NOTHING_SAID  # with the wrong sign no torque explains it
    assert not NOTHING_SAID.is_surely_off(1.4) and not NOTHING_SAID.is_told() and NOTHING_SAID.spread == inf


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("speed_sign", [1, -1])
def test_friction_tells_the_sign_of_a_speed(speed_sign: int, direction: int) -> None:
    pull = replace(pulled(1, speed_sign=speed_sign, direction=direction), speed_sign=0)
    assert speed_sign_of(LIMITS, NOISE, pull, 1, 1, None) == speed_sign
    assert speed_sign_of(LIMITS, NOISE, replace(pull, windows=pull.windows[:2]), 1, 1, None) == 0
    loud = replace(NOISE, speed_m_per_s=np.full(N, 1.0))
    assert speed_sign_of(LIMITS, loud, pull, 1, 1, None) == 0


# What is judged of all


def going(drive: int, share: float, noise_m: float = 0.0, seed: int = 0) -> Pull:
    """A pull whose encoder shows `share` of the way by which the spans up to its roller have become longer."""
    pull = pulled(drive)
    windows = pull.windows.copy()
    rng = np.random.default_rng(seed)
    told_m = windows[:, 5:] / WINDOW_S @ (LIMITS.compliance_m_per_n * (np.arange(N) <= drive))
    windows[:, 2] = share * np.diff(told_m, prepend=0.0) + noise_m * rng.standard_normal(2 * HALF)
    return replace(pull, windows=windows, speed_sign=0)


OWN_CELLS = [(j, 1) for j in range(N)]


@pytest.mark.parametrize("drive", range(N))
@pytest.mark.parametrize("share", [1.0, 0.5, 2.0])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("direction", [1, -1])
def test_tensions_tell_the_sign_of_the_way_that_an_encoder_shows(
    drive: int, share: float, sign: int, direction: int
) -> None:
    pull = replace(going(drive, sign * share), direction=direction)
    assert way_sign_of(LIMITS, NOISE, pull, OWN_CELLS[: drive + 1]) == sign * direction


def test_an_encoder_that_shows_its_noise_or_a_span_that_nobody_sees_tells_no_sign() -> None:
    shaken = replace(NOISE, way_m=np.full(N, 2e-3))  # as much as the web stretches
    for seed in range(20):
        assert way_sign_of(LIMITS, shaken, going(1, 0.0, 1e-3, seed), OWN_CELLS[:2]) == 0
        assert way_sign_of(LIMITS, NOISE, going(1, 0.0, 1e-5, seed), OWN_CELLS[:2]) == 0
    assert way_sign_of(LIMITS, NOISE, going(1, 0.0), OWN_CELLS[:2]) == 0
    assert way_sign_of(LIMITS, NOISE, going(1, 1.0), OWN_CELLS[:1]) == 0
    assert way_sign_of(LIMITS, NOISE, replace(going(1, 1.0), windows=going(1, 1.0).windows[:2]), OWN_CELLS[:2]) == 0


def test_a_sign_that_noise_told_first_is_set_right_by_the_way_of_the_whole_pull() -> None:
    pulls = [replace(going(drive, 1.0), speed_sign=-1) for drive in reversed(range(N))]
    assert codes(judged(pulls)) == []


def test_a_web_that_settles_under_the_pull_of_another_span_is_no_answer_of_its_own() -> None:
    pulls = all_pulls()
    first = pulls[-1]  # of drive 1
    settles_n = first.end_n + np.array([0.0, 0.0, 0.3 * LIMITS.tension_n[2]])
    assert codes(judged([*pulls[:-1], replace(first, end_n=settles_n)])) == []


@pytest.mark.parametrize("weak", range(N))
def test_a_drive_that_was_held_back_pulls_its_own_span_all_the_same(weak: int) -> None:
    """Where an encoder hides the speed half the torque is all that is given; the others give the whole."""
    scaled = np.concatenate(([0.4], [1.0], 0.4 * np.ones(3 + N)))  # all but the time
    pulls = [
        replace(pull, torque_nm=0.4 * pull.torque_nm, end_n=0.4 * pull.end_n, windows=pull.windows * scaled)
        if pull.drive == weak
        else pull
        for pull in all_pulls()
    ]
    assert codes(judged(pulls)) == []


def test_a_web_that_swings_when_a_pull_ends_has_shown_its_span_before() -> None:
    pulls = all_pulls()
    swings = replace(pulls[1], end_n=0.35 * pulls[1].end_n)
    assert codes(judged([pulls[0], swings, pulls[2]])) == []


def test_a_line_that_is_wired_right() -> None:
    found = judged(all_pulls())
    assert (found.findings, found.questions) == ([], [])
    assert [(each.drive, each.answered) for each in found.drives] == [
        ("drive-1", [1]), ("drive-2", [1, 2]), ("drive-3", [1, 2, 3]),
    ]  # fmt: skip
    assert [(each.cell, each.answered_to) for each in found.cells] == [
        ("load-cell-1", [1, 2, 3]), ("load-cell-2", [2, 3]), ("load-cell-3", [3]),
    ]  # fmt: skip
    assert all(each.way_m > 0.0 and each.torque_nm > 0.0 for each in found.drives)
    assert all(each.factor == pytest.approx(1.0, rel=0.1) for each in found.cells)


def permuted(*order: int) -> np.ndarray:
    return np.eye(N)[list(order)]


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        (np.diag([1.0, -1.0, 1.0]), [("cell-inverted", 2)]),
        (np.diag([1.0, 1.0, 0.0]), [("cell-silent", 3)]),
        (np.diag([0.5, 1.0, 1.0]), [("cell-factor-off", 1)]),
        (np.diag([1.0, 2.0, 1.0]), [("cell-factor-off", 2)]),
        (permuted(1, 0, 2), [("cells-swapped", 1)]),
        (permuted(2, 1, 0), [("cells-swapped", 1)]),
        (permuted(1, 2, 0), [("cell-of-another-span", span) for span in (1, 2, 3)]),
    ],
)
def test_each_mistake_of_a_load_cell_is_named_alone(change: np.ndarray, wanted: list[tuple[str, int]]) -> None:
    assert codes(judged(all_pulls(change))) == wanted


@pytest.mark.parametrize(
    ("direction", "speed_sign", "code"),
    [(-1, 1, "drive-reversed"), (-1, -1, "torque-reversed"), (1, -1, "speed-reversed")],
)
def test_each_way_in_which_a_drive_may_be_reversed(direction: int, speed_sign: int, code: str) -> None:
    pulls = all_pulls()
    pulls[1] = pulled(1, speed_sign=speed_sign, direction=direction)
    assert codes(judged(pulls)) == [(code, 2)]
    pulls[1] = replace(pulls[1], speed_sign=0)  # the balance tells it then
    assert codes(judged(pulls)) == [(code, 2)]


def test_what_cannot_be_shown_is_asked() -> None:
    pulls = all_pulls()
    few = replace(pulls[1], speed_sign=0, windows=pulls[1].windows[:2])
    found = judged([pulls[0], few, pulls[2]])
    assert codes(found) == [] and asked(found) == [("cell-factor-unseen", 2), ("speed-sign-unseen", 2)]
    reversed_ = judged([pulls[0], replace(few, direction=-1), pulls[2]])
    assert codes(reversed_) == [("drive-reversed", 2)]


def stuck(drive: int) -> Pull:
    """Dry friction holds it, whatever it pulls."""
    return replace(
        pulled(drive), direction=0, speed_sign=0, moved=False, end_n=np.zeros(N), windows=np.zeros((0, 5 + N))
    )


def test_rollers_that_do_not_move_are_asked_about_and_their_load_cells_with_them() -> None:
    found = judged([stuck(drive) for drive in range(N)])
    assert codes(found) == []
    assert asked(found) == [("cell-unseen", span) for span in (1, 2, 3)] + [
        ("roller-did-not-move", roller) for roller in (1, 2, 3)
    ]


def test_a_load_cell_whose_own_drive_does_not_move_is_shown_by_the_next_one() -> None:
    pulls = [pulled(2), stuck(1), pulled(0)]
    found = judged(pulls)
    assert codes(found) == [] and asked(found) == [("roller-did-not-move", 2)]


def test_a_drive_that_moves_and_finds_nothing_has_no_web() -> None:
    away = replace(pulled(2), direction=0, end_n=np.zeros(N))
    found = judged([away])
    assert codes(found) == [("no-answer", 3)]


def test_a_span_without_a_load_cell_leaves_its_drive_to_a_person_unless_its_speed_is_wrong() -> None:
    limits = replace(LIMITS, measured=np.array([False, False, True]))
    spans = [span.model_copy(update={"control": "draw"}) if i < 2 else span for i, span in enumerate(LINE.spans)]
    line = LINE.model_copy(update={"spans": spans, "load_cells": LINE.load_cells[2:]})
    blind = np.diag([0.0, 0.0, 1.0])
    held = [replace(with_cells(pulled(drive), blind), held=True) for drive in (0, 1)]
    found = judged([with_cells(pulled(2), blind), *held], line, limits)
    assert codes(found) == [] and asked(found) == [("drive-direction-unseen", 1), ("drive-direction-unseen", 2)]
    found = judged([with_cells(pulled(2), blind), replace(held[0], speed_sign=-1), held[1]], line, limits)
    assert codes(found) == [("speed-reversed", 1)]


def test_a_drive_of_a_span_without_a_load_cell_is_shown_by_one_of_the_spans_before() -> None:
    limits = replace(LIMITS, measured=np.array([True, False, True]))
    blind = np.diag([1.0, 0.0, 1.0])
    pulls = [with_cells(pulled(drive), blind) for drive in (2, 1, 0)]
    assert judged(pulls, limits=limits).questions == []
    pulls[1] = replace(pulls[1], speed_sign=0)
    found = judged(pulls, limits=limits)
    assert codes(found) == [] and asked(found) == [("speed-sign-unseen", 2)]


def test_a_held_roller_whose_load_cell_shows_nothing_has_a_silent_one() -> None:
    blind = np.diag([0.0, 1.0, 1.0])
    pulls = [
        with_cells(pulled(2), blind),
        with_cells(pulled(1), blind),
        replace(with_cells(pulled(0), blind), held=True),
    ]
    found = judged(pulls)
    assert codes(found) == [("cell-silent", 1)] and asked(found) == [("drive-direction-unseen", 1)]
