"""Arrays as the page carries them: packed, thinned where that is said, and safe inside a script element."""

import base64
import json
from typing import Any

import numpy as np

from gateway.cli.report.data import Case, FloatArray, Report, Timing

TIMING_POINTS = 900  #: at most, per timing chart; more could not be told apart on a screen
BINS_PER_DECADE = 12


def page_data(report: Report) -> str:
    """The numbers of the page's charts. All text stands in the page itself, none of it here."""
    return script_json(
        {
            "cases": [_case(case) for case in report.cases],
            "timing": None if report.timing is None else _timing(report.timing),
        }
    )


def script_json(data: object) -> str:
    """JSON that nothing in it can end early in a script element: `<`, `>` and `&` are written as escapes."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", r"\u003c").replace(">", r"\u003e").replace("&", r"\u0026")


def packed(values: FloatArray, dtype: str = "<f4") -> dict[str, Any]:
    """Little-endian bytes in base64, with type and shape. float32 keeps seven digits: more than any sensor here."""
    array = np.ascontiguousarray(values, dtype=dtype)
    return {"type": dtype[1:], "shape": list(array.shape), "base64": base64.b64encode(array.tobytes()).decode()}


def unpacked(entry: dict[str, Any]) -> FloatArray:
    """The inverse of `packed`."""
    return np.frombuffer(base64.b64decode(entry["base64"]), "<" + entry["type"]).reshape(entry["shape"])


def cycles_per_point(timing: Timing) -> int:
    """How many cycles one point of the timing charts stands for."""
    return -(-len(timing.time_s) // TIMING_POINTS)


def envelope(values: FloatArray, width: int) -> FloatArray:
    """Smallest, median and largest of each `width` values, shape (3, points): thinning that hides no outlier.

    The last point may stand for fewer values. A point of NaN only stays NaN.
    """
    padded = np.full(-(-len(values) // width) * width, np.nan)
    padded[: len(values)] = values
    buckets = np.ma.masked_invalid(padded.reshape(-1, width))
    rows = [buckets.min(axis=1), np.ma.median(buckets, axis=1), buckets.max(axis=1)]
    return np.array([np.ma.filled(row.astype(float), np.nan) for row in rows])


def histogram_edges_us(*series: FloatArray) -> FloatArray:
    """Bin edges evenly spaced on a log scale, from 1 us (or below it, everything) to beyond the largest value."""
    largest = max(10.0, *(float(np.nanmax(values, initial=0.0)) for values in series))
    decades = np.floor(np.log10(largest) * BINS_PER_DECADE + 1.0) / BINS_PER_DECADE
    return np.logspace(0.0, decades, round(decades * BINS_PER_DECADE) + 1)


def histogram(values: FloatArray, edges: FloatArray) -> list[int]:
    """Counts per bin; the first takes what lies below it too, so that every finite value is counted."""
    finite = values[np.isfinite(values)]
    return np.histogram(np.maximum(finite, edges[0]), edges)[0].tolist()


def _case(case: Case) -> dict[str, Any]:
    return {
        "time_s": packed(case.time_s, "<f8"),
        "tension_n": packed(case.tension_n),
        "setpoint_n": packed(case.setpoint_n),
        "torque_nm": packed(case.torque_nm),
        "speed_m_per_s": packed(case.speed_m_per_s),
        "unwind_speed_m_per_s": packed(case.unwind_speed_m_per_s),
        "torque_limit_nm": case.torque_limit_nm,
        "tension_band_n": [case.tension_min_n, case.tension_max_n],
    }


def _timing(timing: Timing) -> dict[str, Any]:
    width = cycles_per_point(timing)
    edges = histogram_edges_us(timing.lateness_us, timing.cycle_us)
    return {
        "time_s": packed(timing.time_s[::width], "<f8"),
        "lateness_us": packed(envelope(timing.lateness_us, width)),
        "cycle_us": packed(envelope(timing.cycle_us, width)),
        "period_us": timing.period_us,
        "edges_us": edges.round(3).tolist(),
        "lateness_count": histogram(timing.lateness_us, edges),
        "cycle_count": histogram(timing.cycle_us, edges),
    }
