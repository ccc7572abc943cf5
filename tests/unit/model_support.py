"""Models of lines for tests: one of the demonstration line, and any that the format allows."""

from datetime import UTC, timedelta, timezone
from typing import Any

import numpy as np
from hypothesis import strategies as st

from gateway.core.line_model import LineModel
from gateway.core.line_model_names import COMBINATIONS, OF_THE_LINE, PER_SPAN

PHYSICAL = ("stiffness_n", "length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad")
CREATED = "2026-08-03T14:05:00+00:00"
ZONES = (UTC, timezone(timedelta(hours=-5)), timezone(timedelta(hours=9)))


def fields(spans: int = 2, scale: float = 1.0, **changes: Any) -> dict[str, Any]:
    """S_real as a shared fit sees it; every parameter times `scale` but the radius, f/J and R/J as they are."""
    values = {
        "stiffness_n": 2200.0 * scale, "length_m": 1.2, "radius_m": 0.035 * scale, "inertia_kg_m2": 1.0 * scale,
        "friction_nms_per_rad": 15.0 * scale,
    }  # fmt: skip
    values["stiffness_per_length"] = values["stiffness_n"] / values["length_m"]
    values["radius_per_inertia"] = values["radius_m"] / values["inertia_kg_m2"]
    values["friction_per_inertia"] = values["friction_nms_per_rad"] / values["inertia_kg_m2"]
    values["radius2_per_inertia"] = values["radius_m"] ** 2 / values["inertia_kg_m2"]
    width = {name: 0.003 if name in COMBINATIONS[:3] else 0.02 for name in values}
    intervals = {
        name: {"value": value, "low": value * (1.0 - width[name]), "high": value * (1.0 + width[name])}
        for name, value in values.items()
    }
    return {
        "format": 1,
        "site": "demo",
        "line": "line-1",
        "created": CREATED,
        "program_version": "0.1.0",
        "method": "prediction error",
        "structure": {"per_roller": False, "coulomb": False, "torque_lag": False},
        "parameters": {
            "stiffness_n": values["stiffness_n"],
            **{
                name: [values[name]] * spans
                for name in ("length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad")
            },
            "coulomb_nm": [0.0] * spans,
            "torque_lag_s": 0.0,
            "latency_s": 0.01,
        },
        "noise": {"tension_n": 0.1, "speed_m_per_s": 1e-4, "acceleration_m_per_s1_5": 1.58e-3},
        "intervals": intervals,
        "data": {"digest": "5a" * 32, "source": "experiment 3", "samples": 500, "period_s": 0.01},
        "region": {
            "speed_from_m_per_s": 0.01,
            "speed_to_m_per_s": 0.1,
            "tension_from_n": [18.0] * spans,
            "tension_to_n": [44.0] * spans,
        },
        "validation": {
            "samples": 300,
            "innovation_tension": [1.0] * spans,
            "innovation_speed": [0.98] * spans,
            "r2_tension": 0.998,
            "r2_speed": 0.999,
            "mae_tension_n": 0.081,
            "mae_speed_m_per_s": 8e-5,
            "whiteness": "white",
        },
        "alignment": [{"channel": "tension", "late_s": 0.0001, "low_s": -0.0002, "high_s": 0.0004}],
        "parent": None,
        **changes,
    }


def model(spans: int = 2, scale: float = 1.0, **changes: Any) -> LineModel:
    return LineModel.model_validate(fields(spans, scale, **changes))


finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(min_value=0.0, exclude_min=True, allow_infinity=False)
from_0 = st.floats(min_value=0.0, allow_infinity=False)
words = st.text(st.characters(codec="utf-8"), min_size=1, max_size=20)
digests = st.text("0123456789abcdef", min_size=64, max_size=64)
names = st.from_regex(r"[a-z0-9]([a-z0-9-]{0,30}[a-z0-9])?", fullmatch=True)


def _lists(values: st.SearchStrategy[Any], n: int) -> st.SearchStrategy[list[Any]]:
    return st.lists(values, min_size=n, max_size=n)


@st.composite
def _ranges(draw: st.DrawFn, count: int = 2) -> list[float]:
    return sorted(draw(_lists(finite, count)))


@st.composite
def any_posterior(draw: st.DrawFn, n: int, deviation: float = 0.5) -> dict[str, Any]:
    """Names for n spans, shared or each, and a covariance of any rank; deviations up to `deviation`."""
    names: list[str] = []
    for base in PHYSICAL:
        each = base != "stiffness_n" and draw(st.booleans())
        names += [f"{base}[{i}]" for i in range(1, n + 1)] if each else [base]
    names = draw(st.permutations(names))[: draw(st.integers(1, len(names)))]
    k = len(names)
    factor = np.random.default_rng(draw(st.integers(0, 2**32))).standard_normal((k, draw(st.integers(1, k + 1))))
    covariance = factor @ factor.T
    scale = deviation * np.array(draw(_lists(st.floats(0.0, 1.0), k))) / np.sqrt(np.diag(covariance))
    covariance = covariance * np.outer(scale, scale)
    return {"names": names, "covariance": (0.5 * (covariance + covariance.T)).tolist()}


@st.composite
def any_fields(draw: st.DrawFn) -> dict[str, Any]:
    """Whatever the format allows."""
    n = draw(st.integers(1, 5))
    whose = st.sampled_from([*OF_THE_LINE, *PER_SPAN]) | st.builds(
        "{}[{}]".format, st.sampled_from(list(PER_SPAN)), st.integers(1, n)
    )
    intervals = {
        name: dict(zip(("low", "value", "high"), draw(_ranges(3)), strict=True))
        for name in draw(st.lists(whose, max_size=6, unique=True))
    }
    tensions = [draw(_ranges() | st.just([None, None])) for _ in range(n)]
    speed = draw(_ranges())
    validation = {
        "samples": draw(st.integers(1, 10**9)),
        "innovation_tension": draw(_lists(from_0 | st.none(), n)),
        "innovation_speed": draw(_lists(from_0, n)),
        "r2_tension": draw(st.floats(max_value=1.0, allow_infinity=False, allow_nan=False) | st.none()),
        "r2_speed": None,
        "mae_tension_n": draw(from_0),
        "mae_speed_m_per_s": draw(from_0),
        "whiteness": draw(st.sampled_from(["white", "coloured", "not tested"])),
    }
    return {
        "format": 1,
        "site": draw(names),
        "line": draw(names),
        "created": draw(st.datetimes(timezones=st.sampled_from(ZONES)).map(lambda t: t.isoformat())),
        "program_version": draw(words),
        "method": draw(words),
        "structure": draw(
            st.fixed_dictionaries({name: st.booleans() for name in ("per_roller", "coulomb", "torque_lag")})
        ),
        "parameters": {
            "stiffness_n": draw(positive),
            "length_m": draw(_lists(positive, n)),
            "radius_m": draw(_lists(positive, n)),
            "inertia_kg_m2": draw(_lists(positive, n)),
            "friction_nms_per_rad": draw(_lists(positive, n)),
            "coulomb_nm": draw(_lists(from_0, n)),
            "torque_lag_s": draw(from_0),
            "latency_s": draw(from_0),
        },
        "noise": draw(
            st.none()
            | st.fixed_dictionaries(dict.fromkeys(("tension_n", "speed_m_per_s", "acceleration_m_per_s1_5"), positive))
        ),
        "intervals": intervals,
        "data": {
            "digest": draw(digests),
            "source": draw(words),
            "samples": draw(st.integers(1, 10**9)),
            "period_s": draw(positive),
        },
        "region": {
            "speed_from_m_per_s": speed[0],
            "speed_to_m_per_s": speed[1],
            "tension_from_n": [low for low, _ in tensions],
            "tension_to_n": [high for _, high in tensions],
        },
        "validation": draw(st.sampled_from([None, validation])),
        "parent": draw(digests | st.none()),
        "posterior": draw(st.none() | any_posterior(n)),
    }
