"""A wall clock that is set expires no proposal, keeps none for longer, and neither ends nor stretches a cool-down."""

import asyncio
from datetime import UTC, datetime
from pathlib import Path

import pytest

from gateway.core.controller import config_hash
from gateway.core.judge_context import DataReference, JudgeContext, LineState, dated
from gateway.core.messages import Event
from gateway.core.steady_clock import AGREES_AFTER_S, Moment, SteadyClock
from gateway.supervisor.configurations import Origin, begin_configurations
from gateway.supervisor.experiments import recent_experiments
from gateway.supervisor.lifecycle import Book, Stage, clock_fields, moment_of
from gateway.supervisor.models import begin_repository
from gateway.supervisor.recent import Recent
from gateway.supervisor.surroundings import LineSurroundings
from tests.unit.deployer_gateway import PROBATION_S, TRUSTING, Gateway, run, started
from tests.unit.deployer_support import FIRST, LIFETIME_S, LINE, controller, hash_of, proposal
from tests.unit.supervisor_support import frame_of
from tests.unit.test_baseline_held import STOOD
from tests.unit.test_historian import writer_of

YEAR_S = 365 * 86_400.0
TRUE_S = 1_795_000_000.0
JUMPS = pytest.mark.parametrize("jump_s", [20 * YEAR_S, -20 * YEAR_S, LIFETIME_S, -LIFETIME_S])


async def proposed(wall_ahead_s: float) -> tuple[Gateway, object]:
    gateway = await started()
    gateway.wall_ahead_s = wall_ahead_s
    one = proposal(1, config_hash(FIRST), gateway.loop.now_s + wall_ahead_s)
    assert (await gateway.propose(one)).ok
    return gateway, one


@JUMPS
def test_a_proposal_stands_for_as_long_as_it_was_to_stand_whatever_the_wall_clock_does(jump_s: float) -> None:
    @run
    async def stands() -> None:
        gateway, one = await proposed(TRUE_S)
        await gateway.pass_time(10.0)
        gateway.wall_ahead_s += jump_s
        await gateway.pass_time(LIFETIME_S - 20.0)
        assert gateway.stage(one) is Stage.WAITING
        gateway.begin()  # the process starts anew
        await gateway.pass_time(5.0)
        assert gateway.stage(one) is Stage.WAITING
        await gateway.pass_time(10.0)
        assert gateway.stage(one) is Stage.EXPIRED

    stands()


@run
async def test_a_proposal_can_be_approved_after_the_clock_was_set_forward():
    gateway, one = await proposed(0.0)  # a computer that started in 1970
    gateway.wall_ahead_s = TRUE_S
    await gateway.pass_time(1.0)
    assert (await gateway.decide(one)).ok
    assert gateway.stage(one) is Stage.PROBATION


async def waits_over_a_boot(monkeypatch, seen_s: float, away_s: float, lifetime_s: float = LIFETIME_S):
    """A proposal that came when the clock had been seen for `seen_s`; the machine starts again `away_s` later."""
    gateway = Gateway()
    gateway.wall_ahead_s = TRUE_S
    gateway.begin()
    await gateway.pass_time(seen_s)
    one = proposal(1, config_hash(FIRST), gateway.loop.now_s + TRUE_S, lifetime_s=lifetime_s)
    assert (await gateway.propose(one)).ok
    start_again(monkeypatch, gateway, away_s)
    await gateway.pass_time(1.0)
    return gateway, one


def start_again(monkeypatch, gateway: Gateway, away_s: float) -> None:
    monkeypatch.setattr("gateway.supervisor.deployer.boot_id", lambda: "another boot")
    gateway.wall_ahead_s += gateway.loop.now_s + away_s
    gateway.loop.now_s = 0.0
    gateway.begin()


def test_what_may_have_expired_while_the_machine_was_off_is_not_approved_and_expires_once_that_is_certain(monkeypatch):
    @run
    async def stands():
        gateway, one = await waits_over_a_boot(monkeypatch, AGREES_AFTER_S, 3.0 * 86_400.0)
        reply = await gateway.decide(one)
        assert not reply.ok and "not known" in reply.reasons[0] and gateway.loop.epoch == 0
        view = gateway.deployer.shown(hash_of(one))
        assert not isinstance(view, str) and "not known" in view.why and gateway.stage(one) is Stage.WAITING
        await gateway.pass_time(AGREES_AFTER_S)
        assert gateway.stage(one) is Stage.EXPIRED

    stands()


def test_what_came_under_a_clock_that_nobody_saw_agree_is_never_approved_after_a_boot_and_can_be_rejected(monkeypatch):
    @run
    async def stands():
        gateway, one = await waits_over_a_boot(monkeypatch, 10.0, 60.0, 5.0 * AGREES_AFTER_S)
        await gateway.pass_time(2.0 * AGREES_AFTER_S)
        assert not (await gateway.decide(one)).ok and gateway.stage(one) is Stage.WAITING
        assert (await gateway.decide(one, approve=False)).ok

    stands()


def test_what_stands_still_is_approved_once_the_clock_was_seen_to_agree(monkeypatch):
    @run
    async def stands():
        gateway, one = await waits_over_a_boot(monkeypatch, AGREES_AFTER_S, 60.0, 5.0 * AGREES_AFTER_S)
        assert not (await gateway.decide(one)).ok
        await gateway.pass_time(AGREES_AFTER_S)
        assert (await gateway.decide(one)).ok and gateway.stage(one) is Stage.PROBATION

    stands()


def test_what_may_have_expired_does_not_pass_by_its_verdict(monkeypatch):
    @run
    async def stands():
        gateway = await started(TRUSTING)
        one = proposal(1, config_hash(FIRST), gateway.loop.now_s)
        await gateway.propose(one)
        assert (await gateway.decide(one)).ok
        await gateway.pass_time(PROBATION_S + 1.0)
        assert gateway.stage(one) is Stage.KEPT
        small = proposal(2, gateway.loop.runs, gateway.loop.now_s)
        await gateway.propose(small)
        start_again(monkeypatch, gateway, 60.0)
        await gateway.pass_time(10.0)
        assert gateway.stage(small) is Stage.WAITING and gateway.loop.epoch == 1

    stands()


def test_the_record_of_a_step_says_by_which_clock() -> None:
    moment = Moment(TRUE_S, "boot", 7.0, agreed=True)
    assert moment_of(clock_fields(moment)) == moment
    assert moment_of({"at_s": 5.0}) == Moment(5.0)  # of an earlier version
    assert moment_of({}) is None


class Clocks:
    def __init__(self, boot: str = "boot", now_s: float = 1000.0) -> None:
        self.now_s, self.ahead_s = now_s, TRUE_S
        self.steady = SteadyClock(lambda: self.now_s, lambda: self.now_s + self.ahead_s, boot)


@pytest.fixture
def context_of(tmp_path: Path):
    """What a proposal would be judged against, of a book, with what the experiments were."""
    clocks = Clocks()
    experiments = []
    with (
        begin_configurations(tmp_path / "configurations.sqlite") as storage,
        begin_repository(tmp_path / "models.sqlite") as models,
    ):
        storage.store(LINE.site, LINE.line, controller(0), Origin(1.0, "design", "a test"))
        recent = Recent(LINE.n, LINE.control.period_s)
        surroundings = LineSurroundings(
            LINE, lambda: STOOD, recent, lambda _: experiments, storage, models, clocks.steady
        )

        def asked(book: Book) -> JudgeContext:
            book.in_service = config_hash(controller(0))
            return asyncio.run(surroundings.context(book))[0]

        yield clocks, experiments, asked


@JUMPS
def test_a_cool_down_lasts_as_long_as_the_monotonic_clock_says(context_of, jump_s: float) -> None:
    clocks, _, asked = context_of
    book = Book(changed=clocks.steady.now())
    clocks.now_s += 30.0
    clocks.ahead_s += jump_s
    assert asked(book).state.since_change_s == 30.0


def test_over_a_boot_whose_clock_does_not_agree_a_cool_down_begins_again_and_ends(context_of) -> None:
    clocks, _, asked = context_of
    clocks.now_s = 20.0
    book = Book(changed=Moment(TRUE_S - YEAR_S, "the boot before", 3000.0, agreed=True))
    assert asked(book).state.since_change_s == 20.0
    clocks.now_s += AGREES_AFTER_S + 1000.0
    assert asked(book).state.since_change_s == pytest.approx(YEAR_S + clocks.now_s)


@JUMPS
def test_data_of_before_the_line_changed_stay_out_however_the_clock_was_set_since(context_of, jump_s: float) -> None:
    clocks, experiments, asked = context_of
    book = Book(line_changed=clocks.steady.now())
    clocks.ahead_s += jump_s
    clocks.now_s += 100.0
    digests = []
    for ago_s in (90.0, 110.0):

        class Recorded:
            def digest(self, ago_s=ago_s) -> str:
                return f"{round(ago_s):064x}"

        experiments.append((Recorded(), clocks.steady.now().wall_s - ago_s))
        digests.append(Recorded().digest())
    assert [one.digest for one in asked(book).data] == digests[:1]


def test_a_context_under_another_clock_is_as_old_as_before() -> None:
    def at(seconds: float) -> str:
        return datetime.fromtimestamp(TRUE_S + seconds, UTC).isoformat(timespec="milliseconds")

    state = LineState(state="READY", tension_n=[30.0, 30.0], speed_m_per_s=0.0)
    data = [DataReference(path="a.npz", digest="0" * 64, recorded=at(-60.0))]
    context = JudgeContext(format=1, now=at(0.0), state=state, in_service=FIRST, data=data)
    assert dated(context, TRUE_S + 0.2) is context
    other = dated(context, TRUE_S - YEAR_S)
    assert (other.now, other.data[0].recorded) == (at(-YEAR_S), at(-YEAR_S - 60.0))


def with_experiment(path: Path, boot: str, wall_ahead_s: float) -> None:
    writer = writer_of(path, boot, wall_ahead_s, spans=2)
    frames = [frame_of(k, 900.0 + k * 0.01, 2) for k in range(1000)]
    data = {"begin_s": 901.0, "end_s": 909.0}
    event = Event(time_s=909.0, kind="experiment-end", text="", data=data)
    writer.store(frames, [event], wall_ahead_s)
    writer.pack()
    writer.disconnect()


@JUMPS
def test_the_age_of_an_experiment_is_that_of_the_monotonic_clock(tmp_path: Path, jump_s: float) -> None:
    clocks = Clocks()
    with_experiment(tmp_path / "h", "boot", TRUE_S)
    clocks.ahead_s += jump_s
    ((recording, end_s),) = recent_experiments(tmp_path / "h", 100.0, clocks.steady, 4)
    assert clocks.steady.now().wall_s - end_s == pytest.approx(91.0)
    assert recording.tension_n.shape == (801, 2)
    assert recent_experiments(tmp_path / "h", 90.0, clocks.steady, 4) == []


def test_an_experiment_of_a_boot_whose_clock_nobody_saw_agree_is_no_evidence(tmp_path: Path) -> None:
    clocks = Clocks("another boot")
    with_experiment(tmp_path / "h", "boot", TRUE_S - 1000.0)
    assert recent_experiments(tmp_path / "h", YEAR_S, clocks.steady, 4) == []


def test_an_experiment_of_a_boot_before_counts_once_both_clocks_agree(tmp_path: Path) -> None:
    clocks = Clocks("another boot", 5.0)
    with_experiment(tmp_path / "h", "boot", TRUE_S - 2000.0)
    writer = writer_of(tmp_path / "h", "boot", TRUE_S - 2000.0, spans=2)
    writer.date(TRUE_S - 2000.0)
    writer.disconnect()
    assert recent_experiments(tmp_path / "h", YEAR_S, clocks.steady, 4) == []
    clocks.now_s += AGREES_AFTER_S
    ((_, end_s),) = recent_experiments(tmp_path / "h", 2000.0, clocks.steady, 4)
    assert end_s == pytest.approx(TRUE_S - 2000.0 + 909.0)
