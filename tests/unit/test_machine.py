"""The state machine as stories: what is observed, and where it leads; and what may never happen."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.states import STATE_OF, LoopState, Phase
from gateway.loop.machine import (
    ARMING_TIME_S,
    LASTING,
    Machine,
    Observation,
    Times,
    advance,
    stop,
    to_phase,
    torque_off,
)
from safety.actions import Action

TIMES = Times(tensioning_s=20.0, stop_s=10.0)
FINE = Observation(
    action=Action.NONE,
    reason="",
    not_ready="",
    not_enabled="",
    tensioned=True,
    standstill=False,
    plc_answers=True,
    feedback=True,
    torque_zero=False,
)
TORQUE = (Phase.TENSIONING, Phase.RUNNING, Phase.HOLDING, Phase.SLOWING)


def after(phase, seen, at_s=0.1):
    return advance(TIMES, Machine(phase), seen, at_s)


def test_from_arming_to_running():
    machine = advance(TIMES, Machine(Phase.ARMING), FINE, 0.1)
    assert machine.phase is Phase.READY
    machine = advance(TIMES, to_phase(machine, Phase.ENABLING, 1.0), FINE, 1.01)
    assert machine.phase is Phase.TENSIONING
    machine = advance(TIMES, machine, replace(FINE, tensioned=False), 2.0)
    machine = advance(TIMES, machine, FINE, 3.0)
    machine = advance(TIMES, machine, replace(FINE, tensioned=False), 3.4)  # out of the band again: counts anew
    machine = advance(TIMES, machine, FINE, 3.5)
    assert advance(TIMES, machine, FINE, 3.9).phase is Phase.TENSIONING
    assert advance(TIMES, machine, FINE, 4.0).phase is Phase.RUNNING


def test_a_warning_comes_before_the_drives_take_over():
    times = replace(TIMES, warning_s=3.0)
    warning = Machine(Phase.WARNING, 1.0)
    assert warning.state is LoopState.READY
    assert advance(times, warning, FINE, 3.9).phase is Phase.WARNING
    assert advance(times, warning, FINE, 4.0).phase is Phase.ENABLING
    against = advance(times, warning, replace(FINE, not_startable="roller 2 turns"), 4.0)
    assert against.phase is Phase.READY and "roller 2 turns" in against.reason
    assert stop(warning, 2.0, "operator's stop").phase is Phase.OFF


def test_web_that_is_taken_up_has_its_own_time():
    slack = replace(FINE, tensioned=False, taking_up_s=30.0)
    tensioning = Machine(Phase.TENSIONING)
    assert advance(TIMES, tensioning, slack, 49.9).phase is Phase.TENSIONING
    over = advance(TIMES, tensioning, slack, 50.1)
    assert over.phase is Phase.SLOWING and "within 50 s" in over.reason


def test_a_drive_that_does_not_become_ready_refuses_the_arming():
    unready = replace(FINE, not_ready="drive-3 STO")
    assert after(Phase.ARMING, unready, ARMING_TIME_S).phase is Phase.ARMING
    refused = after(Phase.ARMING, unready, ARMING_TIME_S + 0.01)
    assert refused.phase is Phase.OFF and "drive-3 STO" in refused.reason


@pytest.mark.parametrize("phase", LASTING)
@given(seen=st.builds(replace, st.just(FINE), **{name: st.booleans() for name in ("tensioned", "standstill")}))
def test_nothing_but_a_finding_leads_out_of_a_lasting_phase(phase, seen):
    idle = replace(seen, plc_answers=False, feedback=False, torque_zero=True, not_ready="x", not_enabled="x")
    for observation in (seen, idle):
        assert after(phase, observation, 1e6) == Machine(phase)


@pytest.mark.parametrize("phase", [phase for phase in Phase if phase not in LASTING])
def test_every_other_phase_ends_by_itself(phase):
    assert after(phase, replace(FINE, torque_zero=True, drilled="every watchdog reacts"), 1e6) != Machine(phase)


def test_a_proof_of_the_wiring_ends_with_torque_off_and_no_production() -> None:
    begun = Machine(Phase.ENABLING, proves=True)
    proving = advance(TIMES, begun, FINE, 0.0)
    assert (proving.phase, proving.state) == (Phase.PROVING, LoopState.RUN)
    over = advance(TIMES, proving, replace(FINE, proved="a load cell is inverted"), 0.0)
    assert (over.phase, over.reason, over.proves) == (Phase.UNLOADING, "a load cell is inverted", False)
    for way in (stop, torque_off):
        assert way(proving, 1.0, "why").phase is Phase.UNLOADING
    late = advance(replace(TIMES, proving_s=5.0), proving, FINE, 5.1)
    assert late.phase is Phase.UNLOADING and "could not be proved within 5 s" in late.reason


def test_a_web_that_cannot_be_tensioned_stops_the_line():
    machine = after(Phase.TENSIONING, replace(FINE, tensioned=False), 20.01)
    assert machine.phase is Phase.SLOWING and "threaded" in machine.reason


def test_a_controlled_stop_slows_unloads_and_stays_off():
    machine = advance(TIMES, Machine(Phase.RUNNING), replace(FINE, action=Action.STOP, reason="why"), 1.0)
    assert (machine.phase, machine.reason) == (Phase.SLOWING, "why")
    # The cause persists: the stop that is under way is not begun anew.
    assert advance(TIMES, machine, replace(FINE, action=Action.STOP, reason="more"), 1.5) == machine
    machine = advance(TIMES, machine, replace(FINE, standstill=True), 2.0)
    assert machine.phase is Phase.UNLOADING
    machine = advance(TIMES, machine, replace(FINE, torque_zero=True), 2.3)
    assert (machine.phase, machine.reason) == (Phase.OFF, "why")
    assert advance(TIMES, machine, FINE, 1e6) == machine


def test_a_persons_stop_is_theirs_to_its_end_but_for_what_is_found_on_the_way():
    slowing = stop(Machine(Phase.RUNNING), 1.0, "whatever it is called", by_person=True)
    ways = [replace(FINE, standstill=True), replace(FINE, feedback=False), replace(FINE, feedback=False, fast=True)]
    for seen in ways:
        machine = advance(BRAKES, slowing, seen, 2.0)
        assert machine.by_person and machine.reason == slowing.reason
        machine = advance(BRAKES, machine, replace(FINE, torque_zero=True), 15.0)
        assert machine.by_person
    off = replace(FINE, action=Action.TORQUE_OFF, reason="operator's stop, in the words of a rule")
    assert not advance(TIMES, slowing, off, 2.0).by_person
    assert not advance(TIMES, Machine(Phase.RUNNING), off, 2.0).by_person
    assert not to_phase(advance(TIMES, slowing, FINE, 99.0), Phase.ARMING, 100.0, "").by_person


@pytest.mark.parametrize(
    ("proved", "well"), [("it is proved", True), ("drive-2 pulls the wrong way", False), ("", True)]
)
def test_a_proof_that_ends_well_ends_as_the_person_wanted_who_asked_for_it(proved, well):
    seen = replace(FINE, proved=proved, proved_well=well)
    machine = advance(replace(TIMES, proving_s=5.0), Machine(Phase.PROVING, proves=True), seen, 5.1)
    assert machine.phase is Phase.UNLOADING
    assert machine.proved == (bool(proved) and well), "one that takes too long does not"
    assert not machine.by_person, "nobody stopped it"
    assert advance(TIMES, machine, replace(FINE, torque_zero=True), 15.0).proved == machine.proved


@pytest.mark.parametrize(
    "seen",
    [
        replace(FINE, plc_answers=False),
        replace(FINE, feedback=False),
        replace(FINE, action=Action.TORQUE_OFF, reason="slack"),
    ],
)
def test_what_makes_tension_control_pointless_ends_the_slowing(seen):
    assert after(Phase.SLOWING, seen).phase is Phase.UNLOADING


def test_slowing_ends_when_its_time_is_up():
    assert after(Phase.SLOWING, FINE, 10.0).phase is Phase.SLOWING
    assert after(Phase.SLOWING, FINE, 10.01).phase is Phase.UNLOADING


BRAKES = replace(TIMES, braking_s=12.0)


@pytest.mark.parametrize("phase", [Phase.RUNNING, Phase.HOLDING, Phase.SLOWING])
def test_a_web_break_is_braked_and_then_torque_goes_off(phase):
    torn = replace(FINE, action=Action.BRAKE, reason="torn", braked=False)
    machine = advance(BRAKES, Machine(phase), torn, 1.0)
    assert (machine.phase, machine.reason, machine.state) == (Phase.BRAKING, "torn", LoopState.STOP)
    # What was found goes on, and less is found beside it: neither begins anything anew.
    assert advance(BRAKES, machine, torn, 2.0) == machine
    assert advance(BRAKES, machine, replace(torn, action=Action.STOP, plc_answers=False), 2.0) == machine
    assert advance(BRAKES, machine, replace(torn, braked=True), 3.0).phase is Phase.UNLOADING
    assert advance(BRAKES, machine, replace(torn, action=Action.NONE), 13.1).phase is Phase.UNLOADING


@pytest.mark.parametrize(
    ("seen", "at_s"),
    [(replace(FINE, feedback=False), 0.1), (replace(FINE, plc_answers=False), 0.1), (FINE, 10.01)],
)
def test_what_is_fast_when_tension_control_cannot_go_on_is_braked(seen, at_s):
    def slowing(times, seen):
        return advance(times, Machine(Phase.SLOWING, reason="why"), seen, at_s)

    machine = slowing(BRAKES, replace(seen, fast=True))
    assert (machine.phase, machine.reason) == (Phase.BRAKING, "why")
    # Where it creeps or stands, and where no drive may brake, torque goes off as before.
    assert slowing(BRAKES, seen).phase is Phase.UNLOADING
    assert slowing(BRAKES, replace(seen, fast=True, standstill=True)).phase is Phase.UNLOADING
    assert slowing(TIMES, replace(seen, fast=True)).phase is Phase.UNLOADING


def test_what_takes_torque_off_ends_the_braking():
    off = replace(FINE, action=Action.TORQUE_OFF, reason="emergency stop", braked=False)
    assert advance(BRAKES, Machine(Phase.BRAKING), off, 1.0).phase is Phase.UNLOADING


@pytest.mark.parametrize(("times", "phase"), [(TIMES, Phase.RUNNING), (BRAKES, Phase.TENSIONING)])
def test_without_brakes_or_speed_a_web_break_takes_torque_off_at_once(times, phase):
    torn = replace(FINE, action=Action.BRAKE, reason="torn", braked=False)
    assert advance(times, Machine(phase), torn, 1.0).phase is Phase.UNLOADING


@given(st.sampled_from(list(Phase)), st.sampled_from([Action.STOP, Action.TORQUE_OFF]), st.floats(0, 1e4))
def test_a_severe_finding_leads_to_stop_from_wherever_there_is_torque(phase, action, now_s):
    machine = after(phase, replace(FINE, action=action, reason="r"), now_s)
    if STATE_OF[phase] is LoopState.SILENT and phase is Phase.SILENT:
        assert machine.phase is Phase.SILENT
    else:
        assert machine.state is LoopState.STOP
    if action is Action.TORQUE_OFF and phase in TORQUE:
        assert machine.phase is Phase.UNLOADING


@given(
    st.lists(
        st.builds(
            Observation,
            action=st.sampled_from(list(Action)),
            reason=st.just("r"),
            not_ready=st.sampled_from(["", "drive-3 STO"]),
            not_enabled=st.sampled_from(["", "drive-3 STO"]),
            tensioned=st.booleans(),
            standstill=st.booleans(),
            plc_answers=st.booleans(),
            feedback=st.booleans(),
            torque_zero=st.booleans(),
        ),
        max_size=40,
    ),
    st.sampled_from(list(Phase)),
)
def test_stop_is_latched_and_nothing_starts_by_itself(story, phase):
    machine = Machine(phase)
    for k, seen in enumerate(story):
        before, machine = machine, advance(TIMES, machine, seen, 0.5 * (k + 1))
        if before.state is LoopState.STOP:
            assert machine.state is LoopState.STOP
        if before.phase in (Phase.SILENT, Phase.READY, Phase.OFF):
            assert machine.phase in (before.phase, Phase.OFF)


@pytest.mark.parametrize("way", [stop, torque_off])
@pytest.mark.parametrize("phase", list(Phase))
def test_the_operators_stop_works_in_every_phase(way, phase):
    machine = way(Machine(phase), 5.0, "operator")
    assert machine.state is LoopState.STOP or machine.phase is Phase.SILENT
