"""Configurations that have gone wrong: what is done to the numbers of a controller."""

import json
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from gateway.core.controller import Controller, canonical, parse_controller
from tests.independent.truth import FloatArray

SCALARS = ("period_s", "latency_s", "kind", "draw_spans", "tension_before_n", "tension_after_n")
MODEL = ("transition", "inputs")  #: of a predictor; the rest of a law is gains


def document_of(config: Controller) -> dict[str, Any]:
    return json.loads(canonical(config))


def controller_of(document: dict[str, Any]) -> Controller:
    """Raises ControllerRefused."""
    return parse_controller(json.dumps(document).encode())


def matrices(document: dict[str, Any], *, gains_only: bool = False) -> list[tuple[dict[str, Any], str, int | None]]:
    """Where the matrices and vectors of a law stand: table, key, and the place in a list of matrices."""
    return list(_matrices(document, gains_only))


def _matrices(table: dict[str, Any], gains_only: bool) -> Iterator[tuple[dict[str, Any], str, int | None]]:
    for key, value in table.items():
        if isinstance(value, dict):
            if not (gains_only and key == "feedforward"):
                yield from _matrices(value, gains_only)
        elif isinstance(value, list) and value and key not in SCALARS and not (gains_only and key in MODEL):
            if isinstance(value[0], dict):
                for node in value:
                    yield from _matrices(node, gains_only)
            elif np.ndim(value) == 3:
                yield from ((table, key, i) for i in range(len(value)))
            elif key not in ("blocks", "speed_m_per_s"):
                yield table, key, None


def changed(place: tuple[dict[str, Any], str, int | None], change: Callable[[FloatArray], FloatArray]) -> None:
    table, key, at = place
    old = np.array(table[key] if at is None else table[key][at], dtype=np.float64)
    new = change(old).tolist()
    if at is None:
        table[key] = new
    else:
        table[key][at] = new


def picked(document: dict[str, Any], generator: np.random.Generator, *, gains_only: bool = False) -> Any:
    places = [place for place in matrices(document, gains_only=gains_only) if np.size(place[0][place[1]])]
    return places[int(generator.integers(len(places)))]


def scaled_all(config: Controller, factor: float) -> Controller:
    """Every gain of the feedback times a factor: not the observer's."""
    document = document_of(config)
    for place in matrices(document, gains_only=True):
        if place[1] in ("gain_state", "gain_integral", "gain_proportional", "gain_derivative") and (
            place[0] is document
        ):
            changed(place, lambda old: factor * old)
    return controller_of(document)


def noisy(config: Controller, size: float, generator: np.random.Generator) -> Controller:
    """Every number of the gains off by up to `size`, each by itself."""
    document = document_of(config)
    for place in matrices(document, gains_only=True):
        changed(place, lambda old: old * generator.uniform(1.0 - size, 1.0 + size, old.shape))
    return controller_of(document)


def block_scaled(config: Controller, factor: float, generator: np.random.Generator) -> Controller:
    document = document_of(config)
    changed(picked(document, generator), lambda old: factor * old)
    return controller_of(document)


def sign_flipped(config: Controller, generator: np.random.Generator) -> Controller:
    """Of an entry, a row, a column, or the whole of a matrix; the greatest entry, so that it matters."""
    document = document_of(config)
    what = int(generator.integers(4))

    def flip(old: FloatArray) -> FloatArray:
        new = old.copy()
        if new.ndim == 1 or what == 0:
            place = np.unravel_index(int(np.abs(new).argmax()), new.shape)
            new[place] *= -1.0
        elif what == 1:
            new[int(generator.integers(new.shape[0]))] *= -1.0
        elif what == 2:
            new[:, int(generator.integers(new.shape[1]))] *= -1.0
        else:
            new *= -1.0
        return new

    changed(picked(document, generator, gains_only=True), flip)
    return controller_of(document)


UNITS = (1e3, 1e-3, 180.0 / np.pi, np.pi / 180.0, 1e2, 1e-2, 60.0, 1.0 / 60.0, 2.0, 0.5, 9.81, 1.0 / 9.81)


def unit_confused(config: Controller, generator: np.random.Generator) -> Controller:
    """A quantity in another unit: the columns of tensions or speeds, or a parameter of the feed-forward."""
    document, factor = document_of(config), float(generator.choice(UNITS))
    if generator.random() < 0.4:
        feedforward = document["feedforward"]
        names = ("stiffness_n", "length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad")
        name = str(generator.choice(names))
        feedforward[name] = (
            feedforward[name] * factor if name == "stiffness_n" else [v * factor for v in feedforward[name]]
        )
        for node in document.get("laws", []):
            node["feedforward"] = feedforward
        return controller_of(document)

    def columns(old: FloatArray) -> FloatArray:
        new, half = old.copy(), old.shape[-1] // 2
        part = generator.integers(3)
        new[..., slice(0, half) if part == 0 else slice(half, None) if part == 1 else slice(None)] *= factor
        return new

    changed(picked(document, generator, gains_only=True), columns)
    return controller_of(document)


def corrupted(config: Controller, generator: np.random.Generator) -> Controller:
    """One entry is something else: a power of ten, a neighbour's value, zero, or the other sign."""
    document = document_of(config)

    def corrupt(old: FloatArray) -> FloatArray:
        new = old.copy()
        place = int(generator.integers(new.size))
        kind = int(generator.integers(4))
        flat = new.reshape(-1)
        if kind == 0:
            flat[place] *= 10.0 ** float(generator.integers(-2, 4))
        elif kind == 1:
            flat[place] = flat[int(generator.integers(new.size))]
        elif kind == 2:
            flat[place] = 0.0
        else:
            flat[place] *= -1.0 * 10.0 ** float(generator.integers(0, 2))
        return new

    changed(picked(document, generator), corrupt)
    return controller_of(document)
