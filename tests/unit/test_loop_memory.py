"""When the loop's process collects what has become garbage: at rest, and no oftener than the line comes to rest."""

import gc
import subprocess
import sys

import pytest

from gateway.core.states import Phase
from gateway.loop.cycle import WITH_TORQUE
from gateway.loop.memory import RestCollector

A_RUN = (Phase.SILENT, Phase.ARMING, Phase.READY, Phase.ENABLING, *WITH_TORQUE, Phase.OFF)
#: What lives after start-up, then the cycles of a run; the number of full collections meanwhile.
_RUN = """
import gc
from gateway.loop.realtime import freeze_collector
lives = [[] for _ in range(400_000)]
freeze_collector()
before = gc.get_stats()[2]["collections"]
for _ in range(100_000):
    cycle = []
    cycle.append(cycle)
    lives.append([])
print(gc.get_stats()[2]["collections"] - before)
"""


def test_it_collects_once_each_time_the_line_has_come_to_rest() -> None:
    collected: list[Phase] = []
    phase = Phase.SILENT
    collector = RestCollector(lambda: collected.append(phase))
    for _ in range(2):
        for phase in A_RUN:
            for _ in range(3):
                collector.note_phase(phase)
    assert collected == [Phase.OFF, Phase.OFF]


@pytest.mark.parametrize("phase", [phase for phase in Phase if phase not in (Phase.SILENT, Phase.OFF)])
def test_it_never_collects_otherwise(phase: Phase) -> None:
    collected: list[None] = []
    collector = RestCollector(lambda: collected.append(None))
    collector.note_phase(phase)
    collector.note_phase(phase)
    assert not collected


@pytest.mark.slow
def test_it_finds_a_cycle_that_a_run_has_left() -> None:
    collector = RestCollector()
    gc.collect()
    gc.disable()
    try:
        cycle: list[object] = []
        cycle.append(cycle)
        del cycle
        collector.note_phase(Phase.RUNNING)
        collector.note_phase(Phase.OFF)
        assert gc.collect() == 0
    finally:
        gc.enable()


def test_what_was_frozen_does_not_put_off_the_next_full_collection() -> None:
    found = subprocess.run([sys.executable, "-c", _RUN], check=True, capture_output=True, text=True)
    assert int(found.stdout) >= 1
