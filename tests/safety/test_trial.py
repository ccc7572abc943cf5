"""When a trial is kept and when it goes back: on looks that were good; those that saw too little count neither way."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from safety.probation import LEAST_TENSION, Look, Unseen
from safety.trial import LOOKED_SHARE, SILENT_S, Trial

PROBATION_S, WINDOW_S, EVERY_S = 30.0, 2.0, 0.25
GOOD, BAD = Look("", ()), Look("tension 3 swings", ())
BLIND = Look("", (Unseen("tension", 3, 0.4, LEAST_TENSION),))


def looked(trial: Trial, found: Look | None, seconds: float, begin_s: float = 0.0) -> tuple[str, float]:
    """What the last look says, and when it was; each sees all telemetry until then."""
    now_s, said = begin_s, ""
    while now_s < begin_s + seconds and not said:
        now_s += EVERY_S
        said = trial.look(found, now_s, now_s)
    return said, now_s


def begun() -> Trial:
    return Trial(PROBATION_S, WINDOW_S)


def test_good_looks_keep_it_once_they_cover_a_third_of_probation() -> None:
    trial = begun()
    least_s = LOOKED_SHARE * PROBATION_S - WINDOW_S  # the first one covers its window
    assert looked(trial, GOOD, least_s)[0] == "" and "cover 10 s of 10 s" in trial.missing()
    assert looked(trial, GOOD, 0.5, least_s)[0] == "" and trial.missing() == ""


def test_a_short_probation_takes_one_look() -> None:
    trial = Trial(5.0, WINDOW_S)
    assert trial.missing()
    looked(trial, GOOD, EVERY_S)
    assert trial.missing() == ""


def test_what_speaks_against_it_is_said_at_once() -> None:
    assert looked(begun(), BAD, 10.0) == (BAD.against, EVERY_S)


def test_looks_that_see_too_little_never_keep_it_and_take_it_back_after_as_long_as_probation() -> None:
    trial = begun()
    said, now_s = looked(trial, BLIND, 10.0 * PROBATION_S)
    assert said == f"too little was seen of it for 30 s: {BLIND.unseen[0]}"
    assert now_s == PROBATION_S + EVERY_S  # from the first look on
    assert (
        "span 3 has told 40% of its samples" in trial.missing() and "neither for it nor against it" in trial.missing()
    )


@pytest.mark.parametrize(("spans", "more"), [(3, ""), (4, "; and 1 more"), (40, "; and 37 more")])
def test_of_many_spans_that_were_not_seen_the_first_are_named(spans: int, more: str) -> None:
    unseen = tuple(Unseen("tension", i + 1, 0.4, LEAST_TENSION) for i in range(spans))
    said, _ = looked(begun(), Look("", unseen), 10.0 * PROBATION_S)
    assert said.endswith(f"{'; '.join(map(str, unseen[:3]))}{more}") and len(said) < 300


def test_it_is_kept_on_a_look_that_was_good_not_on_one_that_was_blind() -> None:
    trial = begun()
    _, now_s = looked(trial, GOOD, 20.0)
    assert trial.missing() == ""
    _, now_s = looked(trial, BLIND, 5.0, now_s)
    assert trial.missing()
    looked(trial, GOOD, EVERY_S, now_s)
    assert trial.missing() == ""


def test_a_line_that_moves_or_does_not_run_is_waited_for() -> None:
    trial = begun()
    _, now_s = looked(trial, None, 10.0 * PROBATION_S)
    assert trial.missing() and not trial.stood and trial.blind_s == 0.0
    looked(trial, GOOD, 10.0, now_s)
    assert trial.stood and trial.missing() == ""


@pytest.mark.parametrize("newest_s", [None, 0.0, float("nan")])
def test_without_telemetry_nothing_is_seen(newest_s: float | None) -> None:
    trial, now_s, said = begun(), SILENT_S + EVERY_S, ""
    while not said and now_s < 10.0 * PROBATION_S:
        said = trial.look(GOOD, newest_s, now_s)
        assert trial.missing()
        now_s += EVERY_S
    assert said.startswith("too little was seen") and "telemetry" in said and trial.looked_s == 0.0


def test_the_same_telemetry_counts_once() -> None:
    trial = begun()
    for k in range(4):
        assert trial.look(GOOD, 0.0, 0.25 * k) == ""
    assert trial.looked_s == WINDOW_S


def test_a_long_while_without_a_look_is_not_held_against_it() -> None:
    trial = begun()
    assert trial.look(BLIND, 0.0, 0.0) == "" and trial.look(BLIND, 1e4, 1e4) == ""
    assert trial.blind_s == 1.0


def test_looks_that_saw_too_little_add_up_over_the_whole_trial() -> None:
    trial, now_s, said, looks = begun(), 0.0, "", 0
    while not said and looks < 10_000:
        looks, now_s = looks + 1, now_s + EVERY_S
        said = trial.look(BLIND if looks % 4 == 0 else None, now_s, now_s)
    assert "too little was seen" in said and looks == 4.0 * PROBATION_S / EVERY_S


@given(st.lists(st.sampled_from([GOOD, BLIND, None]), min_size=1, max_size=400))
def test_whatever_is_seen_it_is_kept_on_good_looks_alone(looks: list[Look | None]) -> None:
    trial, now_s = begun(), 0.0
    for found in looks:
        now_s += EVERY_S
        trial.look(found, now_s, now_s)
    if not trial.missing():
        good = looks.count(GOOD)
        assert WINDOW_S * good >= LOOKED_SHARE * PROBATION_S
        assert [one for one in looks if one is not None][-1] == GOOD or looks[-1] is None
