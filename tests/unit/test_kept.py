"""What outlives the loop: all of it or the one before, and never for another configuration or another line."""

import asyncio

import numpy as np
import pytest

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, design_mpc, design_pid, task_of
from gateway.core.controller import config_hash
from gateway.core.deployment import Deployment, Region
from gateway.core.messages import Deploy, Keep, Reply, Rollback, WatchGood, command_bytes
from gateway.core.theta import nominal_theta
from gateway.loop.kept import FILE, Durable, Store
from gateway.loop.pacer import Tick
from gateway.loop.runner import Runner
from safety.recovery_prediction import recovery_prediction
from tests.closed_loop.conftest import demo_line, real_plant

LINE = demo_line()
GIVEN, OTHER, PREDICTIVE = (design(task_of(LINE)) for design in (design_lqi, design_pid, design_mpc))
WATCH = recovery_prediction(nominal_theta(LINE), GIVEN, LINE, [0.05])
TENSION_N = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])


def test_what_is_written_is_read_and_a_write_that_fails_leaves_the_one_before(tmp_path):
    store, said = Store(tmp_path / "new", GIVEN), []
    assert store.read(LINE, said.append) is None and not said
    region = Region(speed_max_m_per_s=0.1)
    watch = recovery_prediction(nominal_theta(LINE), OTHER, LINE, [0.05])
    store.write(Durable(3, OTHER, region, watch))
    kept = store.read(LINE, said.append)
    assert (kept.epoch, kept.controller, kept.region, kept.watch) == (3, OTHER, region, watch) and not said
    (tmp_path / "new" / (FILE + ".part")).mkdir()
    with pytest.raises(OSError, match="directory"):
        store.write(Durable(4, GIVEN, region))
    assert store.read(LINE, said.append) == kept


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:200]), "is not used"),
        (lambda path: path.write_bytes(path.read_bytes().replace(b'"epoch":3', b'"epoch":-3')), "is not used"),
        (lambda path: (path.unlink(), path.mkdir()), "is not used"),
    ],
)
def test_a_file_that_cannot_be_used_is_told_and_the_given_configuration_runs(tmp_path, spoil, words):
    store, said = Store(tmp_path, GIVEN), []
    store.write(Durable(3, OTHER, Region()))
    spoil(store.path)
    assert store.read(LINE, said.append) is None
    assert words in said[0] and str(store.path) in said[0]


def test_a_file_for_another_given_configuration_or_another_line_is_not_used(tmp_path):
    Store(tmp_path, GIVEN).write(Durable(3, OTHER, Region()))
    said = []
    assert Store(tmp_path, OTHER).read(LINE, said.append) is None and "another configuration" in said[0]
    assert Store(tmp_path, GIVEN).read(demo_line(2), said.append) is None and "for 6 spans" in said[1]


def told(runner, loop, *commands, until=lambda: True):
    """Replies of the runner to commands, while periods go on; and then `until` something is so."""

    async def story():
        replies = []
        for command in commands:
            answer = asyncio.ensure_future(runner.command(command_bytes(command)))
            while not answer.done():
                loop.now_s = loop.periods * LINE.control.period_s
                await runner.period(Tick(loop.now_s, loop.now_s, 0))
                loop.periods += 1
                await asyncio.sleep(0)
            replies.append(Reply.model_validate_json(answer.result()))
        for _ in range(1000):
            if until():
                return replies
            await runner.period(Tick(loop.now_s, loop.now_s, 0))
            await asyncio.sleep(0.001)
        raise AssertionError("it does not come to that")

    try:
        return asyncio.run(story())
    finally:
        runner.close()


def producing(store):
    loop = SteppedLoop(LINE, GIVEN, real_plant(), 1)
    loop.begin_in_production(TENSION_N, 0.05)
    loop.step(5)
    return loop, Runner(loop.cycle, store)


def deploy(epoch=1, controller=OTHER):
    hash_ = config_hash(controller)
    return Deploy(deployment=Deployment(controller=controller, hash=hash_, epoch=epoch, lease_s=60.0))


def test_on_probation_the_disk_has_what_is_good_and_after_keeping_what_was_kept(tmp_path):
    store, said = Store(tmp_path, GIVEN), []
    loop, runner = producing(store)
    reply, refused = told(runner, loop, deploy(), deploy())
    assert reply.ok and not refused.ok and reply.in_service.on_probation
    kept = store.read(LINE, said.append)
    assert (kept.controller, kept.epoch) == (GIVEN, 1)
    loop, runner = producing(store)
    watch = recovery_prediction(nominal_theta(LINE), OTHER, LINE, [0.05])
    replies = told(runner, loop, deploy(), Keep(epoch=1, watch=watch), Rollback(reason="nothing happens"))
    assert all(reply.ok for reply in replies) and replies[-1].in_service.watched
    kept = store.read(LINE, said.append)
    assert (kept.controller, kept.watch) == (OTHER, watch) and not said
    again = SteppedLoop(LINE, kept.controller, real_plant(), 1)
    again.cycle.resume(kept, print)
    found = again.cycle.configurations.in_service(0.0)
    assert (found.hash, found.last_known_good, found.epoch) == (config_hash(OTHER), config_hash(OTHER), 1)
    assert found.watched and not found.on_probation


def predictive_kept(store):
    loop, runner = producing(store)
    replies = told(runner, loop, deploy(controller=PREDICTIVE), Keep(epoch=1, watch=WATCH))
    assert all(reply.ok for reply in replies), replies
    return loop, Runner(loop.cycle, store)


def test_predictive_control_that_was_kept_runs_again_after_a_restart_with_what_it_goes_back_to(tmp_path):
    store, said = Store(tmp_path, GIVEN), []
    loop, runner = predictive_kept(store)
    (reply,) = told(runner, loop, WatchGood(watch=WATCH))
    kept = store.read(LINE, said.append)
    assert reply.ok and (kept.controller, kept.on_top.controller, kept.epoch) == (GIVEN, PREDICTIVE, 1)
    again = SteppedLoop(LINE, GIVEN, real_plant(), 1)
    again.cycle.resume(kept, print)
    found = again.cycle.configurations.in_service(0.0)
    assert (found.hash, found.last_known_good) == (config_hash(PREDICTIVE), config_hash(GIVEN))
    assert found.watched and not found.on_probation and not said


def test_predictive_control_that_was_given_up_does_not_come_back(tmp_path):
    store = Store(tmp_path, GIVEN)
    loop, runner = predictive_kept(store)
    told(runner, loop, Rollback(reason="it hums"), until=lambda: store.read(LINE, print).on_top is None)
    assert store.read(LINE, print).controller == GIVEN


def test_predictive_control_stays_kept_where_its_successor_is_refused_at_the_last_moment(tmp_path):
    store = Store(tmp_path, GIVEN)
    loop, runner = predictive_kept(store)
    checked = loop.cycle.admission.admit

    def late(deployment, good):
        candidate = checked(deployment, good)
        loop.cycle.configurations.epoch = 2  # somebody else's has come first
        return candidate

    loop.cycle.admission.admit = late
    (reply,) = told(runner, loop, deploy(2), until=lambda: store.read(LINE, print).on_top is not None)
    assert not reply.ok and store.read(LINE, print).on_top.controller == PREDICTIVE


def test_where_nothing_can_be_kept_nothing_is_deployed(tmp_path):
    (tmp_path / "file").write_text("in the way")
    loop, runner = producing(Store(tmp_path / "file", GIVEN))
    (reply,) = told(runner, loop, deploy())
    assert not reply.ok and "nothing could be kept" in reply.reasons[0]
    assert loop.cycle.configurations.in_service(loop.now_s).epoch == 0
