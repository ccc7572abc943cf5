"""Changes so small that, once a person has approved one of their kind, the verdict alone lets them pass. Pure.

Smallness is counted from what a person approved last, never from what is in service: many small steps go no further
than one.
"""

from typing import Any

import numpy as np

from gateway.core.differences import SAME, Part, parts, relative
from gateway.core.experiment import Experiment
from gateway.core.line_model import LineModel
from gateway.core.proposal import Change, ExperimentChange, GainsChange, ModelChange

_OF_A_MODEL = ("structure", "parameters", "noise")


def beyond_small(approved: Change, new: Change, share: float) -> list[str]:
    """Why a person must decide on `new`, with `approved` by one before; empty: it is small.

    Every matrix and number may differ by `share` of itself (of matrices in the Frobenius norm); what is no number may
    not differ at all. An experiment may go no further than the approved, whatever the share.
    """
    if isinstance(approved, GainsChange) and isinstance(new, GainsChange):
        return _differing(approved.controller.model_dump(), new.controller.model_dump(), share)
    if isinstance(approved, ModelChange) and isinstance(new, ModelChange):
        return _differing(_believed(approved.model), _believed(new.model), share)
    if isinstance(approved, ExperimentChange) and isinstance(new, ExperimentChange):
        return _further(approved.experiment, new.experiment)
    return [f"what a person approved was of {approved.kind}, this is of {new.kind}"]


def _believed(model: LineModel) -> dict[str, Any]:
    return {name: part for name, part in model.model_dump().items() if name in _OF_A_MODEL}


def _differing(approved: dict[str, Any], new: dict[str, Any], share: float) -> list[str]:
    old, now = parts(approved), parts(new)
    found = [_beyond(name, old.get(name), now.get(name), share) for name in sorted(old.keys() | now.keys())]
    return [text for text in found if text]


def _beyond(name: str, old: Part, new: Part, share: float) -> str:
    if isinstance(old, float | int | np.ndarray) and isinstance(new, float | int | np.ndarray):
        before, after = np.asarray(old, dtype=np.float64), np.asarray(new, dtype=np.float64)
        if before.shape != after.shape:
            return f"{name} is {after.shape} in place of {before.shape}"
        change = relative(before, after)
        return f"{name} differs by {change:.1%}, allowed: {share:.1%}" if not change <= share + SAME else ""
    same = old is not None and new is not None and not isinstance(old, np.ndarray) and old == new
    return "" if same or old is new else f"{name} is {str(new)[:60]} in place of {str(old)[:60]}"


def _further(approved: Experiment, new: Experiment) -> list[str]:
    """Where it goes further: in amplitude, time, speed, or in what it bears before it ends itself."""
    if approved.n != new.n:
        return [f"it is for {new.n} spans in place of {approved.n}"]
    of_speed = [[leg.speed_m_per_s for leg in one.legs if leg.speed_m_per_s is not None] for one in (approved, new)]
    rates = [np.inf if one.rate_n_per_s is None else one.rate_n_per_s for one in (approved, new)]
    compared = [
        (f"amplitude of span {i}", before, after, "N")
        for i, (before, after) in enumerate(zip(approved.amplitude_n, new.amplitude_n, strict=True), start=1)
    ]
    compared += [
        ("duration", approved.duration_s, new.duration_s, "s"),
        ("rate of set-points", *rates, "N/s"),
        ("deviation that ends it", approved.abort.deviation_n, new.abort.deviation_n, "N"),
        ("turning torque that ends it", approved.abort.reversal_nm, new.abort.reversal_nm, "Nm"),
        ("share of cut torques that ends it", approved.abort.saturated_share, new.abort.saturated_share, ""),
        ("share of turning torques that ends it", approved.abort.reversal_share, new.abort.reversal_share, ""),
    ]
    found = [
        f"{name} is {after:g} {unit}, in the approved {before:g}".replace("  ", " ")
        for name, before, after, unit in compared
        if not after <= before
    ]
    if any(speed not in of_speed[0] for speed in of_speed[1]):
        found.append(f"it goes to speeds {of_speed[1]} m/s, the approved to {of_speed[0]}")
    return found
