"""The gap of a measurement to its prediction, where the model is the truth: nothing but chance is left of it."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.cli.eval_truth import true_model
from gateway.commissioning.convergence import SIGNIFICANT, convergence
from gateway.control.design import design_lqi, task_on
from gateway.core.line_model import noise_of, theta_of
from gateway.core.theta import Noise
from gateway.identification.findings import EXCITATION, Severity
from gateway.identification.identify import NotIdentified, identify
from tests.closed_loop.recorded import demonstration_line, real_plant, recorded

LINE, PLANT = demonstration_line(2), real_plant().model_copy(update={"spans": 2})


def test_a_true_model_foresees_what_is_measured_noise_of_load_cells_included():
    model = true_model(PLANT, LINE)
    config = design_lqi(task_on(LINE, theta_of(model), noise_of(model)))
    runs = [recorded(PLANT, seed, 15.0, amplitude_n=1.0, dwell_s=2.5, line=LINE, config=config) for seed in range(3)]
    gaps = [convergence(LINE, run, config, model).gap for run in runs]
    assert np.abs(gaps).max() < SIGNIFICANT and abs(np.mean(gaps)) < 0.5 * SIGNIFICANT


def test_beside_an_experiment_a_recording_that_moves_too_little_by_itself_is_made_use_of():
    lively, quiet = recorded(PLANT, 0, line=LINE), recorded(PLANT, 1, 8.0, amplitude_n=0.0, line=LINE)
    with pytest.raises(NotIdentified, match="hardly more than by noise"):
        identify([quiet], LINE, Noise(), lambda: 0.0)
    found = identify([quiet, lively], LINE, Noise(), lambda: 0.0)
    assert found.estimate.samples > 1.3 * lively.samples and found.validation.valid
    told = [one for one in found.warnings if one.kind == EXCITATION]
    assert told and all(one.severity is Severity.WARNING and not one.experiment for one in told)
    assert all("another recording tells enough" in one.what for one in told)
    with pytest.raises(NotIdentified):
        identify([quiet, replace(quiet, source="again")], LINE, Noise(), lambda: 0.0)
