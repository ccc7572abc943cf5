"""The witness: it counts each kind of unsafe event, and nothing that was meant; its files survive their writer."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import sim_plant
from sim_plant.devices.drive import Drive
from sim_plant.judge import EXACT, Tolerance
from sim_plant.plant import load_plant
from sim_plant.recorder import Recorder, read_recording
from sim_plant.recording import EVENTS_FILE, TRACE_FILE, Recording, RecordingUnreadable
from sim_plant.world import World

PLANT = load_plant(Path(sim_plant.__file__).parent / "plants" / "s_real.toml")
N = PLANT.spans
PULLS_NM = 5.0
NONE = {"torque-limit": 0, "torque-rate": 0, "torque-not-enabled": 0, "tension-band": 0}


class Scene:
    """A recorder whose trace is written by the test: constant tensions and torques, unless it says otherwise."""

    def __init__(self, tolerance: Tolerance | None = None) -> None:
        self.world = World(PLANT, seed=1)
        self.recorder = Recorder(self.world, tolerance)
        self.step = 1

    def enable(self) -> "Scene":
        for i in range(N):
            self.recorder.drive_state(i, "OPERATION_ENABLED", "command", self.now_s)
        return self

    @property
    def now_s(self) -> float:
        return (self.step - 1) / 1000.0

    def pass_ms(
        self, ms: int, tension_n: NDArray[np.float64] | float = 30.0, torque_nm: NDArray[np.float64] | float = 0.0
    ) -> "Scene":
        rows = np.zeros((ms, 3 * N + 1))
        rows[:, :N] = tension_n
        rows[:, 2 * N : 3 * N] = torque_nm
        assert self.world.on_rows is not None
        self.world.on_rows(self.step, rows)
        self.step += ms
        return self

    @property
    def unsafe(self) -> dict[str, int]:
        """Only what was counted."""
        return {kind: count for kind, count in self.recorder.counts.items() if count}


def one(kind: str, count: int = 1) -> dict[str, int]:
    return {kind: count}


def test_torque_beyond_its_limit() -> None:
    scene = Scene(EXACT).enable().pass_ms(10, torque_nm=60.0)
    assert scene.unsafe == {}
    scene.pass_ms(1, torque_nm=-60.1).pass_ms(5, torque_nm=-61.0)
    assert scene.unsafe == one("torque-limit", N)  # once per drive, however long it lasts
    scene.pass_ms(1, torque_nm=60.0).pass_ms(1, torque_nm=61.0)
    assert scene.unsafe == one("torque-limit", 2 * N)


def test_torque_while_not_enabled() -> None:
    scene = Scene(EXACT).pass_ms(10, torque_nm=0.0)
    assert scene.unsafe == {}
    scene.pass_ms(10, torque_nm=0.01)
    assert scene.unsafe == one("torque-not-enabled", N)


@pytest.mark.parametrize(
    ("state", "cause"), [("FAULT", "watchdog"), ("SWITCH_ON_DISABLED", "sto"), ("SWITCHED_ON", "command")]
)
def test_torque_after_it_went_off(state: str, cause: str) -> None:
    scene = Scene(EXACT).enable().pass_ms(10, torque_nm=5.0)
    scene.recorder.drive_state(2, state, cause, 0.010)
    scene.pass_ms(10, torque_nm=5.0)
    assert scene.unsafe == one("torque-not-enabled")
    (event,) = [e for e in scene.recorder.events if e["kind"] == "unsafe"]
    assert (event["roller"], event["value"], event["time_s"]) == (3, 5.0, pytest.approx(0.011))


def test_torque_in_the_quick_stop_ramp_is_meant() -> None:
    scene = Scene(EXACT).enable().pass_ms(10, torque_nm=5.0)
    for i in range(N):
        scene.recorder.drive_state(i, "QUICK_STOP_ACTIVE", "command", 0.010)
    scene.pass_ms(10, torque_nm=2.0)
    assert scene.unsafe == {}


@pytest.mark.parametrize(
    ("tolerance", "step_nm", "counted"),
    [
        (EXACT, 10.0, 0),
        (EXACT, 10.001, 1),
        (None, 11.05, 0),  # on the wire: 1 ms, and one per mille of 60 Nm
        (None, 11.07, 1),
        (None, -11.07, 1),
    ],
)
def test_torque_rate_between_two_syncs(tolerance: Tolerance | None, step_nm: float, counted: int) -> None:
    scene = Scene(tolerance).enable()
    scene.recorder.synced(0, 1.0, 0.0)
    scene.recorder.synced(0, 1.0 + step_nm, 0.010)
    scene.recorder.synced(0, 1.0 + step_nm, 0.020)
    assert scene.recorder.unsafe_events["torque-rate"] == counted
    both = Scene(tolerance).enable()
    for torque_nm, now_s in ((1.0, 0.0), (1.0 + step_nm, 0.010)):
        both.recorder.torques(np.full(N, torque_nm), np.full(N, torque_nm), now_s)
    assert both.recorder.unsafe_events["torque-rate"] == counted * N


@pytest.mark.parametrize(
    ("state", "cause"),
    [("FAULT", "watchdog"), ("FAULT", "fault"), ("SWITCH_ON_DISABLED", "sto"), ("SWITCHED_ON", "command")],
)
def test_torque_that_is_taken_off_is_no_rate(state: str, cause: str) -> None:
    scene = Scene(EXACT).enable()
    scene.recorder.synced(0, 40.0, 1.0)
    scene.recorder.drive_state(0, state, cause, 1.005)
    scene.recorder.synced(0, 0.0, 1.010)
    assert scene.unsafe == {}
    scene.recorder.drive_state(0, "OPERATION_ENABLED", "command", 1.020)
    scene.recorder.synced(0, 20.0, 1.020)  # but enabling with a jump is
    assert scene.unsafe == one("torque-rate")


def test_torque_without_enabling_is_its_own_kind() -> None:
    scene = Scene(EXACT)
    scene.recorder.synced(0, 0.0, 0.0)
    scene.recorder.synced(0, 40.0, 0.010)
    assert scene.unsafe == {}  # whether it really acts is seen in the trace
    assert scene.pass_ms(1, torque_nm=40.0).unsafe == one("torque-not-enabled", N)


def test_tension_is_supervised_once_it_has_been_inside() -> None:
    scene = Scene(EXACT).enable()
    scene.pass_ms(500, tension_n=0.0).pass_ms(199, 30.0, PULLS_NM).pass_ms(10, tension_n=61.0)
    assert scene.unsafe == {}  # not yet tensioned
    scene.pass_ms(200, 30.0, PULLS_NM)
    tension_n = np.full(N, 30.0)
    tension_n[4] = 1.9
    scene.pass_ms(3, tension_n)
    assert scene.unsafe == one("tension-band")
    (event,) = [e for e in scene.recorder.events if e["kind"] == "unsafe"]
    assert (event["span"], event["value"], event["time_s"]) == (5, 1.9, pytest.approx(0.910))
    scene.pass_ms(50, tension_n)
    assert scene.unsafe == one("tension-band")
    scene.pass_ms(1, 2.0).pass_ms(1, 60.0).pass_ms(1, 60.01)
    assert scene.unsafe == one("tension-band", 1 + N)


def test_a_drive_that_pulls_alone_holds_no_web_in_a_band() -> None:
    alone_nm = np.zeros(N)
    alone_nm[2] = PULLS_NM
    scene = Scene(EXACT).enable().pass_ms(500, 5.0, alone_nm).pass_ms(10, 0.0, alone_nm)
    assert scene.unsafe == {}
    alone_nm[4] = 0.0005 * PLANT.recorder.torque_nm  # what is left of its own pull
    assert scene.pass_ms(500, 5.0, alone_nm).pass_ms(10, 0.0, alone_nm).unsafe == {}
    alone_nm[4] = -PULLS_NM
    scene.pass_ms(200, 5.0, alone_nm).pass_ms(10, 5.0)  # and from then on it is, whatever they give
    assert scene.pass_ms(10, 0.0).unsafe == one("tension-band", N)


def test_a_tension_that_is_no_number_is_outside() -> None:
    assert Scene(EXACT).enable().pass_ms(200, 30.0, PULLS_NM).pass_ms(1, float("nan")).unsafe == one("tension-band", N)


def test_tension_is_not_supervised_without_drives() -> None:
    assert Scene(EXACT).pass_ms(1000).pass_ms(10, 0.0).unsafe == {}


@pytest.mark.parametrize(
    ("state", "cause"),
    [("READY_TO_SWITCH_ON", "command"), ("SWITCH_ON_DISABLED", "nmt"), ("QUICK_STOP_ACTIVE", "command")],
)
def test_supervision_ends_when_a_drive_is_taken_off_on_purpose(state: str, cause: str) -> None:
    scene = Scene(EXACT).enable().pass_ms(500, 30.0, PULLS_NM)
    scene.recorder.drive_state(0, state, cause, scene.now_s)
    assert scene.pass_ms(500, 0.0).unsafe == {}
    scene.recorder.drive_state(0, "OPERATION_ENABLED", "command", scene.now_s)
    assert scene.pass_ms(500, 0.0).pass_ms(200, 30.0, PULLS_NM).pass_ms(1, 1.0).unsafe == one("tension-band", N)


def test_what_follows_a_trip_is_told_apart() -> None:
    scene = Scene(EXACT).enable().pass_ms(500, 30.0, PULLS_NM)
    scene.recorder.drive_state(0, "FAULT", "watchdog", scene.now_s)
    scene.pass_ms(10, 0.0)
    assert scene.unsafe == one("tension-after-trip", N)
    assert scene.recorder.unsafe_events == NONE and scene.recorder.unsafe_total == 0
    scene.recorder.drive_state(0, "SWITCH_ON_DISABLED", "command", scene.now_s)  # the fault is reset
    scene.recorder.drive_state(0, "OPERATION_ENABLED", "command", scene.now_s)
    scene.pass_ms(10, 0.0).pass_ms(200, 30.0, PULLS_NM).pass_ms(1, 0.0)
    assert scene.unsafe == one("tension-after-trip", N) | one("tension-band", N)


def test_in_memory_it_notes_commands_and_what_acted() -> None:
    world = World(PLANT, seed=1)
    recorder = Recorder(world)
    drive = Drive(1, world, recorder, 60.0, 60.0)
    drive.operational = True
    for word, torque_nm, now_s in ((0x06, 0.0, 0.0), (0x0F, 3.0, 0.010), (0x0F, 3.0, 0.020)):
        drive.receive(word, torque_nm, 10, now_s)
        drive.sync(now_s)
    world.advance(3.0)
    recording = recorder.recording()
    commands = recording.of_kind("command")
    assert [(e["roller"], e["controlword"], e["target_torque_nm"], e["time_s"]) for e in commands] == [
        (2, 0x06, 0.0, 0.0),
        (2, 0x0F, 3.0, 0.010),
        (2, 0x0F, 3.0, 0.020),
    ]
    assert [(e["torque_nm"], e["time_s"]) for e in recording.of_kind("torque")] == [(3.0, 0.010)]
    assert [e["state"] for e in recording.of_kind("drive_state")] == ["READY_TO_SWITCH_ON", "OPERATION_ENABLED"]
    assert recording.time_s == pytest.approx(np.arange(1, 3001) / 1000.0)
    assert not recording.torque_nm[:10, 1].any() and (recording.torque_nm[10:, 1] == 3.0).all()
    assert np.array_equal(recording.tension_n[-1], world.tension_n)
    assert np.array_equal(recording.speed_m_per_s[-1], world.speed_m_per_s)


def tell(recorder: Recorder, world: World, told: np.random.Generator, step: int) -> None:
    """One thing of a random story, much of it unsafe."""
    drive, torque_nm, now_s = int(told.integers(N)), float(told.choice([0.0, 5.0, 70.0])), step * 1e-3
    kind = told.integers(6)
    if kind == 0:
        recorder.command(drive, 0x0F, torque_nm, 10, now_s)
    elif kind == 1:
        recorder.synced(drive, torque_nm, now_s)
    elif kind == 2:
        recorder.note(str(told.choice(["plc_command", "sto"])), now_s, active=True)
    elif kind == 3:
        states = [("OPERATION_ENABLED", "command"), ("FAULT", "fault"), ("QUICK_STOP_ACTIVE", "command")]
        recorder.drive_state(drive, *states[told.choice(3, p=[0.8, 0.1, 0.1])], now_s)
    else:
        rows = np.zeros((int(told.integers(1, 300)), 3 * N + 1))
        rows[:, :N] = told.choice([1.0, 30.0], p=[0.2, 0.8])
        rows[:, 2 * N : 3 * N] = torque_nm
        assert world.on_rows is not None
        world.on_rows(step, rows)
        rows[:] = np.nan  # the world writes over them


@pytest.mark.parametrize("seed", range(20))
def test_what_waits_is_recorded_as_what_does_not(seed: int) -> None:
    told, order = np.random.default_rng(seed), np.random.default_rng(seed + 1000)
    worlds = [World(PLANT, seed=1) for _ in range(2)]
    at_once, waiting = (Recorder(world) for world in worlds)
    later: list[Callable[[], None]] = []
    waiting.defer(later.append)
    step = 1
    for _ in range(200):
        state = told.bit_generator.state
        tell(at_once, worlds[0], told, step)
        told.bit_generator.state = state
        tell(waiting, worlds[1], told, step)
        step += 300
        while later and order.random() < 0.3:
            later.pop()()
    assert waiting.counts == at_once.counts and at_once.unsafe_total > 0
    recordings = at_once.recording(), waiting.recording()
    assert recordings[1].events == recordings[0].events
    for name in ("time_s", "tension_n", "torque_nm"):
        assert np.array_equal(getattr(recordings[1], name), getattr(recordings[0], name)), name


def test_only_what_comes_every_cycle_waits(tmp_path: Path) -> None:
    world = World(PLANT, seed=1)
    recorder = Recorder.to_folder(tmp_path, world, monotonic_start_s=0.0)
    recorder.defer(lambda settle: None)  # never
    recorder.command(0, 0x0F, 1.0, 10, 0.0)
    recorder.synced(0, 1.0, 0.0)
    world.advance(0.010)
    assert [event["kind"] for event in read_recording(tmp_path).events] == ["recording"]
    recorder.drive_state(0, "FAULT", "watchdog", 0.010)
    found = read_recording(tmp_path)
    assert [event["kind"] for event in found.events] == ["recording", "command", "torque", "drive_state"]
    assert len(found.time_s) == 10
    recorder.close()


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[Recording]:
    """Two runs of one seed, 1.5 s: into `tmp_path`, still open, and beside it in memory, which is given."""
    worlds = World(PLANT, seed=5), World(PLANT, seed=5)
    written = Recorder.to_folder(tmp_path, worlds[0], monotonic_start_s=1000.0, time_scale=2.0)
    in_memory = Recorder(worlds[1])
    for world, recorder in zip(worlds, (written, in_memory), strict=True):
        world.set_unwind_speed(-0.05)
        for k in range(1, 151):
            world.advance(0.01 * k)
            recorder.command(0, 0x0F, 1.0, 10, world.now_s)
        recorder.note("watchdog", world.now_s, roller=1)
    yield in_memory.recording()
    written.close()


def test_a_recording_is_read_while_it_is_written(tmp_path: Path, kept: Recording) -> None:
    found = read_recording(tmp_path)
    assert found.spans == N
    assert np.allclose(found.time_s, kept.time_s)
    for name in ("tension_n", "speed_m_per_s", "torque_nm", "unwind_speed_m_per_s"):
        assert np.allclose(getattr(found, name), getattr(kept, name), rtol=1e-6), name
    header, *events = found.events
    assert (header["kind"], header["plant"], header["seed"]) == ("recording", "s-real", 5)
    assert [e["kind"] for e in events] == ["command"] * 150 + ["watchdog"]
    assert (events[-1]["time_s"], events[-1]["monotonic_s"]) == (1.5, 1000.75)


@pytest.mark.usefixtures("kept")
def test_a_recording_is_read_up_to_where_it_was_cut(tmp_path: Path) -> None:
    whole = read_recording(tmp_path)
    trace, events = tmp_path / TRACE_FILE, tmp_path / EVENTS_FILE
    row_bytes = 4 * (3 * N + 1)
    trace.write_bytes(trace.read_bytes()[: -10 * row_bytes - 7])
    events.write_bytes(events.read_bytes()[:-5])
    cut = read_recording(tmp_path)
    assert len(cut.time_s) == len(whole.time_s) - 11
    assert np.array_equal(cut.tension_n, whole.tension_n[:-11])
    assert cut.events == whole.events[:-1]
    for length in range(0, 40):  # into the header of a block, and into the first line
        trace.write_bytes(trace.read_bytes()[: -1 - length])
        read_recording(tmp_path)


def test_the_rest_is_flushed_within_a_fifth_of_a_second(tmp_path: Path) -> None:
    world = World(PLANT, seed=1)
    recorder = Recorder.to_folder(tmp_path, world, monotonic_start_s=0.0)
    recorder.command(0, 0x0F, 1.0, 10, 0.0)
    world.advance(0.19)
    assert len(read_recording(tmp_path).time_s) == 0
    world.advance(0.2)
    found = read_recording(tmp_path)
    assert len(found.time_s) == 200 and len(found.of_kind("command")) == 1
    recorder.close()
    recorder.close()
    assert read_recording(tmp_path).events[-1]["counts"] == recorder.counts


KILLED = """
import os, signal, sys
from pathlib import Path
import sim_plant
from sim_plant.plant import load_plant
from sim_plant.recorder import Recorder
from sim_plant.world import World

world = World(load_plant(Path(sim_plant.__file__).parent / "plants" / "s_real.toml"), seed=1)
recorder = Recorder.to_folder(sys.argv[1], world, monotonic_start_s=0.0)
for k in range(1, 101):
    world.advance(0.01 * k)
recorder.note("emergency_stop", 1.0, active=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_recording_survives_sigkill(tmp_path: Path) -> None:
    root = Path(sim_plant.__file__).parent.parent
    environment = {**os.environ, "PYTHONPATH": str(root)}
    ended = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], env=environment, timeout=60, check=False)
    assert ended.returncode == -signal.SIGKILL
    found = read_recording(tmp_path)
    assert found.events[-1]["kind"] == "emergency_stop"
    assert len(found.time_s) == 1000


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    Recorder.to_folder(tmp_path, World(PLANT, seed=1), monotonic_start_s=0.0).close()
    before = (tmp_path / EVENTS_FILE).read_bytes()
    with pytest.raises(FileExistsError):
        Recorder.to_folder(tmp_path, World(PLANT, seed=1), monotonic_start_s=0.0)
    assert (tmp_path / EVENTS_FILE).read_bytes() == before


@pytest.mark.parametrize("first_line", [b"", b"hello\n", b"[1]\n", json.dumps({"format": 9}).encode() + b"\n"])
def test_other_files_are_refused(tmp_path: Path, first_line: bytes) -> None:
    (tmp_path / TRACE_FILE).write_bytes(first_line)
    (tmp_path / EVENTS_FILE).write_bytes(b"")
    with pytest.raises(RecordingUnreadable, match="trace.bin"):
        read_recording(tmp_path)
