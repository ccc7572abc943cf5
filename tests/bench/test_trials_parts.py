"""Parts of bench-trials: answers that are late, and what is called good and bad."""

import asyncio
from types import SimpleNamespace

import numpy as np
import pytest

from gateway.core.signals import Inputs, Quality
from gateway.supervisor.lifecycle import Stage
from tests.bench.trials import LONGEST_S
from tests.bench.trials_runs import LateLink, TrialRun, draw_bad, draw_good, stops
from tests.closed_loop.recorded import demonstration_line

LINE = demonstration_line()


class Told:
    """A line that tells another number each time."""

    def __init__(self) -> None:
        self.count = 0.0

    def sample(self, now_s):
        self.count += 1.0
        each = np.full(LINE.n, self.count)
        return SimpleNamespace(
            tension_n=each, speed_m_per_s=each, torque_nm=each, unwind_speed_m_per_s=self.count, permissive=True,
            emergency_stop=False, running=True, local=False, enabled=np.ones(LINE.n, dtype=np.bool_),
        )  # fmt: skip


def collected(share, times):
    link, inputs = LateLink(LINE, Told(), share, np.random.default_rng(1)), Inputs(LINE.n)
    for k in range(times):
        link.trigger(0.01 * k)
        asyncio.run(link.collect(inputs, 0.01 * k))
    return link, inputs


def test_what_is_late_stays_as_it_was_told_before_and_is_stale() -> None:
    link, inputs = collected(0.0, 2)
    assert inputs.tension.good() and inputs.speed.good() and inputs.plc.quality == Quality.GOOD and link.late == 0
    link.share = 1.0
    link.trigger(0.02)
    asyncio.run(link.collect(inputs, 0.02))
    assert link.late == 2 + LINE.n
    for channel in (inputs.tension, inputs.speed, inputs.torque, inputs.unwind_speed):
        assert (channel.value == 2.0).all() and (channel.quality == Quality.STALE).all()
        assert (channel.time_s == 0.01).all()
    assert inputs.plc.quality == Quality.STALE


def test_a_share_of_the_answers_is_late_each_by_itself_and_all_load_cells_together() -> None:
    link, inputs = collected(0.3, 400)
    assert 0.25 < link.late / link.answers < 0.35 and link.answers == 400 * (2 + LINE.n)
    assert len(set(inputs.tension.value.tolist())) == 1 and len(set(inputs.speed.value.tolist())) > 1


def test_stops_are_counted_once_for_each_run_of_periods_without_a_sample() -> None:
    held = [0, 1, 2, 0, 1, 2, 3, 4, 0, 1, 2, 3]
    assert stops([SimpleNamespace(held=one) for one in held], 3) == 2


@pytest.mark.long
@pytest.mark.parametrize(("draw", "stage"), [(draw_good, Stage.KEPT), (draw_bad, Stage.ROLLED_BACK)])
def test_a_trial_runs_to_its_end_through_the_gateways_own_deployer(draw, stage) -> None:
    case, _, config, _ = draw(LINE, 7_100_003)
    trial = asyncio.run(TrialRun(case, config, 0.01, envelope=False).run(LONGEST_S))
    assert trial.stage is stage, trial.why
