"""Plants at the corners of what is believed of a line: of an identified model's posterior, or of its file's tolerances.

For whoever must know that a controller is safe on every plant that the truth may be. A posterior N(mu, S) of the
logarithms has the principal axes q_j with the variances l_j; a corner is at

    mu + sigmas * sum_j s_j sqrt(l_j) q_j,    s_j = +1 or -1,

so that parameters whose errors hang together (EA and L, R and J) move together, and the root mean square of a
parameter's move over all corners is `sigmas` of its standard deviations. What drifts does not care for the posterior:
a physical factor that would move by less than a least share moves by that share, whichever way. Every second corner is
the opposite of the one before.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import exp, log1p

import numpy as np

from gateway.core.line import Line, Parameter
from gateway.core.line_model import LineModel, theta_of
from gateway.core.line_model_names import split_name
from gateway.core.line_model_quantities import interval_at
from gateway.core.posterior import Posterior, posterior_of
from gateway.core.signals import FloatArray
from gateway.core.theta import Theta, nominal_theta
from gateway.core.unnamed_terms import COULOMB_SD, COULOMB_SHARE, LAG_S, LAG_SD, LATENCY_SD_S

PHYSICAL = ("stiffness_n", "length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad")
UNMODELLED = ("coulomb_nm", "torque_lag_s", "latency_s")  #: by the paper's two equations


class NoPosterior(ValueError):
    """The model's file has no posterior."""


def corners(model: LineModel, sigmas: float, least_relative: float, count: int, seed: int) -> list[Theta]:
    """`count` plants around `model`; the same `seed`, the same plants.

    Each of EA, L, R, J and f, by roller where the model has them so, moves by the factor 1 + `least_relative` at least,
    up or down. Coulomb friction, torque lag and latency go no further than `sigmas` standard deviations; those that the
    posterior does not have go to an end of their interval, where there is one. Raises NoPosterior, and ValueError for
    numbers that are no such.
    """
    _require(sigmas > 0.0 and least_relative >= 0.0 and count >= 1, f"{sigmas=}, {least_relative=}, {count=}")
    posterior = posterior_of(model)
    if posterior is None:
        raise NoPosterior(
            f"the model of {model.site}/{model.line} made {model.created} has no posterior: identify again, or take "
            "the corners of the line's file"
        )
    generator = np.random.default_rng(seed)
    names = list(posterior.names)
    moves = _along_axes(posterior, sigmas, _signs(generator, count, len(names)))
    own = [name for name in _physical_names(model, names) if not _covered(name, names)]
    names, moves = [*names, *own], np.hstack((moves, np.zeros((count, len(own)))))
    for j, name in enumerate(names):
        if split_name(name)[0] in PHYSICAL:
            floor = log1p(least_relative)
            free = _signs(generator, count, 1)[:, 0] * floor
            moves[:, j] = np.where(np.abs(moves[:, j]) < floor, free, moves[:, j])
    theta = theta_of(model)
    plants = [moved(theta, dict(zip(names, row, strict=True))) for row in moves.tolist()]
    return [_to_an_end(plant, model, posterior, signs) for plant, signs in
            zip(plants, _signs(generator, count, len(UNMODELLED)).tolist(), strict=True)]  # fmt: skip


def corners_of_line(line: Line, count: int, seed: int) -> list[Theta]:
    """`count` plants at corners of the tolerances of the line's file, for a line of which there is no model.

    All rollers, and all spans, are wrong the same way, each by its own tolerance. There is no Coulomb friction or a
    standard deviation more than is expected of a line, likewise no torque lag or a long one, and the latency is a
    standard deviation less or more than the file says. Raises ValueError for a count below 1.
    """
    _require(count >= 1, f"{count=}")
    generator = np.random.default_rng(seed)
    nominal = nominal_theta(line)
    coulomb = COULOMB_SHARE * exp(COULOMB_SD) * line.limits.torque_nm
    lag_s = LAG_S * exp(LAG_SD)
    found: list[Theta] = []
    for signs in _signs(generator, count, len(PHYSICAL) + len(UNMODELLED)).tolist():
        stiffness, length, radius, inertia, friction, with_coulomb, with_lag, late = signs
        web = replace(
            nominal.web,
            stiffness_n=float(_end([line.web.stiffness_n], stiffness)[0]),
            length_m=_end((span.length_m for span in line.spans), length),
            radius_m=_end((roller.radius_m for roller in line.rollers), radius),
            inertia_kg_m2=_end((roller.inertia_kg_m2 for roller in line.rollers), inertia),
            friction_nms_per_rad=_end((roller.friction_nms_per_rad for roller in line.rollers), friction),
        )
        found.append(
            Theta(
                web,
                np.full(line.n, coulomb if with_coulomb > 0.0 else 0.0),
                lag_s if with_lag > 0.0 else 0.0,
                max(0.0, nominal.latency_s + late * LATENCY_SD_S),
            )
        )
    return found


def moved(theta: Theta, logs: dict[str, float]) -> Theta:
    """With what is named multiplied by the exponential of its number; a name without a roller moves all."""
    fields: dict[str, FloatArray] = {name: getattr(theta.web, name).copy() for name in PHYSICAL[1:]}
    fields["coulomb_nm"] = theta.coulomb_nm.copy()
    fields |= {
        "stiffness_n": np.array([theta.web.stiffness_n]),
        "torque_lag_s": np.array([theta.torque_lag_s]),
        "latency_s": np.array([theta.latency_s]),
    }
    for name, by in logs.items():
        base, number = split_name(name)
        fields[base][slice(None) if number is None else number - 1] *= exp(by)
    of_line = {name: float(fields.pop(name)[0]) for name in ("stiffness_n", "torque_lag_s", "latency_s")}
    coulomb = fields.pop("coulomb_nm")
    web = replace(theta.web, stiffness_n=of_line["stiffness_n"], **fields)
    return Theta(web, coulomb, of_line["torque_lag_s"], of_line["latency_s"])


def _along_axes(posterior: Posterior, sigmas: float, signs: FloatArray) -> FloatArray:
    """Moves (count, k) of the logarithms, of `signs` (count, k) along the principal axes."""
    variances, axes = np.linalg.eigh(posterior.covariance)
    moves: FloatArray = sigmas * (signs * np.sqrt(np.maximum(variances, 0.0))) @ axes.T
    most = sigmas * posterior.deviations
    for j, name in enumerate(posterior.names):
        if split_name(name)[0] in UNMODELLED:
            moves[:, j] = np.clip(moves[:, j], -most[j], most[j])
    return moves


def _signs(generator: np.random.Generator, count: int, size: int) -> FloatArray:
    """(count, size) of +1 and -1; every second row is the opposite of the one before."""
    drawn = generator.choice([-1.0, 1.0], ((count + 1) // 2, size))
    return np.stack((drawn, -drawn), axis=1).reshape(-1, size)[:count]


def _physical_names(model: LineModel, names: Sequence[str]) -> list[str]:
    """By roller where the model, or the posterior, has them so."""
    found = ["stiffness_n"]
    for base in PHYSICAL[1:]:
        apart = model.structure.per_roller or any(name.startswith(f"{base}[") for name in names)
        found += [f"{base}[{i}]" for i in range(1, model.n + 1)] if apart else [base]
    return found


def _covered(name: str, names: Sequence[str]) -> bool:
    """Whether it, or the factor of all that it is a part of, is one of `names`."""
    return name in names or split_name(name)[0] in names


def _to_an_end(theta: Theta, model: LineModel, posterior: Posterior, signs: list[float]) -> Theta:
    """With what the paper's equations and the posterior do not have at an end of its interval."""
    of_coulomb, of_lag, of_latency = signs
    coulomb = [
        _interval_end(model, posterior, "coulomb_nm", i, of_coulomb, float(value))
        for i, value in enumerate(theta.coulomb_nm)
    ]
    return Theta(
        theta.web,
        np.array(coulomb),
        _interval_end(model, posterior, "torque_lag_s", 0, of_lag, theta.torque_lag_s),
        _interval_end(model, posterior, "latency_s", 0, of_latency, theta.latency_s),
    )


def _interval_end(
    model: LineModel, posterior: Posterior, name: str, index: int, sign: float, otherwise: float
) -> float:
    interval = interval_at(model, name, index)
    own = f"{name}[{index + 1}]"
    if interval is None or _covered(own, posterior.names):
        return otherwise
    return max(0.0, interval.high if sign > 0.0 else interval.low)


def _end(parameters: Iterable[Parameter], sign: float) -> FloatArray:
    return np.array([one.value * (1.0 + sign * one.tolerance) for one in parameters])


def _require(right: bool, given: str) -> None:
    if not right:
        raise ValueError(f"{given}; allowed: sigmas above 0, least_relative from 0, count from 1")
