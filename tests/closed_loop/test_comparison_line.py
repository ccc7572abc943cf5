"""Methods on one recording of the simulated line, compared on another."""

import pytest

from gateway.core.theta import nominal_theta
from gateway.identification.comparison import compare
from gateway.identification.estimate import Estimate, Structure
from gateway.identification.recursive import Settings, estimated_recursively
from gateway.identification.subspace import estimated_by_subspace
from tests.closed_loop.recorded import demonstration_line, per_roller, real_plant, recorded


def compared(plant, per_roller):
    line = demonstration_line()
    data, held_out = recorded(plant, 1), [recorded(plant, 2), recorded(plant, 3, 3.0)]
    file = Estimate("file", Structure(), nominal_theta(line), None, {}, 0)
    recursive = estimated_recursively(Settings(line), data, Structure(per_roller=per_roller))
    subspace = estimated_by_subspace(line, data, per_roller=per_roller)
    return compare([(file, 0.0), (recursive, 0.1), (subspace, 0.5)], held_out)


def test_both_methods_predict_the_line_and_the_file_does_not():
    found = compared(real_plant(), per_roller=False)
    assert found.rows[-1].estimate.method == "file"
    assert found.rows[-1].free_run.tension > 50.0
    for row in found.rows[:2]:
        assert row.one_step.tension == pytest.approx(1.41, rel=0.05)
        assert row.free_run.tension < 3.0
        assert row.free_run.speed < 4.0


def test_a_model_with_shared_parameters_is_not_enough_where_rollers_differ():
    plant = per_roller(real_plant(), 0.1, 7)
    each, shared = compared(plant, per_roller=True), compared(plant, per_roller=False)
    assert each.best.score < 3.5
    assert shared.best.score > 2.0 * each.best.score
