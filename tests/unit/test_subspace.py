"""MOESP without a loop: exact data, and against nfoursid; the physical reading of a model; what is refused."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from nfoursid.nfoursid import NFourSID

from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.theta import Noise
from gateway.core.web_model import linearise
from gateway.identification.moesp import Stretch, hankel, moesp
from gateway.identification.subspace import METHOD, estimated_by_subspace, identified_by_subspace
from tests.unit.regression_support import shaken, true_model


def line_of(n=3):
    return load_line(line_template(n, "line.toml"), "line.toml")


def simulated(noise, seed=0, samples=600):
    """A system of order 4 with two inputs and three outputs: matrices, inputs, outputs, with noise on both."""
    generator = np.random.default_rng(seed)
    A = np.diag([0.95, 0.8, 0.0, 0.0])
    A[2:, 2:] = [[0.7, 0.2], [-0.2, 0.7]]
    basis = generator.standard_normal((4, 4)) + 2.0 * np.eye(4)
    A = basis @ A @ np.linalg.inv(basis)
    B, C, D = generator.standard_normal((4, 2)), generator.standard_normal((3, 4)), generator.standard_normal((3, 2))
    inputs = generator.standard_normal((samples, 2))
    outputs, x = np.empty((samples, 3)), np.zeros(4)
    for k in range(samples):
        outputs[k] = C @ x + D @ inputs[k] + noise * generator.standard_normal(3)
        x = A @ x + B @ inputs[k] + noise * generator.standard_normal(4)
    return (A, B, C, D), inputs, outputs


def open_loop(inputs, outputs):
    return Stretch(outputs, inputs, np.empty((len(inputs), 0)))


def markov(system, count=8):
    """D, CB, CAB, ..: what does not depend on the basis."""
    A, B, C, D = system
    found, power = [D], np.eye(len(A))
    for _ in range(count):
        found.append(C @ power @ B)
        power = A @ power
    return np.array(found)


def of(model):
    return model.A, model.B, model.C, model.D


def poles(A):
    return np.sort_complex(np.linalg.eigvals(A))


def test_exact_data_give_the_system_and_its_order():
    system, inputs, outputs = simulated(0.0)
    found = moesp(hankel([open_loop(inputs, outputs)], 5), 4, 3)
    np.testing.assert_allclose(markov(of(found)), markov(system), atol=1e-9)
    assert found.singular_values[4] < 1e-9 * found.singular_values[3]


def test_a_gap_leaves_out_its_instants_alone():
    system, inputs, outputs = simulated(0.0)
    parts = [open_loop(inputs[begin:end], outputs[begin:end]) for begin, end in ((0, 200), (230, 600))]
    data = hankel(parts, 5)
    assert data.inputs.shape[1] == 600 - 30 - 2 * 9
    np.testing.assert_allclose(markov(of(moesp(data, 4, 3))), markov(system), atol=1e-9)


@pytest.mark.long
def test_without_a_loop_it_is_the_po_moesp_of_nfoursid():
    """The same singular values and, from them by another way (a least squares fit of states), nearly the same model."""
    system, inputs, outputs = simulated(0.1)
    ours = moesp(hankel([open_loop(inputs, outputs)], 5), 4, 3)
    names = ["u1", "u2"], ["y1", "y2", "y3"]
    frame = pd.DataFrame(np.hstack((inputs, outputs)), columns=[*names[0], *names[1]])
    theirs = NFourSID(frame, output_columns=names[1], input_columns=names[0], num_block_rows=5)
    theirs.subspace_identification()
    values = np.diagonal(theirs.R32_decomposition.eigenvalues)
    np.testing.assert_allclose(ours.singular_values, values, rtol=1e-9)
    model, _ = theirs.system_identification(rank=4)
    truth = markov(system)
    size = np.abs(truth).max()
    np.testing.assert_allclose(markov(of(ours)), truth, atol=0.05 * size)
    np.testing.assert_allclose(markov(of(ours)), markov((model.a, model.b, model.c, model.d)), atol=0.05 * size)
    np.testing.assert_allclose(poles(ours.A), poles(model.a), atol=0.01)
    np.testing.assert_allclose(poles(ours.A), poles(system[0]), atol=0.01)


@pytest.mark.long
def test_in_a_loop_references_as_instruments_take_the_bias_away():
    """y_{k+1} = 0.9 y_k + u_k + w_k under u = r - 0.5 y: least squares on inputs as their own instruments is off."""
    generator = np.random.default_rng(0)
    worst = []
    for with_references in (False, True):
        off = []
        for _ in range(20):
            reference = np.repeat(generator.choice([-1.0, 1.0], 400), 5)
            y, outputs, inputs = 0.0, [], []
            for r in reference:
                seen = y + 0.5 * generator.standard_normal()
                outputs.append(seen)
                inputs.append(r - 0.5 * seen)
                y = 0.9 * y + inputs[-1] + 0.3 * generator.standard_normal()
            outside = reference[:, None] if with_references else np.empty((2000, 0))
            stretch = Stretch(np.array(outputs)[:, None], np.array(inputs)[:, None], outside)
            off.append(moesp(hankel([stretch], 4), 1, 1).A[0, 0] - 0.9)
        worst.append(abs(np.mean(off)))
    assert worst[0] > 0.02
    assert worst[1] < 0.005


def test_too_few_data_are_refused():
    _, inputs, outputs = simulated(0.0, samples=30)
    with pytest.raises(ValueError, match="21 instants are too few for 5 block rows, which need 52"):
        hankel([open_loop(inputs, outputs)], 5)
    with pytest.raises(ValueError, match="no stretch of data is 40 samples long"):
        hankel([open_loop(inputs, outputs)], 20)


def with_setpoints(data):
    """Torques themselves are what moves from outside: no loop is closed in `shaken`."""
    return replace(data, tension_setpoint_n=data.torque_nm)


@pytest.fixture(scope="module")
def nearly_exact():
    line = line_of()
    return line, with_setpoints(shaken(line, true_model(3, spread=0.1), noise=Noise(1e-4, 1e-7, 1e-7)))


def test_a_model_of_the_line_is_its_linearisation(nearly_exact):
    line, data = nearly_exact
    found = identified_by_subspace(line, data)
    assert found.model.singular_values[5] > 30.0 * found.model.singular_values[6]
    tension, speed = data.tension_n.mean(axis=0), data.speed_m_per_s.mean(axis=0)
    A, B = linearise(true_model(3, spread=0.1), tension, speed, 0.05)
    np.testing.assert_allclose(found.A[3:], A[3:], atol=0.03)
    np.testing.assert_allclose(found.A[:3, 3:], A[:3, 3:], rtol=0.01, atol=10.0)
    np.testing.assert_allclose(found.B[3:], B[3:], atol=3e-4)


def test_parameters_are_read_from_the_model(nearly_exact):
    line, data = nearly_exact
    model = true_model(3, spread=0.1)
    found = estimated_by_subspace(line, data, Noise(1e-4, 1e-7, 1e-7), per_roller=True)
    assert (found.method, found.samples) == (METHOD, 500)
    assert found.theta.web.stiffness_n == pytest.approx(2200.0, rel=0.01)
    # Tensions are alike but at the end: only there does torque balance tension.
    assert found.theta.web.radius_m[2] == pytest.approx(model.radius_m[2], rel=0.01)
    for i in range(3):
        for name, value in (
            ("stiffness_per_length", 2200.0 / model.length_m[i]),
            ("radius_per_inertia", model.radius_m[i] / model.inertia_kg_m2[i]),
            ("friction_per_inertia", model.friction_nms_per_rad[i] / model.inertia_kg_m2[i]),
        ):
            assert found.intervals[f"{name}[{i + 1}]"].value == pytest.approx(value, rel=5e-3)


def test_one_span():
    line = line_of(1)
    found = estimated_by_subspace(line, with_setpoints(shaken(line, true_model(1), noise=Noise())))
    assert found.intervals["radius_per_inertia"].value == pytest.approx(0.035, rel=0.03)


def test_what_is_refused():
    line = line_of(2)
    data = shaken(line, true_model(2), 2.0, Noise())
    with pytest.raises(ValueError, match="no set-point moves"):
        estimated_by_subspace(line, data)
    with pytest.raises(ValueError, match="has 2 spans at a period of 0.01 s; the line has 3"):
        estimated_by_subspace(line_of(3), data)
    with pytest.raises(ValueError, match="no stretch of known samples under control is 10 long"):
        estimated_by_subspace(line, replace(data, controlled=np.zeros(200, dtype=bool)))
    data.tension_n[:, 1] = np.nan
    with pytest.raises(ValueError, match="span 2 has no load cell"):
        estimated_by_subspace(line, data)
