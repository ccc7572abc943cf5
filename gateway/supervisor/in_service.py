"""What controls the line, as people name it: which kind of controller, how far the line has come, how well it did.

Out of the stores beside the gateway, read in a thread, and again only when one of them has changed or could not be
read.
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

WAIT_S = 0.5  #: for the disk; then the last answer does

What = tuple[str | None, float | None]  #: hash of what is in service, and when the line has changed
Stamps = tuple[tuple[int, int] | None, ...]
UNKNOWN = InServiceTold(kind=None, phase=None, performance=None)


class InServiceView:
    def __init__(self, line: Line, folder: Path, wait_s: float = WAIT_S) -> None:
        self._line = line
        self._folder = folder
        self._wait_s = wait_s
        self._known: tuple[What, Stamps | None, InServiceTold] | None = None  #: without stamps: to be read again
        self._reading: asyncio.Task[None] | None = None

    async def told(self, book: Book) -> InServiceTold:
        """Nothing, of what is not known. A store that is held up holds up nobody who asks."""
        what = book.in_service, book.line_changed_s
        if self._reading is None or self._reading.done():
            self._reading = asyncio.get_running_loop().create_task(asyncio.to_thread(self._read, *what))
        await asyncio.wait([self._reading], timeout=self._wait_s)
        return UNKNOWN if self._known is None or self._known[0] != what else self._known[2]

    def _read(self, in_service: str | None, line_changed_s: float | None) -> None:
        what = in_service, line_changed_s
        stamps = tuple(_stamp(self._folder / one.FILE_NAME) for one in (configurations, baselines))
        if self._known is not None and self._known[:2] == (what, stamps):
            return
        kind, kind_read = self._kind(in_service)
        measurements = self._measurements()
        since = [one for one in measurements or [] if line_changed_s is None or one.run.measured_s > line_changed_s]
        phase = "operation" if any(one.baseline for one in since) else "commissioning"
        found = InServiceTold(
            kind=kind, phase=None if measurements is None else phase, performance=_performance(in_service, since)
        )
        self._known = what, stamps if kind_read and measurements is not None else None, found

    def _kind(self, in_service: str | None) -> tuple[str | None, bool]:
        """None: it is not stored; and whether that could be read."""
        path = self._folder / configurations.FILE_NAME
        if in_service is None or not path.exists():
            return None, True
        try:
            with open_configurations(path) as store:
                found = store.get(self._line.site, self._line.line, in_service)
        except ConfigurationsError:
            return None, False
        controller = None if found is None else found.controller
        return None if controller is None else kind_of(controller), True

    def _measurements(self) -> list[Measurement] | None:
        """None: they cannot be read."""
        path = self._folder / baselines.FILE_NAME
        if not path.exists():
            return []
        try:
            with open_baselines(path) as store:
                return store.measurements(self._line.site, self._line.line)
        except BaselinesError:
            return None


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
