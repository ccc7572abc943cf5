"""A drive that answers with old samples is told from one that turns evenly, or has a coarse encoder."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from gateway.core.signals import Inputs
from safety.frozen import REPEATS, FrozenState, find_frozen

TURNING_FROM_M_PER_S = 0.002
COUNT_M_PER_S = 1e-6


def texts_of(speeds_m_per_s: np.ndarray, state: FrozenState | None = None, missed: frozenset[int] = frozenset()):
    """What is said of each period; `speeds_m_per_s` is (periods, 3); in `missed` periods no drive answers."""
    state, inputs = state or FrozenState(), Inputs(3)
    told: list[list[str]] = []
    for k, speeds in enumerate(speeds_m_per_s):
        for i, speed in enumerate(speeds):
            inputs.speed.miss(i) if k in missed else inputs.speed.put(i, float(speed), 0.0)
        told.append([finding.text for finding in find_frozen(TURNING_FROM_M_PER_S, state, inputs)])
    return told


def turning(count: int, seed: int = 1, noise_m_per_s: float = 1e-4, step_m_per_s: float = COUNT_M_PER_S) -> np.ndarray:
    speeds = np.random.default_rng(seed).normal(0.05, noise_m_per_s, (count, 3))
    return np.round(speeds / step_m_per_s) * step_m_per_s


@given(seed=st.integers(0, 1000), roller=st.integers(0, 2), before=st.integers(300, 500))
@settings(max_examples=30, deadline=None)
def test_a_frozen_drive_is_named_after_its_repeats_and_no_other(seed: int, roller: int, before: int) -> None:
    speeds = turning(before + REPEATS, seed)
    assume((speeds[before - 1] != speeds[before - 2]).all())  # no repeat of its own to begin with
    speeds[before:, roller] = speeds[before - 1, roller]
    told = texts_of(speeds)
    assert not any(told[:-1])
    assert len(told[-1]) == 1 and f"roller {roller + 1} " in told[-1][0]


def test_samples_that_do_not_come_neither_count_nor_excuse() -> None:
    speeds = turning(300 + REPEATS + 2)
    speeds[300:, 1] = speeds[299, 1]
    told = texts_of(speeds, missed=frozenset({302, 304}))
    assert not any(told[:-1]) and told[-1]


@pytest.mark.parametrize("step_m_per_s", [2e-5, 1e-4, 1e-3])
def test_a_coarse_encoder_is_never_frozen(step_m_per_s: float) -> None:
    """Noise of one tenth of a millimetre per second; five minutes."""
    assert not any(texts_of(turning(30_000, step_m_per_s=step_m_per_s)))


def test_a_fine_encoder_is_never_frozen_while_it_turns() -> None:
    assert not any(texts_of(turning(30_000)))


def test_rollers_that_stand_show_what_they_like() -> None:
    assert not any(texts_of(np.vstack((turning(300), np.zeros((500, 3)), np.full((500, 3), 0.001)))))


def test_a_drive_that_turns_to_a_coarse_speed_is_learnt_anew() -> None:
    """Short runs of repeats are no fault, and teach that there are such."""
    state = FrozenState()
    assert not any(texts_of(turning(300), state))
    coarse = np.repeat(turning(300, seed=2), 3, axis=0)  # each sample three times
    assert not any(texts_of(coarse, state))
    assert not any(texts_of(np.full((50, 3), coarse[-1]), state))


@pytest.mark.parametrize("counts", [1, 3, 20])
def test_a_ramp_does_not_teach_that_a_coarse_speed_jitters(counts: int) -> None:
    ramp = 0.02 + counts * COUNT_M_PER_S * np.arange(2000)
    steady = np.full(500, ramp[-1])
    assert not any(texts_of(np.repeat(np.concatenate((ramp, steady))[:, None], 3, axis=1)))
