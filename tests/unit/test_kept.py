"""What outlives the loop: all of it or the one before, and never for another configuration or another line."""

import asyncio
import json

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqg, design_lqi, design_mpc, design_pid, task_of
from gateway.core.controller import canonical, config_hash
from gateway.core.deployment import Deployment, Region, first_region
from gateway.core.messages import Deploy, Keep, Rollback, WatchGood
from gateway.core.theta import nominal_theta
from gateway.loop.kept import FILE, SET_ASIDE, Durable, OnTop, Store, fingerprint
from gateway.loop.pacer import Tick
from gateway.loop.runner import Runner
from gateway.wording.catalogue import sentence
from safety.recovery_prediction import recovery_prediction
from tests.closed_loop.conftest import demo_line, real_plant
from tests.support.gateway_key import proof_of, proven, store_of

LINE = demo_line()
KEPT = design_lqg(task_of(LINE))
GIVEN, OTHER, PREDICTIVE = (design(task_of(LINE)) for design in (design_lqi, design_pid, design_mpc))
WATCH = recovery_prediction(nominal_theta(LINE), GIVEN, LINE, [0.05])
TENSION_N = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])


def test_what_is_written_is_read_and_a_write_that_fails_leaves_the_one_before(tmp_path):
    store, said = store_of(tmp_path / "new", GIVEN), []
    assert store.read(LINE, said.append) is None and not said
    region = Region(speed_max_m_per_s=0.1)
    watch = recovery_prediction(nominal_theta(LINE), OTHER, LINE, [0.05])
    store.write(proven(Durable(3, OTHER, region, watch), LINE))
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
    store, said = store_of(tmp_path, GIVEN), []
    store.write(proven(Durable(3, OTHER, Region()), LINE))
    spoil(store.path)
    assert store.read(LINE, said.append) is None
    assert words in said[0] and str(store.path) in said[0]


def test_a_file_for_another_given_configuration_or_another_line_is_not_used(tmp_path):
    store_of(tmp_path, GIVEN).write(proven(Durable(3, OTHER, Region()), LINE))
    said = []
    assert store_of(tmp_path, OTHER).read(LINE, said.append) is None and "another configuration" in said[0]
    assert store_of(tmp_path, GIVEN).read(demo_line(2), said.append) is None and "for 6 spans" in said[1]


def told(runner, loop, *commands, until=lambda: True):
    """Replies of the runner to commands, while periods go on; and then `until` something is so."""

    async def story():
        replies = []
        for command in commands:
            answer = asyncio.ensure_future(runner.submit(command, proof_of(command, LINE)))
            while not answer.done():
                loop.now_s = loop.periods * LINE.control.period_s
                await runner.period(Tick(loop.now_s, loop.now_s, 0))
                loop.periods += 1
                await asyncio.sleep(0)
            replies.append(answer.result())
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
    store, said = store_of(tmp_path, GIVEN), []
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
    store, said = store_of(tmp_path, GIVEN), []
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
    store = store_of(tmp_path, GIVEN)
    loop, runner = predictive_kept(store)
    told(runner, loop, Rollback(reason="it hums"), until=lambda: store.read(LINE, print).on_top is None)
    assert store.read(LINE, print).controller == GIVEN


def test_predictive_control_stays_kept_where_its_successor_is_refused_at_the_last_moment(tmp_path):
    store = store_of(tmp_path, GIVEN)
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
    loop, runner = producing(store_of(tmp_path / "file", GIVEN))
    (reply,) = told(runner, loop, deploy())
    assert not reply.ok and "nothing could be kept" in reply.reasons[0]
    assert loop.cycle.configurations.in_service(loop.now_s).epoch == 0


STRANGER = Ed25519PrivateKey.generate()
REGION = Region(speed_max_m_per_s=0.1)
DEPLOYED = Deploy(
    deployment=Deployment(controller=KEPT, hash=config_hash(KEPT), epoch=1, lease_s=60.0, region=REGION)
)  # fmt: skip


def edited(path, change):
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def first_number(value):
    """Changes the first number of a controller, wherever it stands."""
    for key, one in value.items() if isinstance(value, dict) else enumerate(value):
        if isinstance(one, float) and one not in (LINE.control.period_s, LINE.control.latency_s):
            value[key] = 1.01 * one
            return True
        if isinstance(one, dict | list) and first_number(one):
            return True
    return False


def of_stranger(document):
    proof = proof_of(DEPLOYED, LINE, STRANGER)
    document["proof"] = proof.model_dump(mode="json")


def of_another_line(document):
    proof = proof_of(DEPLOYED, LINE.model_copy(update={"line": "another"}))
    document["proof"] = proof.model_dump(mode="json")


EDITS = {
    "a gain": (lambda document: first_number(document["controller"]["gain_input"]), "configuration-unproven"),
    "no proof": (lambda document: document.update(proof=None), "configuration-unproven"),
    "another's signature": (of_stranger, "configuration-unproven"),
    "another line's": (of_another_line, "configuration-unproven"),
    "a wider region": (lambda document: document["region"].update(speed_max_m_per_s=1.0), "configuration-beyond-proof"),
    "no region": (lambda document: document["region"].update(speed_max_m_per_s=None), "configuration-beyond-proof"),
    "an older epoch": (lambda document: document.update(epoch=0), "configuration-beyond-proof"),
    "another watch": (lambda document: document["watch"].update(margin_n=0.0), "watch-unproven"),
    "a watch without proof": (lambda document: document.update(watch_proof=None), "watch-unproven"),
}


@pytest.mark.parametrize("edit", sorted(EDITS))
def test_a_kept_file_that_the_gateways_signature_does_not_explain_is_set_aside_for_what_is_given(tmp_path, edit):
    change, code = EDITS[edit]
    watch = recovery_prediction(nominal_theta(LINE), KEPT, LINE, [0.05])
    store_of(tmp_path, GIVEN).write(proven(Durable(3, KEPT, REGION, watch), LINE))
    store, said = store_of(tmp_path, GIVEN), []
    assert store.read(LINE, said.append).controller == KEPT and not store.unexplained and not said
    edited(store.path, change)
    as_it_was = store.path.read_bytes()
    found = store.read(LINE, said.append)
    assert [one.code for one in store.unexplained] == [code] and SET_ASIDE in said[0]
    assert (found.controller, found.region, found.watch, found.on_top) == (GIVEN, first_region(LINE), None, None)
    assert (tmp_path / SET_ASIDE).read_bytes().strip() == as_it_was.strip()
    again = store_of(tmp_path, GIVEN)  # and it stays so
    assert again.read(LINE, said.append) == found and not again.unexplained


def test_what_is_given_is_not_confirmed_by_a_proof_that_nobody_has_signed(tmp_path):
    store_of(tmp_path, GIVEN).write(proven(Durable(3, KEPT, REGION), LINE))
    store, said = store_of(tmp_path, GIVEN), []
    edited(store.path, lambda document: document.update(controller=json.loads(canonical(GIVEN))))
    found = store.read(LINE, said.append)
    assert [one.code for one in store.unexplained] == ["configuration-unproven"]
    assert (found.controller, found.region, found.proof) == (GIVEN, first_region(LINE), None)


def test_what_is_kept_on_top_needs_its_own_proof_and_what_is_narrower_than_its_proof_is_used(tmp_path):
    on_top = OnTop(controller=PREDICTIVE, region=REGION)
    store_of(tmp_path, GIVEN).write(proven(Durable(3, GIVEN, REGION, None, on_top), LINE))
    store, said = store_of(tmp_path, GIVEN), []
    edited(store.path, lambda document: document["on_top"]["region"].update(speed_max_m_per_s=0.05))
    assert store.read(LINE, said.append).on_top.region.speed_max_m_per_s == 0.05 and not said
    edited(store.path, lambda document: document["on_top"].update(proof=None))
    assert store.read(LINE, said.append).on_top is None
    assert [one.code for one in store.unexplained] == ["configuration-unproven"]


def test_a_good_one_before_without_proof_is_nothing_to_go_back_to(tmp_path):
    store = store_of(tmp_path, GIVEN)
    store.settle(Durable(1, OTHER, REGION))
    store.settle(proven(Durable(2, KEPT, REGION), LINE))
    for _ in range(store.deaths.most):
        store.deaths.count(fingerprint(Durable(2, KEPT, REGION)), "a defect")
    said = []
    assert store_of(tmp_path, GIVEN).read(LINE, said.append).controller == GIVEN


def test_without_a_usable_key_what_is_kept_is_not_used_and_stays_where_it_is(tmp_path):
    store_of(tmp_path, GIVEN).write(proven(Durable(3, KEPT, REGION), LINE))
    as_it_was = (tmp_path / FILE).read_bytes()
    store, said = Store(tmp_path, GIVEN), []  # the key cannot be read just now
    found = store.read(LINE, said.append)
    assert (found.controller, found.region, found.epoch) == (GIVEN, first_region(LINE), 3)
    assert [one.code for one in store.unverified] == ["kept-not-verifiable"] and not store.unexplained
    assert (tmp_path / FILE).read_bytes() == as_it_was and not (tmp_path / SET_ASIDE).exists()
    again = store_of(tmp_path, GIVEN)  # and it can be read again
    assert again.read(LINE, said.append).controller == KEPT and not again.unexplained
    store.write(found.durable)  # nor does what is decided meanwhile lose it
    assert (tmp_path / SET_ASIDE).read_bytes() == as_it_was


def test_what_is_set_aside_pushes_out_the_oldest_of_five_only(tmp_path):
    for k in range(7):
        store_of(tmp_path, GIVEN).write(Durable(10 + k, KEPT, REGION))
        assert store_of(tmp_path, GIVEN).read(LINE, print).controller == GIVEN
    names = ["configuration-set-aside.json", *(f"configuration-set-aside-{k}.json" for k in range(2, 6))]
    assert [json.loads((tmp_path / name).read_text())["epoch"] for name in names] == [16, 15, 14, 13, 12]
    assert len(list(tmp_path.glob("configuration-set-aside*"))) == 5


def without_signatures(document):
    """As a version wrote it that signed nothing."""
    for one in ("proof", "watch_proof"):
        del document[one]


def test_a_file_without_any_signature_is_unexplained_like_any_other_and_says_what_an_upgrade_needs(tmp_path):
    store_of(tmp_path, GIVEN).write(proven(Durable(3, KEPT, REGION), LINE))
    store, said = store_of(tmp_path, GIVEN), []
    edited(store.path, without_signatures)  # as an intruder can, or as a version wrote it that signed nothing
    as_it_was = store.path.read_bytes()
    found = store.read(LINE, said.append)
    assert (found.controller, found.region, found.epoch) == (GIVEN, first_region(LINE), 3)
    (told,) = store.unexplained
    assert told.code == "configuration-of-earlier-version" and not store.unverified
    assert told.parameters["configuration"] == config_hash(KEPT)[:12]
    for language in ("en", "de"):
        assert "`r2rgate confirm`" in sentence(told, language)
    assert (tmp_path / SET_ASIDE).read_bytes().strip() == as_it_was.strip()
    again = store_of(tmp_path, GIVEN)
    assert again.read(LINE, said.append) == found and not again.unverified and not again.unexplained
