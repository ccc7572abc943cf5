"""What controls the line, as people name it: which kind of controller, how far the line has come, how well it did.

Out of the stores beside the gateway, read in a thread, and again only when one of them has changed.
"""

import asyncio
from collections.abc import Iterable
from pathlib import Path

from gateway.core.controller import Controller
from gateway.core.controller_schedule import ScheduledConfig
from gateway.core.decisions import InServiceTold, PerformanceTold
from gateway.core.line import Line
from gateway.supervisor import baselines, configurations
from gateway.supervisor.baselines import BaselinesError, Measurement, open_baselines
from gateway.supervisor.configurations import ConfigurationsError, open_configurations
from gateway.supervisor.lifecycle import Book

Key = tuple[str | None, float | None, tuple[tuple[int, int] | None, ...]]


class InServiceView:
    def __init__(self, line: Line, folder: Path) -> None:
        self._line = line
        self._folder = folder
        self._known: tuple[Key, InServiceTold] | None = None
        self._reading = asyncio.Lock()

    async def told(self, book: Book) -> InServiceTold:
        """Nothing, of what is not known."""
        async with self._reading:
            return await asyncio.to_thread(self._told, book.in_service, book.line_changed_s)

    def _told(self, in_service: str | None, line_changed_s: float | None) -> InServiceTold:
        stores = [self._folder / one.FILE_NAME for one in (configurations, baselines)]
        key = in_service, line_changed_s, tuple(map(_stamp, stores))
        if self._known is None or self._known[0] != key:
            measurements = self._measurements()
            since = [one for one in measurements if line_changed_s is None or one.run.measured_s > line_changed_s]
            found = InServiceTold(
                kind=self._kind(in_service),
                phase="operation" if any(one.baseline for one in since) else "commissioning",
                performance=_performance(in_service, since),
            )
            self._known = key, found
        return self._known[1]

    def _kind(self, in_service: str | None) -> str | None:
        if in_service is None:
            return None
        try:
            with open_configurations(self._folder / configurations.FILE_NAME) as store:
                controller = store.find(in_service, self._line.site, self._line.line).controller
        except ConfigurationsError:
            return None
        return None if controller is None else kind_of(controller)

    def _measurements(self) -> list[Measurement]:
        try:
            with open_baselines(self._folder / baselines.FILE_NAME) as store:
                return store.measurements(self._line.site, self._line.line)
        except BaselinesError:
            return []


def kind_of(controller: Controller) -> str:
    """Of one that is scheduled over speed, the law that is."""
    if isinstance(controller, ScheduledConfig):
        return f"{controller.laws[0].kind.upper()}, scheduled"
    return controller.kind.upper()


def _performance(in_service: str | None, measurements: Iterable[Measurement]) -> PerformanceTold | None:
    """The newest of what is in service, against the baseline of the same scenario."""
    every = list(measurements)
    own = [one for one in every if one.run.configuration == in_service]
    if not own:
        return None
    newest = max(own, key=lambda one: one.run.measured_s).run
    baseline = [one for key, one in baselines.in_force(every).items() if key[2] == newest.scenario]
    return PerformanceTold(
        scenario=newest.scenario, measured_s=newest.measured_s, rmse_n=newest.measured.rmse_n,
        baseline_rmse_n=baseline[0].run.measured.rmse_n if baseline else None,
    )  # fmt: skip


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size
