"""A trial between the deployer and telemetry with late samples: kept, taken back, or not kept yet, and why it says."""

import numpy as np
import pytest

from gateway.core.controller import config_hash
from gateway.core.signals import Quality
from gateway.core.states import LoopState
from gateway.core.telemetry import frame_dtype
from gateway.supervisor.lifecycle import Stage
from gateway.supervisor.recent import Recent
from gateway.supervisor.surroundings import LineSurroundings
from tests.unit.deployer_gateway import PROBATION_S, Gateway, run, started
from tests.unit.deployer_support import FIRST, LINE, hash_of, proposal

N, PERIOD_S, LOOK_S, CELL = LINE.n, LINE.control.period_s, 0.5, 1


class Telemetry:
    """Of a line that stands in RUN, heard by a gateway's surroundings."""

    def __init__(self, gateway: Gateway) -> None:
        self.swing_n = 0.0  #: of one tension
        self.late = 0.0  #: share of the samples of its load cell
        self.told = True
        self.lost = 0.0  #: share of the frames
        self._gateway, self._random = gateway, np.random.default_rng(3)
        self._recent = Recent(N, PERIOD_S)
        real = LineSurroundings(LINE, lambda: None, self._recent, lambda _: [], None, None, lambda: 0.0)  # type: ignore[arg-type]
        for name in ("begin_probation", "against_keeping", "unseen"):
            setattr(gateway.surroundings, name, getattr(real, name))

    async def pass_time(self, seconds: float) -> None:
        for _ in range(round(seconds / LOOK_S)):
            self._gateway.loop.pass_time(LOOK_S)
            if self.told:
                self._tell()
            await self._gateway.look()

    def _tell(self) -> None:
        count = round(LOOK_S / PERIOD_S)
        rows, time_s = np.zeros(count, frame_dtype(N)), self._gateway.loop.now_s + PERIOD_S * np.arange(1 - count, 1)
        rows["state"], rows["time_s"] = LoopState.RUN, time_s
        rows["tension_setpoint_n"] = rows["tension_n"] = 30.0
        rows["tension_n"][:, CELL] += self.swing_n * np.sin(2.0 * np.pi * time_s)
        rows["tension_quality"][self._random.uniform(size=count) < self.late, CELL] = Quality.STALE
        for row in rows[self._random.uniform(size=count) >= self.lost]:
            self._recent.take(row.tobytes())


async def on_trial() -> tuple[Gateway, object, Telemetry]:
    gateway = await started()
    telemetry = Telemetry(gateway)
    await telemetry.pass_time(10.0)
    one = proposal(1, config_hash(FIRST), gateway.loop.now_s)
    assert (await gateway.propose(one)).ok and (await gateway.decide(one)).ok
    return gateway, one, telemetry


def why(gateway: Gateway, one: object) -> str:
    return gateway.deployer.shown(hash_of(one)).why


@pytest.mark.parametrize("late", [0.005, 0.02, 0.05])
def test_a_swing_takes_a_trial_back_through_late_samples(late: float) -> None:
    @run
    async def swings() -> None:
        gateway, one, telemetry = await on_trial()
        telemetry.swing_n, telemetry.late = 12.0, late
        await telemetry.pass_time(PROBATION_S)
        assert gateway.stage(one) is Stage.ROLLED_BACK and gateway.loop.runs == config_hash(FIRST)
        assert "tension 2 swings by" in why(gateway, one)

    swings()


@run
async def test_a_few_late_samples_do_not_keep_a_good_change_from_being_kept():
    gateway, one, telemetry = await on_trial()
    telemetry.late = 0.05
    await telemetry.pass_time(PROBATION_S + 5.0)
    assert gateway.stage(one) is Stage.KEPT


@run
async def test_a_trial_that_is_hardly_seen_says_so_and_goes_back():
    gateway, one, telemetry = await on_trial()
    telemetry.late, telemetry.swing_n = 0.6, 12.0
    await telemetry.pass_time(PROBATION_S)
    assert gateway.stage(one) is Stage.PROBATION
    change = gateway.deployer.change()
    assert change is not None and change.text == why(gateway, one)
    assert "the load cell of span 2 has told" in change.text and "80% are needed" in change.text
    await telemetry.pass_time(PROBATION_S)
    assert gateway.stage(one) is Stage.ROLLED_BACK
    assert "too little was seen" in why(gateway, one) and "span 2" in why(gateway, one)


@pytest.mark.parametrize("lost", [0.25, 0.32, 0.9])
def test_a_trial_of_which_frames_are_lost_goes_back_and_does_not_stay_without_end(lost: float) -> None:
    @run
    async def hardly_seen() -> None:
        gateway, one, telemetry = await on_trial()
        telemetry.lost, telemetry.swing_n = lost, 12.0
        await telemetry.pass_time(3.0 * PROBATION_S)
        assert gateway.stage(one) is Stage.ROLLED_BACK and gateway.loop.runs == config_hash(FIRST)

    hardly_seen()


@run
async def test_a_trial_that_is_hardly_seen_now_and_then_comes_to_an_end():
    gateway, one, telemetry = await on_trial()
    for _ in range(40):
        telemetry.late = 1.0 - telemetry.late  # five seconds so, five seconds so
        await telemetry.pass_time(5.0)
    assert gateway.stage(one) in (Stage.ROLLED_BACK, Stage.KEPT)


@run
async def test_a_trial_of_which_no_telemetry_comes_goes_back():
    gateway, one, telemetry = await on_trial()
    telemetry.told = False
    await telemetry.pass_time(5.0)
    assert gateway.stage(one) is Stage.PROBATION and "no telemetry" in why(gateway, one)
    await telemetry.pass_time(PROBATION_S)
    assert gateway.stage(one) is Stage.ROLLED_BACK


@run
async def test_telemetry_that_ends_does_not_keep_what_was_good_until_then():
    gateway, one, telemetry = await on_trial()
    await telemetry.pass_time(PROBATION_S - 1.0)
    telemetry.told = False
    await telemetry.pass_time(PROBATION_S)
    assert gateway.stage(one) is not Stage.KEPT
    await telemetry.pass_time(2.0)
    assert gateway.stage(one) is Stage.ROLLED_BACK


@run
async def test_what_is_lost_for_a_while_is_looked_at_again():
    gateway, one, telemetry = await on_trial()
    await telemetry.pass_time(PROBATION_S - 5.0)
    telemetry.late = 1.0
    await telemetry.pass_time(10.0)
    assert gateway.stage(one) is Stage.PROBATION
    telemetry.late = 0.0
    await telemetry.pass_time(5.0)
    assert gateway.stage(one) is Stage.KEPT
