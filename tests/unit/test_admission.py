"""What is let near a period: nothing that fails, and nothing that takes longer than its share, with the figure."""

import time
from dataclasses import replace
from math import inf

import numpy as np
import pytest

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, design_pid, task_of
from gateway.control.laws import make_law
from gateway.core.controller import ControllerRefused, config_hash
from gateway.core.deployment import Deployment, Region
from gateway.core.messages import Deploy, Rollback
from gateway.core.states import Phase
from gateway.core.theta import nominal_theta
from gateway.loop.admission import Admission
from gateway.loop.configurations import Configuration
from gateway.loop.kept import Kept, OnTop
from safety.recoverability import Recovery
from safety.recovery_prediction import recovery_prediction
from tests.closed_loop.conftest import demo_line, real_plant

LINE = demo_line()
GIVEN, OTHER = design_lqi(task_of(LINE)), design_pid(task_of(LINE))
GOOD = Configuration(GIVEN, config_hash(GIVEN), make_law(GIVEN), Region())
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


@pytest.mark.slow
@pytest.mark.parametrize("what", ["engage", "ask", "commit"])
def test_a_law_that_takes_longer_than_its_share_is_refused_with_the_figure(what):
    period_s = 0.05
    admission = Admission(LINE, lambda config: Slow(config, what, 0.03), period_s)
    with pytest.raises(ControllerRefused, match=r"its law takes 3\d.* ms of each period of 50 ms.*allowed: 22.5 ms"):
        admission.admit(deployment(), GOOD)
    assert Admission(LINE, lambda config: Slow(config, what, 0.001), period_s).admit(deployment(), GOOD).law.n == LINE.n


def test_a_prediction_that_takes_longer_than_its_share_is_refused_along_its_longer_way(monkeypatch):
    shortfall = Recovery.shortfall

    def slow_away_from_set_points(self, measured, setpoint_n, *given):
        if np.abs(measured.tension_n - setpoint_n).max() > 1.0:
            busy(0.03)
        return shortfall(self, measured, setpoint_n, *given)

    monkeypatch.setattr(Recovery, "shortfall", slow_away_from_set_points)
    with pytest.raises(ControllerRefused, match=r"its recovery prediction 3\d.* ms"):
        Admission(LINE, make_law, 0.05).recovery(WATCH, GIVEN, 0.0)


@pytest.mark.slow
def test_law_prediction_and_what_would_take_over_count_together():
    admission = Admission(LINE, lambda config: Slow(config, "ask", 0.015), 0.05)
    back = Configuration(GIVEN, config_hash(GIVEN), make_law(GIVEN), Region(), law_s=0.03)
    with pytest.raises(ControllerRefused, match=r"what the line would go back to 30 ms; allowed: 42.5 ms in all"):
        admission.admit(deployment(), back)
    with pytest.raises(ControllerRefused, match=r"its law takes 23 ms"):
        Admission(LINE, make_law, 0.05).recovery(WATCH, GIVEN, 0.023)


@pytest.mark.slow
def test_one_that_takes_too_long_is_unfit_and_the_line_is_not_armed_with_it():
    unfit = Admission(LINE, lambda config: Slow(config, "ask", 0.03), 0.05)
    given = Configuration(GIVEN, config_hash(GIVEN), Slow(GIVEN, "ask", 0.03), Region())
    assert "its law takes 3" in unfit.measured(given).unfit
    loop = SteppedLoop(LINE, GIVEN, real_plant(), 1)
    configurations = loop.cycle.configurations
    configurations.running = configurations.good = replace(configurations.good, unfit="it takes too long")
    loop.step(3)
    reply = loop.arm()
    assert not reply.ok and "it takes too long" in reply.reasons[0]


def test_going_back_to_an_unfit_one_takes_torque_off_in_order():
    loop = SteppedLoop(LINE, GIVEN, real_plant(), 1)
    loop.begin_in_production(np.array(LINE.recipes[0].tension_n), 0.05)
    loop.step(30)
    configurations = loop.cycle.configurations
    configurations.running = configurations.good = replace(configurations.good, unfit="it takes too long")
    assert loop.command(Deploy(deployment=deployment(lease_s=60.0))).ok
    loop.step(5)
    assert loop.command(Rollback(reason="it hums")).ok
    assert loop.cycle.machine.phase is Phase.UNLOADING and "it takes too long" in loop.cycle.machine.reason
    assert loop.step_until(Phase.OFF, 10.0) and loop.truth.recorder.unsafe_total == 0


def test_in_stepped_time_nothing_takes_too_long():
    admission = Admission(LINE, lambda config: Slow(config, "ask", 0.02), inf)
    assert admission.admit(deployment(), GOOD).hash == config_hash(OTHER)


@pytest.mark.parametrize("fails", ["engage", "ask", "commit"])
def test_a_law_that_cannot_be_run_is_refused(fails):
    def broken(config):
        law = make_law(config)
        setattr(law, fails, lambda *_: 1 / 0)
        return law

    with pytest.raises(ControllerRefused, match="cannot be run: ZeroDivisionError"):
        Admission(LINE, broken).admit(deployment(), GOOD)


def test_a_prediction_for_another_fallback_or_of_no_use_is_refused(monkeypatch):
    admission = Admission(LINE, make_law)
    with pytest.raises(ControllerRefused, match="watched for the fallback"):
        admission.recovery(WATCH, OTHER, 0.0)
    monkeypatch.setattr(Recovery, "shortfall", lambda *_: 1 / 0)
    with pytest.raises(ControllerRefused, match="cannot be used: ZeroDivisionError"):
        admission.recovery(WATCH, GIVEN, 0.0)


@pytest.mark.slow
def test_what_was_kept_on_top_and_takes_too_long_by_now_is_left_out():
    top = OnTop(controller=OTHER, region=Region())
    kept = Kept(started_with=config_hash(GIVEN), epoch=3, controller=GIVEN, region=Region(), watch=None, on_top=top)

    def slow_on_top(config):
        return Slow(config, "ask", 0.03) if config == OTHER else make_law(config)

    said = []
    running, good = Admission(LINE, slow_on_top, 0.05).resumed(kept, said.append)
    assert running is good and good.config == GIVEN and "is not used, what it stands on is" in said[0]


def test_what_a_loop_before_has_kept_runs_without_a_prediction_that_is_of_no_use_any_more():
    kept = Kept(
        started_with=config_hash(GIVEN), epoch=3, controller=OTHER, region=Region(speed_max_m_per_s=0.05), watch=WATCH
    )
    said = []
    running, good = Admission(LINE, make_law).resumed(kept, said.append)
    assert running is good and good.recovery is None and good.region == kept.region
    assert "nobody looks" in said[0]
