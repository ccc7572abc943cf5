"""A web breaks at 8 m/s before a reel of 76 kg m2, in stepped time: what the drives gave, and when everything rests."""

import numpy as np
import pytest

from gateway.core.messages import Stop
from gateway.core.states import LoopState, Phase
from sim_plant.faults.parse import parse_fault
from sim_plant.faults.stepped import injector_of
from tests.support.reel_line import TENSION_N, TOP_M_PER_S, reel_loop

BREAK_S = 0.5


def broken(loop, span, more=()):
    """The web of `span` breaks at `BREAK_S`; on until 12 s later."""
    faults = injector_of(loop.truth)
    for fault in (f"web {span} web-break at {BREAK_S}", *more):
        faults.add(parse_fault(fault), 0.0)
    loop.begin_in_production(np.array(TENSION_N), 0.95 * TOP_M_PER_S)
    loop.step(round((BREAK_S + 12.0) / loop.line.control.period_s))
    return loop


def phases(loop):
    return [phase for _, phase, _ in loop.transitions]


@pytest.mark.parametrize("span", [1, 2, 3])
def test_all_rest_within_10_s_and_the_web_that_is_whole_stays_whole(span):
    loop = broken(reel_loop(), span)
    assert phases(loop) == [Phase.BRAKING, Phase.UNLOADING, Phase.OFF]
    assert loop.transitions[0][0] - BREAK_S <= 5 * loop.line.control.period_s
    recording = loop.truth.recorder.recording()
    late = recording.time_s > BREAK_S + 10.0
    assert np.abs(recording.speed_m_per_s[late]).max() < 0.01 * TOP_M_PER_S
    assert recording.speed_m_per_s.min() > -0.01 * TOP_M_PER_S
    assert recording.tension_n.max() <= loop.line.limits.tension_max_n
    counts = loop.truth.recorder.unsafe_events
    assert sum(count for kind, count in counts.items() if kind != "tension-band") == 0


@pytest.mark.parametrize("span", [1, 2, 3])
def test_who_reads_the_first_alarm_is_not_sent_to_a_load_cell(span):
    loop = broken(reel_loop(), span)
    codes = [found.rule for _, found in loop.alarms] + [found.rule for _, found in loop.stopped_by]
    assert "value-impossible" not in codes and codes[0] in ("web-break", "slack")


def test_without_brakes_the_reel_runs_on():
    loop = broken(reel_loop(brakes=False), 3)
    assert phases(loop) == [Phase.UNLOADING, Phase.OFF]
    assert loop.truth.world.surface_speed_m_per_s[2] > 0.5 * TOP_M_PER_S


def test_an_emergency_stop_takes_torque_off_while_it_is_braked():
    loop = broken(reel_loop(), 3, [f"plc emergency-stop at {BREAK_S + 1.0}"])
    assert phases(loop)[:2] == [Phase.BRAKING, Phase.UNLOADING]
    assert loop.transitions[1][0] == pytest.approx(BREAK_S + 1.0, abs=0.03)


def test_a_drive_that_leaves_is_told_and_the_others_go_on():
    loop = broken(reel_loop(), 3, [f"drive 1 sto at {BREAK_S + 1.0}"])
    assert [found.rule for _, found in loop.alarms if found.rule.startswith("brake-")] == ["brake-released-drive-left"]
    assert loop.cycle.machine.state is LoopState.STOP
    # It coasts, and the web would be pulled at by what is braked harder: slower, and nearly within the limit.
    assert abs(loop.truth.world.surface_speed_m_per_s[2]) < 0.5 * TOP_M_PER_S
    assert loop.truth.recorder.recording().tension_n.max() <= 1.5 * loop.line.limits.tension_max_n


def told(loop, code):
    """When a code was told first, and of which drive."""
    return next((time_s, found.parameters.get("drive")) for time_s, found in loop.alarms if found.rule == code)


@pytest.mark.parametrize(
    "fault", ["mode-lost says=follows", "mode-lost says=ignores", "torque-share share=0.1", "torque-share share=-1"]
)
@pytest.mark.parametrize("drive", [2, 3])
def test_a_drive_that_does_not_brake_is_named_and_not_relied_on(drive, fault):
    loop = broken(reel_loop(), 1, [f"drive {drive} {fault} at {BREAK_S + 0.5}"])
    time_s, name = told(loop, "torque-not-given")
    assert name == f"drive-{drive}" and time_s < BREAK_S + 1.5
    assert told(loop, "brake-released-drive-left")[0] < BREAK_S + 1.5
    assert loop.cycle.torque_path.lost.tolist() == [False, drive == 2, drive == 3]
    recording = loop.truth.recorder.recording()
    # Until it is found the web is pulled at; after that by a roller that coasts, as where a drive leaves.
    assert recording.tension_n[recording.time_s > time_s + 0.5].max() <= 1.5 * loop.line.limits.tension_max_n


@pytest.mark.parametrize("share", [0.6, 3.0])
@pytest.mark.parametrize("drive", [2, 3])
def test_a_drive_that_brakes_by_another_torque_is_named_and_brakes_on(drive, share):
    """Let go, its roller would coast, and the web between it and those that brake would tear."""
    loop = broken(reel_loop(), 1, [f"drive {drive} torque-share share={share:g} at {BREAK_S + 0.5}"])
    time_s, name = told(loop, "torque-not-given")
    assert name == f"drive-{drive}" and time_s < BREAK_S + 1.5
    assert not loop.cycle.torque_path.any_lost() and phases(loop)[-1] is Phase.OFF
    assert np.abs(loop.truth.world.surface_speed_m_per_s).max() < 0.01 * TOP_M_PER_S
    recording = loop.truth.recorder.recording()
    assert recording.tension_n[recording.time_s > time_s].max() <= loop.line.limits.tension_max_n


def lost(fault, *, brakes=True, within_s=12.0):
    """What tension control needs is lost at `BREAK_S`; on until `within_s` later."""
    loop = reel_loop(brakes=brakes)
    injector_of(loop.truth).add(parse_fault(f"{fault} at {BREAK_S}"), 0.0)
    loop.begin_in_production(np.array(TENSION_N), 0.95 * TOP_M_PER_S)
    loop.step(round((BREAK_S + within_s) / loop.line.control.period_s))
    return loop


@pytest.mark.parametrize("fault", ["nan", "out-of-range"])
@pytest.mark.parametrize("span", [1, 2, 3])
def test_a_load_cell_lost_at_speed_has_the_line_braked_and_the_web_stays_whole(span, fault):
    loop = lost(f"load-cell {span} {fault}")
    assert phases(loop) == [Phase.BRAKING, Phase.UNLOADING, Phase.OFF]
    assert loop.stopped_by[0][1].parameters["signals"] == f"T{span}"
    recording = loop.truth.recorder.recording()
    late = recording.time_s > BREAK_S + 10.0
    assert np.abs(recording.speed_m_per_s[late]).max() < 0.01 * TOP_M_PER_S
    assert recording.tension_n.max() <= loop.line.limits.tension_max_n


def test_without_brakes_a_load_cell_lost_takes_torque_off():
    assert phases(lost("load-cell 2 nan", brakes=False, within_s=1.0)) == [Phase.UNLOADING, Phase.OFF]


@pytest.mark.parametrize("drive", [1, 2, 3])
def test_an_encoder_lost_at_speed_lets_its_roller_go_and_brakes_the_others(drive):
    loop = lost(f"drive {drive} encoder-jump delta_m_per_s=3")
    assert phases(loop) == [Phase.SLOWING, Phase.BRAKING]
    released = [found for _, found in loop.alarms if found.rule.startswith("brake-")]
    assert [(found.rule, found.parameters["roller"]) for found in released] == [("brake-released-speed-unknown", drive)]
    # Slower, for the web takes along the one that coasts; with torque off it tore at 14 times its limit.
    assert np.abs(loop.truth.world.surface_speed_m_per_s).max() < 0.5 * TOP_M_PER_S
    assert loop.truth.recorder.recording().tension_n.max() <= 1.5 * loop.line.limits.tension_max_n


def test_a_law_that_fails_at_speed_has_the_line_braked(monkeypatch):
    loop = reel_loop()
    loop.begin_in_production(np.array(TENSION_N), 0.95 * TOP_M_PER_S)
    loop.step(50)

    def fail(*_):
        raise ValueError("no number")

    monkeypatch.setattr(type(loop.law), "ask", fail)
    loop.step(round(12.0 / loop.line.control.period_s))
    assert phases(loop) == [Phase.BRAKING, Phase.UNLOADING, Phase.OFF]
    assert loop.truth.recorder.recording().tension_n.max() <= loop.line.limits.tension_max_n


def test_an_unwinder_that_does_not_slow_down_is_not_asked_for_more_and_the_rollers_are_braked(monkeypatch):
    loop = reel_loop()
    loop.begin_in_production(np.array(TENSION_N), 0.95 * TOP_M_PER_S)
    period_s = loop.line.control.period_s
    loop.step(50)
    command, top_m_per_s = loop.truth.plc.command, 0.95 * TOP_M_PER_S
    monkeypatch.setattr(
        loop.truth.plc, "command", lambda _run, _speed, life, now_s: command(True, top_m_per_s, life, now_s)
    )
    loop.command(Stop())
    loop.step(round((loop.line.moves.stop_time_s + 0.1) / period_s))
    assert phases(loop)[-1] is Phase.BRAKING
    before = loop.cycle.outputs.speed_request_m_per_s
    loop.step(round(1.0 / period_s))
    assert before == 0.0 and loop.cycle.outputs.speed_request_m_per_s == 0.0
    loop.step(round(12.0 / period_s))
    assert np.abs(loop.truth.world.surface_speed_m_per_s).max() < 0.01 * TOP_M_PER_S
    assert loop.truth.recorder.recording().tension_n.max() <= loop.line.limits.tension_max_n
