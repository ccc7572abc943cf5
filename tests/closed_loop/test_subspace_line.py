"""The subspace method on the simulated line under control: order, accuracy, what instruments are for."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.identification.moesp import moesp
from gateway.identification.subspace import estimated_by_subspace, identified_by_subspace
from tests.closed_loop.recorded import demonstration_line, per_roller, real_plant, recorded, without

SEEDS = 6
STRONG = {"stiffness_per_length": 2200.0 / 1.2, "radius_per_inertia": 0.035, "friction_per_inertia": 15.0}


@pytest.fixture(scope="module")
def recordings():
    return [recorded(real_plant(), seed) for seed in range(SEEDS)]


def test_singular_values_show_the_order(recordings):
    values = identified_by_subspace(demonstration_line(), recordings[0]).model.singular_values
    steps = values[:-1] / values[1:]
    assert np.argmax(steps) == 11  # twice six spans
    assert steps[11] > 5.0


def test_shared_parameters_are_found(recordings):
    line = demonstration_line()
    found = [estimated_by_subspace(line, data) for data in recordings]
    for name, most in (("stiffness_per_length", 8e-3), ("radius_per_inertia", 4e-3), ("friction_per_inertia", 4e-3)):
        off = [each.intervals[name].value / STRONG[name] - 1.0 for each in found]
        assert np.sqrt(np.mean(np.square(off))) < most, name
        assert np.mean([each.intervals[name].covers(STRONG[name]) for each in found]) > 0.8


def test_rollers_that_differ_and_a_gap():
    line = demonstration_line()
    plant = per_roller(real_plant(), 0.1, 100)
    web = plant.parameters()
    found = estimated_by_subspace(line, without(recorded(plant, 1, 8.0), 300, 320), per_roller=True).intervals
    for name, truth, most in (
        ("stiffness_per_length", web.stiffness_n / web.length_m, 0.03),
        ("radius_per_inertia", web.radius_m / web.inertia_kg_m2, 0.01),
        ("friction_per_inertia", web.friction_nms_per_rad / web.inertia_kg_m2, 0.01),
    ):
        off = [found[f"{name}[{i}]"].value / value - 1.0 for i, value in enumerate(truth.tolist(), start=1)]
        assert np.sqrt(np.mean(np.square(off))) < most, name


def test_inputs_as_their_own_instruments_bias_the_stiffness(recordings, monkeypatch):
    """PO-MOESP, made for open loops: its EA/L is too large, as torques answer the noise of tensions."""
    line, n = demonstration_line(), 6

    def stiffness(data):
        A = identified_by_subspace(line, data).A
        return np.diag(A[:n, n:]).mean() * 1.2 / (2200.0 - data.tension_n.mean()) - 1.0

    with_references = np.mean([stiffness(data) for data in recordings])

    def without_references(data, order, outputs):
        past_and_inputs = np.vstack((data.inputs, data.instruments[-(len(data.inputs) + len(data.outputs)) :]))
        return moesp(replace(data, instruments=past_and_inputs), order, outputs)

    monkeypatch.setattr("gateway.identification.subspace.moesp", without_references)
    alone = np.mean([stiffness(data) for data in recordings])
    assert alone > 0.012
    assert abs(with_references) < 0.75 * alone


def test_the_unwinder_is_an_input_where_it_moves():
    line = demonstration_line()
    data = recorded(real_plant(), 3, 4.0, speeds_m_per_s=(0.03, 0.05))
    found = identified_by_subspace(line, data)
    assert found.B.shape == (12, 7)
    assert found.B[0, 6] == pytest.approx(-2200.0 / 1.2, rel=0.1)  # span 1 slackens
