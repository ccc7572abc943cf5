"""What a change would change, in words and numbers, for whoever decides on it. Computed, never told by its author."""

from typing import Any, cast

import numpy as np

from gateway.core.controller import Controller
from gateway.core.experiment import Experiment
from gateway.core.line_model import LineModel
from gateway.core.signals import FloatArray

SAME = 1e-9  #: relative: nothing that anybody would call a difference
_PARAMETERS = ("stiffness_n", "length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad")


def of_controllers(before: Controller, after: Controller) -> list[str]:
    """A sentence for each part that differs."""
    if before.kind != after.kind:
        told = [f"the law changes from {before.kind} to {after.kind}"]
    else:
        told = _fields(*(parts(one.model_dump(exclude={"feedforward", "kind"})) for one in (before, after)))
    told += _parameters(before.feedforward.model_dump(), after.feedforward.model_dump(), "feed-forward")
    return told or ["nothing differs"]


def of_experiment(experiment: Experiment) -> list[str]:
    moved = [amplitude for amplitude in experiment.amplitude_n if amplitude > 0.0]
    speeds = sorted({leg.speed_m_per_s for leg in experiment.legs if leg.speed_m_per_s is not None})
    told = [
        f"set-points of {len(moved)} spans move by up to {max(moved):g} N either way, every "
        f"{experiment.dwell_s:g} s, for {experiment.duration_s:g} s; then they go back",
        f"it is aborted when a tension is {experiment.abort.deviation_n:g} N away from where it began",
    ]
    if speeds:
        told.append(f"the line runs at {', '.join(f'{speed:g}' for speed in speeds)} m/s meanwhile")
    return told


def of_models(before: LineModel | None, after: LineModel) -> list[str]:
    """Against the model in service; None: the line's file, which has no such values here."""
    if before is None:
        given = after.parameters
        return [f"the first model: EA {given.stiffness_n:.4g} N, torque lag {1e3 * given.torque_lag_s:.2g} ms"]
    return _parameters(before.parameters.model_dump(), after.parameters.model_dump(), "model") or ["nothing differs"]


def _parameters(before: dict[str, Any], after: dict[str, Any], whose: str) -> list[str]:
    told: list[str] = []
    for name in _PARAMETERS:
        old, new = np.atleast_1d(before[name]).astype(np.float64), np.atleast_1d(after[name]).astype(np.float64)
        if old.shape != new.shape:
            told.append(f"{whose}: {name} has {len(new)} values in place of {len(old)}")
            continue
        share = np.divide(new - old, old, out=np.full(len(old), np.inf), where=old != 0.0)
        share[new == old] = 0.0
        if np.abs(share).max() > SAME:
            low, high = 100.0 * float(share.min()), 100.0 * float(share.max())
            span = f"{high:+.1f} %" if high - low < 0.05 else f"{low:+.1f} to {high:+.1f} %"
            told.append(f"{whose}: {name} {span}")
    return told


Part = FloatArray | float | str | None


def parts(config: dict[str, Any], under: str = "") -> dict[str, Part]:
    """Of fields, and fields of fields, matrices as arrays, by dotted names."""
    found: dict[str, Part] = {}
    for key, value in config.items():
        if isinstance(value, dict):
            found |= parts(cast("dict[str, Any]", value), f"{under}{key}.")
        else:
            found[f"{under}{key}"] = _part(value)
    return found


def _part(value: Any) -> Part:
    if value is None or isinstance(value, float | int | str):
        return value
    try:
        return np.array(value, dtype=np.float64)
    except (ValueError, TypeError):  # nodes of a schedule, a list of no numbers
        return str(value)


def _fields(before: dict[str, Part], after: dict[str, Part]) -> list[str]:
    told: list[str] = []
    for name in before.keys() | after.keys():
        old, new = before.get(name), after.get(name)
        if isinstance(old, np.ndarray) and isinstance(new, np.ndarray):
            if old.shape != new.shape:
                told.append(f"{name} is {new.shape} in place of {old.shape}")
            elif (change := relative(old, new)) > SAME:
                told.append(f"{name} changes by {100.0 * change:.1f} %{_signs(old, new)}")
        elif isinstance(old, np.ndarray) or isinstance(new, np.ndarray) or old != new:
            told.append(f"{name} is {str(new)[:60]} in place of {str(old)[:60]}")
    return sorted(told)


def relative(old: FloatArray, new: FloatArray) -> float:
    """Of the Frobenius norm."""
    size = float(np.linalg.norm(old))
    return float(np.linalg.norm(new - old)) / size if size > 0.0 else float(np.linalg.norm(new) > 0.0)


def _signs(old: FloatArray, new: FloatArray) -> str:
    """Entries of weight that turn their sign: what nobody should miss."""
    heavy = np.abs(old) > 0.1 * float(np.abs(old).max())
    turned = int(np.count_nonzero(heavy & (np.sign(old) != np.sign(new))))
    return f"; {turned} large entries change their sign" if turned else ""
