"""What goes wrong on the plant's side, through the whole cycle in stepped time; the recorder is the judge."""

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from gateway.cli.stepped import SteppedLoop
from gateway.core.messages import Hold, SetSpeed, SetTension, Start, Stop
from gateway.core.signals import DriveRequest
from gateway.core.states import LoopState, Phase
from safety.tensioning import longest_tensioning_s, tensioning_speed_m_per_s
from tests.closed_loop.conftest import real_plant, stepped

TORQUE_KINDS = ("torque-limit", "torque-rate", "torque-not-enabled")


def at_speed(loop: SteppedLoop) -> SteppedLoop:
    assert loop.command(SetSpeed(speed_m_per_s=0.1)).ok
    loop.step(400)
    return loop


def unsafe_torque(loop: SteppedLoop) -> dict[str, int]:
    return {kind: loop.truth.recorder.unsafe_events[kind] for kind in TORQUE_KINDS}


@pytest.mark.parametrize("phase", [Phase.SLOWING, Phase.UNLOADING])
def test_arm_during_a_stop_is_refused_and_touches_no_link(running, phase, monkeypatch):
    at_speed(running).command(Stop())
    assert running.step_until(phase, 5.0)
    for name in ("prepare", "silence", "release"):
        monkeypatch.setattr(running.cycle.links[0], name, lambda: pytest.fail("a link was touched"))
    reply = running.arm()
    assert not reply.ok and [one.code for one in reply.findings] == ["torque-not-off"]
    assert running.step_until(Phase.OFF, 5.0)
    assert running.truth.recorder.unsafe_total == 0


def test_a_drive_that_leaves_by_itself_is_not_enabled_again_until_a_person_arms(running):
    at_speed(running)
    running.truth.take_off(2, running.now_s)
    running.step(1)
    assert running.cycle.machine.phase is Phase.SLOWING
    assert running.cycle.outputs.drive_request[2] == DriveRequest.OFF and running.cycle.outputs.torque_nm[2] == 0.0
    left_s = running.now_s
    assert running.step_until(Phase.OFF, 12.0)
    running.step(5)
    recording = running.truth.recorder.recording()
    assert not recording.torque_nm[recording.time_s > left_s, 2].any()
    assert not any(unsafe_torque(running).values()), unsafe_torque(running)
    assert not running.command(Start()).ok
    running.step(500)  # the web comes to rest
    assert running.arm().ok and running.step_until(Phase.READY, 1.0)


@pytest.mark.parametrize("reading_n", [0.0, 2.5])
def test_a_line_without_a_web_does_not_run_away(reading_n, monkeypatch):
    loop = stepped()
    plant = real_plant()
    bare = plant.model_copy(update={"web": plant.web.model_copy(update={"stiffness_n": 1e-6})})
    loop = SteppedLoop(loop.line, loop.config, bare, 1)
    sample = loop.truth.sample

    def offset(now_s):
        reading = sample(now_s)
        reading.tension_n[:] = reading_n
        return reading

    monkeypatch.setattr(loop.truth, "sample", offset)
    loop.step(3)
    assert loop.arm().ok and loop.step_until(Phase.READY, 1.0)
    assert loop.command(Start()).ok
    assert loop.step_until(Phase.OFF, longest_tensioning_s(loop.line))
    assert "span 1: " in loop.cycle.machine.reason and "no web" in loop.cycle.machine.reason
    assert all(phase is not Phase.RUNNING for _, phase, _ in loop.transitions)
    fastest = np.abs(loop.truth.recorder.recording().speed_m_per_s).max()
    assert fastest <= tensioning_speed_m_per_s(loop.line)


def test_steps_do_not_add_up_to_a_larger_one(running):
    assert running.command(SetTension(span=3, tension_n=44.0, step=True)).ok
    refused = running.command(SetTension(span=3, tension_n=58.0, step=True))
    assert not refused.ok and refused.findings[0].code == "step-too-soon"
    assert refused.findings[0].parameters["pause_s"] == pytest.approx(2.0, abs=0.05)
    assert running.command(SetTension(span=2, tension_n=40.0, step=True)).ok  # another span may step
    assert running.command(SetSpeed(speed_m_per_s=0.1, step=True)).ok
    assert not running.command(SetSpeed(speed_m_per_s=0.12, step=True)).ok
    running.step(201)
    assert running.command(SetSpeed(speed_m_per_s=0.12, step=True)).ok


def test_transport_that_the_plc_stops_stops_the_line_and_does_not_come_back_by_itself(running):
    at_speed(running)
    running.truth.plc.permissive = False
    running.truth.plc.poll(running.now_s)
    running.truth.plc.permissive = True  # gone and back between two samples: only the transport tells
    running.step(12)
    assert running.cycle.machine.state is LoopState.STOP and running.stopped_by[-1][1].rule == "transport-stopped"


def test_arming_and_starting_want_to_know_that_the_line_stands_still(loop, monkeypatch):
    sample = loop.truth.sample

    def unwinder_says(speed_m_per_s, periods=1):
        def reading(now_s):
            taken = sample(now_s)
            object.__setattr__(taken, "unwind_speed_m_per_s", speed_m_per_s)
            return taken

        monkeypatch.setattr(loop.truth, "sample", reading)
        loop.step(periods)

    loop.step(3)
    unwinder_says(0.05)
    assert "unwinder turns" in loop.arm().reasons[0]
    unwinder_says(float("nan"), periods=30)
    assert "no usable answer" in loop.arm().reasons[0]
    unwinder_says(0.0)
    unwinder_says(float("nan"))  # one lost sample is no reason to send a person away
    unwinder_says(0.0, periods=0)
    assert loop.arm().ok and loop.step_until(Phase.READY, 1.0)
    unwinder_says(0.05)
    reply = loop.command(Start())
    assert not reply.ok and "unwinder turns" in reply.reasons[0]


def test_a_speed_from_before_a_stop_is_not_taken_up_again(running):
    at_speed(running).command(Stop())
    assert running.step_until(Phase.OFF, 12.0)
    running.step(1000)
    assert running.arm().ok and running.step_until(Phase.READY, 1.0)
    assert "0.01 m/s" in running.command(Start()).text


class Operation(RuleBasedStateMachine):
    """Commands and faults in any order, at any phase."""

    @initialize(seed=st.integers(0, 1000))
    def begin(self, seed):
        self.loop = stepped(spans=3, seed=seed)
        self.loop.step(3)
        self.armed = False  # by a person, since the last stop
        self.seen = 0

    @rule(periods=st.integers(1, 150))
    def time_passes(self, periods):
        self.loop.step(periods)

    @rule()
    def arm(self):
        self.armed = self.loop.arm().ok or self.armed

    @rule()
    def arm_and_start(self):
        self.arm()
        self.loop.step(5)
        self.loop.command(Start())
        self.loop.step(300)

    @rule(command=st.sampled_from([Start(), Hold(), Stop()]))
    def order(self, command):
        self.loop.command(command)

    @rule(span=st.integers(1, 4), tension_n=st.floats(-10, 70), step=st.booleans())
    def set_tension(self, span, tension_n, step):
        self.loop.command(SetTension(span=span, tension_n=tension_n, step=step))

    @rule(speed=st.floats(-0.1, 0.2), step=st.booleans())
    def set_speed(self, speed, step):
        self.loop.command(SetSpeed(speed_m_per_s=speed, step=step))

    @rule(drive=st.integers(0, 2))
    def a_drive_leaves(self, drive):
        self.loop.truth.take_off(drive, self.loop.now_s)

    @rule()
    def permissive_goes_and_comes(self):
        self.loop.truth.plc.permissive = False
        self.loop.step(3)
        self.loop.truth.plc.permissive = True

    @rule()
    def emergency_stop_goes_and_comes(self):
        self.loop.truth.plc.emergency_stop = True
        self.loop.step(50)
        self.loop.truth.plc.emergency_stop = False

    @rule(periods=st.integers(1, 5), span=st.integers(0, 2))
    def a_load_cell_is_silent(self, periods, span):
        sample = self.loop.truth.sample

        def without(now_s):
            reading = sample(now_s)
            reading.tension_n[span] = np.nan
            return reading

        self.loop.truth.sample = without
        self.loop.step(periods)
        self.loop.truth.sample = sample

    @invariant()
    @precondition(lambda self: hasattr(self, "loop"))
    def torque_is_never_unsafe(self):
        assert not any(unsafe_torque(self.loop).values()), unsafe_torque(self.loop)

    @invariant()
    @precondition(lambda self: hasattr(self, "loop"))
    def only_a_person_leads_out_of_a_stop(self):
        for _, phase, _ in self.loop.transitions[self.seen :]:
            if phase is Phase.OFF:
                self.armed = False
            elif phase not in (Phase.ARMING, Phase.SLOWING, Phase.UNLOADING):
                assert self.armed, phase
        self.seen = len(self.loop.transitions)

    @invariant()
    @precondition(lambda self: hasattr(self, "loop"))
    def at_rest_there_is_no_torque(self):
        # what was handed over acts with the next period
        if self.loop.cycle.machine.phase in (Phase.SILENT, Phase.READY, Phase.OFF):
            self.loop.step(2)
            if self.loop.cycle.machine.phase in (Phase.SILENT, Phase.READY, Phase.OFF):
                assert not self.loop.truth.world.torque_nm.any()


TestOperation = Operation.TestCase
TestOperation.settings = settings(max_examples=40, stateful_step_count=25)
