"""What controls the line, by name, and how well it did: out of the stores, and nothing where nothing is known."""

import asyncio
import os
import threading

import pytest

from gateway.core.controller import config_hash
from gateway.core.controller_schedule import SHARED, ScheduledConfig
from gateway.core.decisions import InServiceTold
from gateway.supervisor import baselines, configurations, in_service
from gateway.supervisor.baselines import Measured, MeasuredRun, begin_baselines
from gateway.supervisor.configurations import Origin, begin_configurations
from gateway.supervisor.in_service import InServiceView, kind_of
from gateway.supervisor.lifecycle import Book
from tests.unit.deployer_support import FIRST, LINE, controller

OTHER = controller(1)


def measured(folder, config, rmse_n, at_s, baseline=False, scenario="commissioning"):
    found = Measured(rmse_n, 1.0, 1.0, 1.0)
    run = MeasuredRun(LINE.site, LINE.line, config_hash(config), None, scenario, at_s, found, {})
    with begin_baselines(folder / baselines.FILE_NAME) as store:
        stored = store.add(run)
        if baseline:
            store.set_baseline(stored.number, at_s, "test", "test")


def told(view, config=FIRST, changed_s=None) -> InServiceTold:
    hash_ = None if config is None else config_hash(config)
    return asyncio.run(view.told(Book(in_service=hash_, line_changed_s=changed_s)))


def test_nothing_is_made_up_where_nothing_is_stored(tmp_path):
    view = InServiceView(LINE, tmp_path)
    assert told(view) == told(view, None) == InServiceTold(kind=None, phase="commissioning", performance=None)


def test_what_is_in_service_is_held_against_the_baseline_of_its_scenario(tmp_path):
    view = InServiceView(LINE, tmp_path)
    with begin_configurations(tmp_path / configurations.FILE_NAME) as store:
        store.store(LINE.site, LINE.line, FIRST, Origin(1.0, "test", "test"))
    assert told(view).kind == "LQI" and told(view, OTHER).kind is None
    measured(tmp_path, FIRST, 2.0, 10.0)
    measured(tmp_path, FIRST, 1.5, 20.0)
    measured(tmp_path, OTHER, 9.0, 30.0, baseline=True, scenario="something else")
    found = told(view).performance
    assert (found.rmse_n, found.measured_s, found.baseline_rmse_n) == (1.5, 20.0, None)
    measured(tmp_path, OTHER, 0.8, 40.0, baseline=True)
    found = told(view)
    assert (found.performance.rmse_n, found.performance.baseline_rmse_n, found.phase) == (1.5, 0.8, "operation")
    assert told(view, changed_s=15.0).performance.rmse_n == 1.5
    later = told(view, changed_s=50.0)  # of the line as it was
    assert (later.phase, later.performance) == ("commissioning", None)


def test_it_is_read_again_only_when_something_has_changed(tmp_path, monkeypatch):
    view = InServiceView(LINE, tmp_path)
    opened: list[str] = []
    right = in_service.open_baselines
    monkeypatch.setattr(in_service, "open_baselines", lambda path: opened.append(path) or right(path))
    measured(tmp_path, FIRST, 3.0, 5.0)
    for _ in range(3):
        told(view)
    assert len(opened) == 1
    measured(tmp_path, FIRST, 2.0, 10.0)
    for _ in range(3):
        assert told(view).performance.rmse_n == 2.0
    assert len(opened) == 2


@pytest.mark.parametrize("damaged", [configurations.FILE_NAME, baselines.FILE_NAME])
def test_a_damaged_store_is_nothing_known_until_it_can_be_read(tmp_path, damaged):
    with begin_configurations(tmp_path / configurations.FILE_NAME) as store:
        store.store(LINE.site, LINE.line, FIRST, Origin(1.0, "test", "test"))
    measured(tmp_path, FIRST, 2.0, 10.0, baseline=True)
    path = tmp_path / damaged
    whole, times = path.read_bytes(), (path.stat().st_atime_ns, path.stat().st_mtime_ns)

    def write(content: bytes) -> None:
        path.write_bytes(content)
        os.utime(path, ns=times)

    view = InServiceView(LINE, tmp_path)
    write(b"x" * len(whole))
    found = told(view)
    if damaged == configurations.FILE_NAME:
        assert (found.kind, found.phase) == (None, "operation")
    else:
        assert (found.kind, found.phase, found.performance) == ("LQI", None, None)  # and not commissioning
    write(whole)  # it looks as it did before
    found = told(view)
    assert (found.kind, found.phase, found.performance.rmse_n) == ("LQI", "operation", 2.0)


def test_a_store_that_is_held_up_holds_up_nobody(tmp_path, monkeypatch):
    measured(tmp_path, FIRST, 2.0, 10.0)
    held, right = threading.Event(), in_service.open_baselines

    def slow(path):
        assert held.wait(60.0)
        return right(path)

    async def story():
        view, book = InServiceView(LINE, tmp_path), Book(in_service=config_hash(FIRST))
        known = await view.told(book)
        measured(tmp_path, FIRST, 1.0, 20.0)
        monkeypatch.setattr(in_service, "open_baselines", slow)
        view._wait_s = 0.0  # noqa: SLF001 (that of the product is for a disk)
        assert await view.told(book) == await view.told(book) == known
        other = Book(in_service=config_hash(OTHER))
        assert await view.told(other) == in_service.UNKNOWN  # the last answer is not of this
        held.set()
        view._wait_s = 60.0  # noqa: SLF001
        await view.told(book)
        return (await view.told(book)).performance.rmse_n, known.performance.rmse_n

    assert asyncio.run(story()) == (1.0, 2.0)


def test_a_schedule_is_named_by_its_law():
    shared = {name: getattr(FIRST, name) for name in SHARED}
    schedule = ScheduledConfig(speed_m_per_s=[0.1, 0.5], laws=[FIRST, FIRST], **shared)
    assert (kind_of(FIRST), kind_of(schedule)) == ("LQI", "LQI, scheduled")
