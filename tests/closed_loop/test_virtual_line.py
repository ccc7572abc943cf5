"""Gateway loop and simulated line over their wires in virtual time: the same every time, and true to stepped time."""

import subprocess
import sys
from typing import NamedTuple

import numpy as np
import pytest

from gateway.cli.stepped import run_scenario
from gateway.control.design import design_lqi, design_pid, task_of
from gateway.core.messages import SetTension, Stop
from gateway.core.metrics import rmse_n
from gateway.core.scenario import TENSION
from gateway.core.signals import Quality
from gateway.core.states import Phase
from gateway.core.telemetry import Frame
from gateway.loop.standstill import MOVES
from safety.tensioning import longest_tensioning_s
from sim_plant.recording import EVENTS_FILE, TRACE_FILE
from tests.closed_loop.conftest import demo_line, real_plant
from tests.closed_loop.virtual_line import VirtualLine

CASE_PERIODS = 2000  #: of which the case is the first 15 s

#: Keeps a processor and the loopback interface busy until it is ended.
LOAD = """
import socket
own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
own.bind(("127.0.0.1", 0))
own.connect(own.getsockname())
print("loading", flush=True)
while True:
    own.send(bytes(1000))
    own.recv(1000)
"""


@pytest.fixture
def load():
    """Another process wants whatever this machine has."""
    with subprocess.Popen([sys.executable, "-c", LOAD], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline()
        yield
        process.kill()


def play(folder, seed):
    """Arm, start, step, stop and arm again within 300 periods; the files of the recorder and the telemetry."""
    with VirtualLine(seed=seed, folder=folder / "recording") as line:
        line.begin_in_production()
        line.step(60)
        assert line.command(SetTension(span=3, tension_n=44.0, step=True)).ok
        line.stall(2)
        line.step(80)
        assert line.command(Stop()).ok
        assert line.step_until(Phase.OFF, 1.0)
        line.step(20)
        line.arm()
        line.step(300 - len(line.frames))
        frames = b"".join(line.frames)
    return [(folder / "recording" / name).read_bytes() for name in (EVENTS_FILE, TRACE_FILE)], frames


def test_the_same_seed_gives_the_same_recording_also_on_a_busy_machine(tmp_path, request):
    alone = play(tmp_path / "alone", 5)
    assert play(tmp_path / "other", 6) != alone
    request.getfixturevalue("load")
    assert play(tmp_path / "busy", 5) == alone


class Case(NamedTuple):
    line: VirtualLine  #: still open
    begun_s: float  #: world time of the first period in production
    frames: list[Frame]  #: from there on


@pytest.fixture(scope="module")
def case():
    """The tension case from equilibrium on, and some seconds more."""
    with VirtualLine(seed=1) as line:
        line.begin_in_production(np.array(TENSION.tension_n), TENSION.speed_m_per_s)
        begun_s, first = line.world_s(line.now_s) + line.period_s, len(line.frames)
        line.step(round(TENSION.change_at_s / line.period_s))
        assert all(line.command(command).ok for command in TENSION.commands())
        line.step(CASE_PERIODS - (len(line.frames) - first))
        yield Case(line, begun_s, line.recorded()[first:])


def test_the_tension_case_over_the_wires_is_that_of_stepped_time(case):
    recording = case.line.recording()
    time_s = recording.time_s - case.begun_s
    within = (time_s > 0.0) & (time_s <= TENSION.duration_s)
    wired_n = rmse_n(recording.tension_n[within], TENSION.setpoints_n(time_s[within]))
    config = design_lqi(task_of(demo_line()))
    stepped = [run_scenario(demo_line(), config, real_plant(), TENSION, seed).rmse_n for seed in range(3)]
    assert wired_n == pytest.approx(np.mean(stepped), rel=0.03)


def test_no_sample_is_lost_in_two_thousand_periods(case):
    line, frames = case.line, case.frames
    assert len(frames) == CASE_PERIODS
    assert all((frame.tension_quality == Quality.GOOD).all() and frame.held == 0 for frame in frames)
    assert frames[-1].missed == 0 and {frame.lateness_s for frame in frames} == {0.0}
    assert np.diff([frame.time_s for frame in frames]) == pytest.approx(line.period_s, abs=2e-9)
    for link in line.links:
        assert (link.health.timeouts, link.health.malformed, link.health.reconnects) == (0, 0, 0)
    assert line.truth.recorder.unsafe_total == 0 and line.findings == []
    begun_s = case.begun_s - 1e-6  # for rounding
    received = [event["roller"] for event in line.recording().of_kind("command") if event["time_s"] >= begun_s]
    assert sorted(received) == sorted([*range(1, line.line.n + 1)] * CASE_PERIODS)


def test_a_line_is_brought_up_and_down_by_the_operator_alone():
    with VirtualLine() as line:
        line.step(3)
        assert not line.recording().of_kind("command") and line.cycle.machine.phase is Phase.SILENT
        assert line.arm().state == "READY"
        assert line.start().ok
        assert line.step_until(Phase.RUNNING, longest_tensioning_s(line.line)), line.cycle.machine.reason
        line.step(200)
        tension_n, recipe = line.truth.world.tension_n, line.line.recipes[0]
        assert np.abs(tension_n - recipe.tension_n).max() < 1.5
        assert line.truth.world.unwind_speed_m_per_s == pytest.approx(recipe.speed_m_per_s)
        assert line.command(Stop()).ok
        assert line.step_until(Phase.OFF, line.line.longest_stop_s)
        line.step(2)
        assert not line.truth.world.torque_nm.any()
        assert line.truth.recorder.unsafe_total == 0, line.truth.recorder.unsafe_events
        phases = [transition.phase for transition in line.transitions]
        line.step(1000)  # without torque the web draws on the rollers for some seconds
        told, moves_m_per_s = line.recorded(), MOVES * line.cycle.limits.standstill_m_per_s
        assert told[-1].by_person and told[-1].standstill and told[-1].phase == Phase.OFF
        assert {frame.by_person for frame in told if frame.phase < Phase.SLOWING} == {False}
        assert not [frame for frame in told if frame.standstill and np.abs(frame.speed_m_per_s).max() > moves_m_per_s]
        runs_m_per_s = line.cycle.limits.standstill_m_per_s  # a curve begins slowly
        assert not [
            frame for frame in told
            if frame.standstill and frame.phase == Phase.RUNNING and frame.unwind_speed_m_per_s > runs_m_per_s
        ]  # fmt: skip
    assert phases == [
        Phase.ARMING, Phase.READY, Phase.ENABLING, Phase.TENSIONING, Phase.RUNNING,
        Phase.SLOWING, Phase.UNLOADING, Phase.OFF,
    ]  # fmt: skip


@pytest.mark.parametrize("spans", [1, 2, 20])
def test_other_lines_than_the_demonstration(spans):
    with VirtualLine(demo_line(spans), real_plant(spans), design_pid(task_of(demo_line(spans)))) as line:
        line.begin_in_production()
        line.step(30)
        assert line.cycle.machine.phase is Phase.RUNNING, line.cycle.machine.reason
        assert line.truth.recorder.unsafe_total == 0


@pytest.mark.parametrize(
    ("late_periods", "skipped", "lateness_s"), [(0.0, 0, 0.0), (0.4, 0, 0.004), (1.0, 1, 0.0), (3.7, 3, 0.007)]
)
def test_a_stall_skips_whole_periods_and_is_late_by_the_rest(late_periods, skipped, lateness_s):
    with VirtualLine(demo_line(1)) as line:
        line.step(2)
        line.stall(late_periods)
        line.step(2)
        stalled, after = line.recorded()[-2:]
        assert stalled.missed == skipped and stalled.lateness_s == pytest.approx(lateness_s, abs=2e-9)
        assert after.missed == skipped and after.lateness_s == pytest.approx(0.0, abs=2e-9)
        assert after.time_s - stalled.time_s == pytest.approx(line.period_s, abs=2e-9)
