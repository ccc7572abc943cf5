"""What must hold after every period of a loop's life, whatever was done to it: the loop held against the model."""

from collections.abc import Callable

from gateway.core.messages import Arm
from gateway.core.states import LoopState, Phase
from gateway.loop.cycle import SUPERVISED, WITH_TORQUE
from tests.closed_loop.loop_model import Model, Runs, watch_key
from tests.closed_loop.loop_world import Ask, Life

ARMING_PERIODS = 200  #: that an arming takes at most until its links are released
FOLLOWS_PERIODS = 8  #: until the disk has what was decided last
FOLLOWS_AGAIN_PERIODS = 115  #: the same, after a write that failed
LIGHT = ("torque-limit", "torque-rate", "torque-not-enabled")  #: a web may go slack where a test takes its drives


class Invariants:
    """Of one life. `on_disk` reads what the next one would run."""

    def __init__(self, life: Life, model: Model, on_disk: Callable[[], Runs]) -> None:
        self.life, self.model, self._on_disk = life, model, on_disk
        self.passed = 0  #: periods, of all lives
        self.disk_state, self.quiet, self.had_refusals, self.quiet_links = None, 0, 0, 0
        self.faster = False  #: an experiment that was judged for its own speed ran in the period before

    def check(self, speed_before: float, passed: int) -> None:
        """After a period of this life, of which `passed` have been in all. Raises AssertionError."""
        life = self.life
        self.passed = passed
        self._service(life)
        self._experiment(life)
        self._probation(life)
        self._speed(life, speed_before)
        self._torque(life)
        self._links(life)
        self._failures(life)
        self._disk(life)

    def _service(self, life: Life) -> None:
        configurations, model = life.cycle.configurations, self.model
        found = configurations.in_service(life.loop.now_s)
        expected = (model.running.hash, model.good.hash, model.epoch, model.until_s is not None, model.running.region)
        seen = (found.hash, found.last_known_good, found.epoch, found.on_probation, found.region)
        assert seen == expected, f"in service {seen}, by the model {expected}"
        assert configurations.good.region == model.good.region
        assert watch_key(configurations.good.watch) == model.watch

    def _experiment(self, life: Life) -> None:
        run, model = life.cycle.experiments.run, self.model
        if run is None:
            model.experiment = None
            return
        assert model.experiment is not None, "an experiment that nobody has begun, or that was ended, runs"
        assert life.cycle.machine.phase is Phase.RUNNING, f"an experiment runs in {life.cycle.machine.phase.name}"
        running = life.cycle.configurations.running
        under = (running.hash, running.region)
        assert under == (model.experiment.under.hash, model.experiment.under.region), (
            "an experiment goes on under a controller or a region that it was not begun under"
        )
        assert run.done <= run.periods

    def _probation(self, life: Life) -> None:
        on = life.cycle.configurations.probation is not None
        assert not (on and life.cycle.machine.state is LoopState.STOP), "on probation in STOP"
        late = on and life.loop.now_s > self.model.until_s + 1e-6
        assert not late, f"on probation at {life.loop.now_s:g} s, its lease has ended at {self.model.until_s:g} s"

    def _speed(self, life: Life, before: float) -> None:
        cycle, most = life.cycle, self.model.running.region.speed_max_m_per_s
        # The period in which it ends takes its last step.
        ended, self.faster = self.faster, cycle.experiments.run is not None and self.model.experiment.judged
        if most is None or cycle.machine.phase not in SUPERVISED:
            return
        setpoints = cycle.setpoints
        assert setpoints.speed_target_m_per_s <= most + 1e-12, "the line shall run faster than what runs was judged for"
        if not self.faster and not ended:
            assert setpoints.speed_m_per_s <= max(most, before) + 1e-12, "faster than what runs was judged for"

    def _torque(self, life: Life) -> None:
        phase = life.cycle.machine.phase
        torque_nm = life.cycle.outputs.torque_nm
        assert phase in WITH_TORQUE or not torque_nm.any(), f"torque in {phase.name}"
        seen = life.loop.truth.recorder.unsafe_events
        unsafe = {kind: seen.get(kind, 0) for kind in LIGHT}
        assert not any(unsafe.values()), f"at the drives: {unsafe}"

    def _links(self, life: Life) -> None:
        arming = any(isinstance(ask.command, Arm) and not self._is_over(ask) for ask in life.asks)
        if arming or life.armed_since_prepared or not life.runner.at_rest:
            self.quiet_links = 0
            return
        self.quiet_links += 1
        if self.quiet_links > 2:
            active = [link.name for link in life.links if link.active]
            assert not active, f"{', '.join(active)} active though nothing is armed"

    def _is_over(self, ask: Ask) -> bool:
        """An arming comes to its end also where nobody waits for it any more."""
        return ask.answered or (ask.left is not None and self.passed > ask.left + ARMING_PERIODS)

    def _failures(self, life: Life) -> None:
        cycle, raised = life.cycle, life.raised
        assert len(cycle.containment.failed) <= len(raised), f"failed without being broken: {cycle.containment.failed}"
        if raised and raised[-1] not in ("events", "telemetry"):
            stopping = cycle.machine.state in (LoopState.STOP, LoopState.SILENT)
            assert stopping, f"{raised[-1]} has raised, and the line is {cycle.machine.phase.name}"

    def _disk(self, life: Life) -> None:
        """The store's file is looked at only once it must be right: a look takes longer than a period."""
        disk, model = life.disk, self.model
        state = (model.durable, disk.refusals, disk.refused, disk.slow_before, disk.slow_after)
        waits = any(not ask.task.done() for ask in life.asks)
        if state != self.disk_state or waits or disk.refused or not life.aside.idle:
            self.disk_state, self.quiet = state, 0
            return
        self.quiet += 1
        slow = 4 * (disk.slow_before + disk.slow_after)
        if self.quiet == slow + (FOLLOWS_AGAIN_PERIODS if self.had_refusals != disk.refusals else FOLLOWS_PERIODS):
            self.had_refusals = disk.refusals
            self._require_disk(life)

    def _require_disk(self, life: Life) -> None:
        found = self._on_disk()
        assert found == self.model.durable, f"on the disk {found}; decided {self.model.durable}"
        self.model.settled()
        life.asks[:] = [ask for ask in life.asks if not self._is_over(ask)]
