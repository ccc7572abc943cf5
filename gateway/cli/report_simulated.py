"""The report's figures of the paper: courses of tension and torque of each configuration under identical conditions."""

from collections.abc import Mapping, Sequence
from math import ceil, isfinite

import numpy as np

from gateway.cli.report import Chart, Section, Series, Table
from gateway.cli.report_courses import SEED, Conditions, Named, Simulated, time_of
from gateway.cli.within_region import beyond
from gateway.commissioning.ground import course_of
from gateway.core.scenario import Scenario
from gateway.core.signals import FloatArray

MOST_SHOWN = 5  #: with the reference as many as there are colours
PLOT_EVERY_S = 0.01  #: at least, between the samples of a chart
MANY_SPANS = 12  #: beyond which there are fewer samples, so that the page stays within some megabytes
LOST = "ran away"


def chosen_of(named: Sequence[Named], shown: Sequence[str]) -> list[Named]:
    """Of the configurations whose hashes are `shown`: with the one before them, and no more than can be told apart.

    Where they are too many, the first and the newest.
    """
    places = [k for k, one in enumerate(named) if one.hash in shown]
    some = list(named[max(0, places[0] - 1) : places[-1] + 1]) if places else list(named[-1:])
    return some if len(some) <= MOST_SHOWN else [some[0], *some[1 - MOST_SHOWN :]]


def summary_section(
    conditions: Conditions, named: Sequence[Named], cases: Sequence[Scenario],
    found: Mapping[str, Sequence[Simulated | str]],
) -> Section:  # fmt: skip
    """RMSE, overshoot, settling and effort of every case, one table each."""
    model = conditions.model
    on = "the nominal model of the line's file: no model is accepted" if model is None else "the accepted model"
    noise = conditions.noise
    said = (
        f"Every configuration is simulated on {on}, as the line is believed to be now, whatever it was judged on: the "
        f"same cases, seed {SEED}, noise of {noise.tension_n:.3g} N and {noise.speed_m_per_s:.3g} m/s, limits and "
        f"latency. What the line itself has shown stands under Measured on the line.",
    )
    return Section("Under identical conditions", said, tuple(_table(case, named, found[case.name]) for case in cases))


def _table(case: Scenario, named: Sequence[Named], found: Sequence[Simulated | str]) -> Table:
    heads = (
        "Configuration",
        "Law",
        "RMSE, N",
        "Change",
        "Overshoot, %",
        "Settling, s",
        "Effort, N²m²s",
        "Judged for it",
    )
    rows: list[tuple[str, ...]] = []
    before: Simulated | None = None
    for one, run in zip(named, found, strict=True):
        judged = one.unjudged if one.region is None else beyond(case, one.region) or "yes"
        law = one.controller.kind.upper()
        if isinstance(run, str):
            rows.append((one.name, law, "-", "-", "-", "-", "-", f"not simulated: {run}"))
            continue
        rows.append((one.name, law, *_figures(run, before), judged))
        before = run
    return Table(
        f"{case.heading}, simulated. {case.description} Overshoot and settling are the worst span's, without noise. "
        "Change: of the RMSE, against the row before.",
        heads,
        tuple(rows),
        frozenset(range(2, 7)),
    )


def _figures(run: Simulated, before: Simulated | None) -> tuple[str, ...]:
    change = "-"
    if before is not None and isfinite(before.rmse_n) and isfinite(run.rmse_n) and before.rmse_n > 0.0:
        change = f"{100.0 * (run.rmse_n / before.rmse_n - 1.0):+.1f} %".replace("-", "−")
    settling = "never" if isfinite(run.rmse_n) and not isfinite(run.settling_s) else _figure(run.settling_s, 2)
    return _figure(run.rmse_n, 4), change, _figure(run.overshoot_pct, 1), settling, _figure(run.effort_n2m2s, 0)


def _figure(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if isfinite(value) else LOST


def case_section(
    case: Scenario, named: Sequence[Named], found: Sequence[Simulated | str], period_s: float, spans: Sequence[str]
) -> Section:
    """Tension and torque span by span. `spans`: their names."""
    runs = [(one.name, run) for one, run in zip(named, found, strict=True) if isinstance(run, Simulated)]
    title = f"{case.heading}, simulated"
    if not runs:
        return Section(title, (case.description, "None could be simulated."))
    course = course_of(case, period_s)
    every = max(1, round(PLOT_EVERY_S / period_s)) * ceil(len(spans) / MANY_SPANS)
    time_s: FloatArray = time_of(course, period_s)[::every]
    tension, torque = list[Chart](), list[Chart]()
    for span, span_name in enumerate(spans):
        of_tension = [Series(name, run.tension_n[::every, span]) for name, run in runs]
        setpoint = Series("set-point", course.tension_n[::every, span], dashed=True)
        own = f" ({span_name})" if span_name else ""
        tension.append(Chart(f"Tension, span {span + 1}{own}", "N", time_s, (*of_tension, setpoint)))
        of_torque = tuple(Series(name, _finite(run.torque_nm[::every, span])) for name, run in runs)
        torque.append(Chart(f"Torque, roller {span + 1}", "Nm", time_s, of_torque))
    said = (case.description, "Simulated under identical conditions, with noise.")
    return Section(title, said, charts=(*tension, *torque))


def _finite(values: FloatArray) -> FloatArray:
    return np.where(np.isfinite(values), values, np.nan)
