"""What a chain of small steps is held against: what was archived, else the first that was kept for as much."""

import asyncio
from pathlib import Path

import numpy as np
import pytest

from gateway.core.controller import config_hash
from gateway.core.deployment import Region
from gateway.core.states import LoopState, Phase
from gateway.core.steady_clock import SteadyClock
from gateway.core.telemetry import Frame
from gateway.supervisor.configurations import STABLE, Origin, begin_configurations
from gateway.supervisor.lifecycle import Book, Entry, Stage
from gateway.supervisor.models import begin_repository
from gateway.supervisor.recent import Recent
from gateway.supervisor.surroundings import LineSurroundings
from tests.unit.deployer_support import LINE, controller

SMALL, WIDE = Region(speed_max_m_per_s=0.02, tension_step_max_n=4.0), Region(speed_max_m_per_s=0.1)
STOOD = Frame(
    0, 0.0, 0.0, 0.0, 0, 0.0, 0.0, LoopState.READY, Phase.READY, False, True, False, 0, 0,
    *(np.ones(LINE.n) for _ in range(5)), *(np.zeros(LINE.n, dtype=np.int64) for _ in range(2)),
)  # fmt: skip


def hash_of(k: int) -> str:
    return config_hash(controller(k))


def kept(*configurations: tuple[int, Region]) -> Book:
    """These were kept one after the other; the last one is in service."""
    book = Book()
    for number, (k, region) in enumerate(configurations):
        proposal = f"{number:064x}"
        book.entries[proposal] = Entry(
            proposal, "gains", "ann", "0" * 64, hash_of(k), "", "", 4e9, Stage.KEPT, region=region, number=number
        )
        book.in_service, book.region = hash_of(k), region
    return book


@pytest.fixture
def storage(tmp_path: Path):
    with begin_configurations(tmp_path / "configurations.sqlite") as found:
        for k in range(4):
            found.store(LINE.site, LINE.line, controller(k), Origin(1.0, "design", "a test"))
        yield found


@pytest.fixture
def baseline(tmp_path: Path, storage):
    """Of a context: which configuration, and as far as what."""
    with begin_repository(tmp_path / "models.sqlite") as models:
        recent = Recent(LINE.n, LINE.control.period_s)
        args = (
            lambda: STOOD,
            recent,
            lambda age_s: [],
            storage,
            models,
            SteadyClock(lambda: 1000.0, lambda: 1000.0, "boot"),
        )
        surroundings = LineSurroundings(LINE, *args)

        def asked(book: Book):
            context, _ = asyncio.run(surroundings.context(book))
            found = context.baseline
            number = None if found is None else next(k for k in range(4) if controller(k) == found)
            return number, context.baseline_region

        yield asked


def test_the_first_that_was_kept_for_as_much_stays_the_measure_however_many_follow(baseline):
    assert baseline(kept((0, SMALL), (1, WIDE), (2, WIDE))) == (1, WIDE)
    assert baseline(kept((0, SMALL), (1, WIDE), (2, WIDE), (3, WIDE))) == (1, WIDE)


def test_the_one_in_service_is_held_against_itself_once(baseline):
    assert baseline(kept((0, SMALL), (1, WIDE)))[0] is None
    assert baseline(kept((0, SMALL), (1, WIDE), (2, WIDE), (1, WIDE)))[0] is None


def test_one_that_was_kept_for_more_is_a_measure_as_far_as_it_was(baseline):
    assert baseline(kept((0, WIDE), (1, SMALL))) == (0, WIDE)


def test_one_that_was_kept_again_for_more_is_a_measure_for_that(baseline):
    assert baseline(kept((0, SMALL), (0, WIDE), (1, WIDE))) == (0, WIDE)


def test_what_nobody_has_judged_is_no_measure(baseline):
    book = kept((1, WIDE))
    book.in_service, book.region = hash_of(2), Region()  # the loop was started with it
    assert baseline(book)[0] is None


def test_what_was_kept_on_another_web_is_no_measure(baseline):
    book = kept((0, WIDE), (1, WIDE))
    book.before_change = 1
    assert baseline(book)[0] is None


def test_what_was_archived_goes_before_it_and_is_a_measure_everywhere(baseline, storage):
    storage.archive(LINE.site, LINE.line, hash_of(3), STABLE, 900.0, "ann", "it held")
    assert baseline(kept((0, WIDE), (1, WIDE))) == (3, Region())
    book = kept((0, WIDE), (1, WIDE))
    book.line_changed_s = 950.0
    assert baseline(book) == (0, WIDE)
