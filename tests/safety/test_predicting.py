"""How well a model predicts, in one figure for all outputs and one for each: 1 for a true model."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from gateway.control.prediction import stretch_of
from safety.predicting import Foretold, normalised, normalised_by_output, with_swings


@dataclass(frozen=True)
class Predictions:
    """What `normalised*` reads of predictions: `whitened` is (k, m)."""

    whitened: np.ndarray

    @property
    def stretch(self):
        return SimpleNamespace(predictions=len(self.whitened), names=["tension 1", "speed 1"])

    @property
    def normalised_squared(self):
        return np.mean(np.square(self.whitened), axis=0)


def found(*whitened):
    return [Foretold(None, Predictions(np.array(one))) for one in whitened]


def test_a_long_part_counts_for_more_than_a_short_one():
    parts = found([[1.0, 2.0]] * 3, [[3.0, 0.0]])
    names, each = normalised_by_output(parts)
    assert names == ["tension 1", "speed 1"]
    np.testing.assert_allclose(each, [(3 * 1.0 + 9.0) / 4, (3 * 4.0 + 0.0) / 4])
    assert normalised(parts) == pytest.approx((3 * 5.0 + 9.0) / 8)


@pytest.mark.parametrize("gone", [np.nan, np.inf])
def test_predictions_that_have_run_away_are_as_far_off_as_can_be(gone):
    parts = found([[1.0, gone]])
    assert normalised(parts) == np.inf
    np.testing.assert_array_equal(normalised_by_output(parts)[1], [1.0, np.inf])


def test_rollers_are_as_far_out_of_round_as_was_learned_by_the_end(of):
    stretch = stretch_of(of.recording, "linear")
    learned = np.arange(3.0 * stretch.swing.size).reshape(3, *stretch.swing.shape)
    swung = SimpleNamespace(stretch=stretch, swung=SimpleNamespace(before=learned))
    np.testing.assert_array_equal(with_swings(swung).swing, learned[-1])
    assert with_swings(SimpleNamespace(stretch=stretch, swung=None)) is stretch
