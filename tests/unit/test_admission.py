"""What is let near a period: nothing that fails, and nothing that takes longer than its share, with the figure."""

import time
from math import inf

import pytest

from gateway.control.design import design_lqi, design_pid, task_of
from gateway.control.laws import make_law
from gateway.core.controller import ControllerRefused, config_hash
from gateway.core.deployment import Deployment, Region
from gateway.core.theta import nominal_theta
from gateway.loop.admission import Admission
from gateway.loop.kept import Kept
from safety.recoverability import Recovery
from safety.recovery_prediction import recovery_prediction
from tests.closed_loop.conftest import demo_line

LINE = demo_line()
GIVEN, OTHER = design_lqi(task_of(LINE)), design_pid(task_of(LINE))
WATCH = recovery_prediction(nominal_theta(LINE), GIVEN, LINE, [0.05])


def busy(for_s):
    """Work, not sleep: a busy computer makes nothing take longer that is measured by its own processor time."""
    until_s = time.thread_time() + for_s
    while time.thread_time() < until_s:
        pass


class Slow:
    """A law whose method `what` takes its time."""

    def __init__(self, config, what, takes_s):
        self._law, self._what, self._takes_s = make_law(config), what, takes_s
        self.n = self._law.n

    def __getattr__(self, name):
        if name == self._what:
            busy(self._takes_s)
        return getattr(self._law, name)


def deployment(config=OTHER, **changes):
    given = {"controller": config, "hash": config_hash(config), "epoch": 1, "lease_s": 1.0}
    return Deployment(**(given | changes))


@pytest.mark.parametrize("what", ["engage", "ask", "commit"])
def test_a_law_that_takes_longer_than_its_share_is_refused_with_the_figure(what):
    period_s = 0.05
    admission = Admission(LINE, lambda config: Slow(config, what, 0.03), period_s)
    with pytest.raises(ControllerRefused, match=r"its torques take 3\d.* ms of a period of 50 ms.*allowed: 22.5 ms"):
        admission.admit(deployment(), GIVEN)
    assert (
        Admission(LINE, lambda config: Slow(config, what, 0.001), period_s).admit(deployment(), GIVEN).law.n == LINE.n
    )


def test_a_prediction_that_takes_longer_than_its_share_is_refused_along_its_longer_way(monkeypatch):
    step_by_step = getattr(Recovery, "_step_by_step")  # noqa: B009

    def slow(*given):
        busy(0.03)
        return step_by_step(*given)

    monkeypatch.setattr(Recovery, "_step_by_step", slow)
    with pytest.raises(ControllerRefused, match=r"its recovery prediction takes 3\d.* ms"):
        Admission(LINE, make_law, 0.05).recovery(WATCH, GIVEN)


def test_in_stepped_time_nothing_takes_too_long():
    admission = Admission(LINE, lambda config: Slow(config, "ask", 0.02), inf)
    assert admission.admit(deployment(), GIVEN).hash == config_hash(OTHER)


@pytest.mark.parametrize("fails", ["engage", "ask", "commit"])
def test_a_law_that_cannot_be_run_is_refused(fails):
    def broken(config):
        law = make_law(config)
        setattr(law, fails, lambda *_: 1 / 0)
        return law

    with pytest.raises(ControllerRefused, match="cannot be run: ZeroDivisionError"):
        Admission(LINE, broken).admit(deployment(), GIVEN)


def test_a_prediction_for_another_fallback_or_of_no_use_is_refused(monkeypatch):
    admission = Admission(LINE, make_law)
    with pytest.raises(ControllerRefused, match="watched for the fallback"):
        admission.recovery(WATCH, OTHER)
    monkeypatch.setattr(Recovery, "shortfall", lambda *_: 1 / 0)
    with pytest.raises(ControllerRefused, match="cannot be used: ZeroDivisionError"):
        admission.recovery(WATCH, GIVEN)


def test_what_a_loop_before_has_kept_runs_without_a_prediction_that_is_of_no_use_any_more():
    kept = Kept(
        started_with=config_hash(GIVEN), epoch=3, controller=OTHER, region=Region(speed_max_m_per_s=0.05), watch=WATCH
    )
    said = []
    running, good = Admission(LINE, make_law).resumed(kept, said.append)
    assert running is good and good.recovery is None and good.region == kept.region
    assert "nobody looks" in said[0]
