"""Portmanteau statistics and spectral lines, on sequences whose nature is known."""

import numpy as np
import pytest

from gateway.identification.validation import normalised_band
from gateway.identification.whiteness import portmanteau, portmanteau_of_all, strongest_line


def white(samples, m, seed):
    return np.random.default_rng(seed).standard_normal((samples, m))


def coloured(samples, seed, pole):
    steps = white(samples, 1, seed)[:, 0]
    found = np.zeros(samples)
    for k in range(1, samples):
        found[k] = pole * found[k - 1] + steps[k]
    return found


def test_white_sequences_pass_as_often_as_the_risk_says():
    denied = [portmanteau_of_all([white(500, 4, seed)], 0.1) > 1.0 for seed in range(300)]
    assert 0.04 < np.mean(denied) < 0.17


def test_colour_is_seen_in_one_output_and_between_two():
    assert portmanteau([coloured(500, 1, 0.3)], 0.01) > 1.0
    late = white(500, 1, 2)
    pair = np.hstack((late, np.roll(late, 1, axis=0)))
    assert portmanteau_of_all([pair], 0.01) > 1.0
    assert all(portmanteau([pair[:, j]], 0.01) < 1.0 for j in range(2))


def test_parts_are_not_joined_and_size_does_not_matter():
    parts = [white(200, 3, 3), white(300, 3, 4)]
    assert portmanteau_of_all(parts, 0.01) == pytest.approx(portmanteau_of_all([10.0 * part for part in parts], 0.01))
    assert portmanteau_of_all(parts, 0.01) < 1.0
    assert np.isnan(portmanteau_of_all([white(30, 3, 5)], 0.01))


def test_a_spectral_line_is_found_where_it_is():
    noise = white(1000, 3, 6)
    assert strongest_line(noise, 0.01) is None
    noise[:, 1] += 0.4 * np.sin(2.0 * np.pi * 4.5 * 0.01 * np.arange(1000))
    line = strongest_line(noise, 0.01)
    assert line is not None and line.output == 1
    assert line.frequency_hz == pytest.approx(4.5, abs=line.resolution_hz)


def test_a_drift_is_no_line():
    assert strongest_line(white(1000, 2, 7) + np.linspace(-2.0, 2.0, 1000)[:, None], 0.01) is None
    assert strongest_line(white(20, 2, 8), 0.01) is None


def test_the_band_of_the_normalised_innovation_holds_a_true_model():
    low, high = normalised_band(300, 12)
    inside = [low <= np.square(white(300, 12, seed)).mean() <= high for seed in range(200)]
    assert 0.9 < np.mean(inside) < 0.99
    assert 0.94 < low < 1.0 < high < 1.06
