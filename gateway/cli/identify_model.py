"""The model that was identified, as the file and the repository keep it."""

import time
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from gateway.core.line import Line
from gateway.core.line_model import ChannelDelay, LineModel, ModelValidation
from gateway.core.recording import Recording, joined
from gateway.identification.identify import Identified
from gateway.identification.model_record import Origin, model_from
from gateway.identification.validation import Validation
from gateway.supervisor.models import Entry, begin_repository

LONGEST_SOURCE = 200  #: letters, as the model file has them


def model_of_found(
    line: Line,
    recordings: Sequence[Recording],
    found: Identified,
    created: str,
    delays: Sequence[ChannelDelay] = (),
    parent: str | None = None,
) -> LineModel:
    """Raises ModelRefused. `delays` were taken out; `parent`: hash of the model that was the prior, None: the file."""
    whole = recordings[0] if len(recordings) == 1 else joined(recordings)
    whole = replace(whole, source=whole.source[:LONGEST_SOURCE])
    origin = Origin(line.site, line.line, created, version("r2rgate"), parent)
    return model_from(found.estimate, whole, origin, recorded(found.validation, line.n), delays)


def recorded(one: Validation, n: int) -> ModelValidation:
    """Figures on held-out data: R2 and MAE of predicting one sample ahead, in the mean over spans or rollers."""
    by_name = {output.name: output for output in one.outputs}
    cells = [by_name.get(f"tension {i}") for i in range(1, n + 1)]
    encoders = [by_name[f"speed {i}"] for i in range(1, n + 1)]
    measured = [cell for cell in cells if cell is not None]
    white = "not tested" if np.isnan(one.portmanteau) else "white" if one.portmanteau <= 1.0 else "coloured"
    return ModelValidation(
        samples=one.samples,
        innovation_tension=[None if cell is None else cell.normalised for cell in cells],
        innovation_speed=[output.normalised for output in encoders],
        r2_tension=_mean([cell.r2 for cell in measured]),
        r2_speed=_mean([output.r2 for output in encoders]),
        mae_tension_n=_mean([cell.mae for cell in measured]) or 0.0,
        mae_speed_m_per_s=_mean([output.mae for output in encoders]) or 0.0,
        whiteness=white,
    )


def _mean(values: list[float]) -> float | None:
    """Of those that are known; None where none is."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else None


def store(model: LineModel, validation: Validation, path: Path) -> Entry:
    """Into the repository at `path`; one that does not hold is marked as rejected. Raises ModelsError."""
    now_s = time.time()
    with begin_repository(path) as models:
        entry = models.store(model, now_s)
        if not validation.valid and entry.state is None:
            models.mark(entry.id, "rejected", now_s, f"on held-out data: {'; '.join(validation.findings)}")
            entry = models.find(entry.id, model.site, model.line)
    return entry
