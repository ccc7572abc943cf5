"""Who may say what to the loop: a proof holds for one line, one start of its loop, one command, and one use."""

import asyncio
import json
from pathlib import Path
from typing import get_args

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import given
from hypothesis import strategies as st

from gateway.control.design import design_lqi, design_pid, task_of
from gateway.core.controller import config_hash
from gateway.core.deployment import Deployment, Region
from gateway.core.experiment import Experiment
from gateway.core.messages import (
    AbortExperiment,
    Arm,
    AskConfiguration,
    Configuring,
    Deploy,
    Drill,
    Hold,
    Keep,
    Narrow,
    Operating,
    Prove,
    Renew,
    Reply,
    Rollback,
    RunExperiment,
    SelectRecipe,
    SetSpeed,
    SetTension,
    Start,
    Stop,
    command_bytes,
    most_at_once,
    parse_command,
)
from gateway.core.proof import opened, sealed
from gateway.loop.door import Door
from gateway.mailbox.port import PEER, Peer
from gateway.mailbox.rights import OVERTAKEN, TO_LOOP, Speaker
from gateway.mailbox.seal import MOTION_STALE_S, STALE_S, LineName, Signer
from tests.closed_loop.conftest import demo_line
from tests.support.gateway_key import GROUNDS, KEY, PUBLIC, door_of, name_of, signer_of

LINE = demo_line(2)
CONTROLLER, OTHER = (design(task_of(LINE)) for design in (design_lqi, design_pid))
NOW_S = 5000.0
EXPERIMENT = Experiment.model_validate_json(Path("docs/examples/experiment.json").read_text())

JUDGED = RunExperiment(experiment=EXPERIMENT, proposal=GROUNDS.proposal)


def deploy(controller=CONTROLLER, epoch=1, region=None):
    hash_ = config_hash(controller)
    region = region or Region(speed_max_m_per_s=0.02)
    return Deploy(deployment=Deployment(controller=controller, hash=hash_, epoch=epoch, lease_s=5.0, region=region))


SAID = [
    Arm(), Start(), Prove(), Drill(), SetTension(span=1, tension_n=30.0), SetSpeed(speed_m_per_s=0.1),
    SelectRecipe(name="tension"), AbortExperiment(), RunExperiment(experiment=EXPERIMENT), deploy(), Renew(epoch=1),
    Keep(epoch=1), Narrow(region=Region(speed_max_m_per_s=0.01)), Rollback(reason="because"),
]  # fmt: skip


class Loop:
    """Behind the door."""

    def __init__(self):
        self.done, self.proofs, self.told = [], [], []

    async def submit(self, command, proof=None):
        self.done.append(command)
        self.proofs.append(proof)
        return Reply(ok=True, state="SILENT", text="done")

    def refused(self, text, reasons=()):
        return Reply(ok=False, state="SILENT", text=text, findings=list(reasons))

    def tell(self, kind, text, *, findings, **data):
        self.told.append((kind, findings[0].parameters["because"], data["pid"]))


def at_door(payloads, now_s=NOW_S, sealed_for=None, peers=None):
    """What becomes of `payloads`, each made by a function of the door: codes, or "done"; and the loop behind it."""

    async def story():
        loop = Loop()
        door = door_of(loop, LINE, lambda: now_s, loop.tell)
        answers = []
        try:
            for k, payload in enumerate(payloads):
                token = PEER.set(None if peers is None else peers[k])
                answer = Reply.model_validate_json(await door.command(payload(door)))
                PEER.reset(token)
                answers.append("done" if answer.ok else answer.findings[0].code if answer.findings else "malformed")
        finally:
            door.close()
        return answers, loop

    return asyncio.run(story())


def signed(command, clock=NOW_S, key=KEY, of=None, loop=None, grounds=GROUNDS):
    signer = Signer(key, of or name_of(LINE), lambda: clock)
    return lambda door: signer.sealed(command, loop or door.nonce, grounds)


def test_every_command_has_one_row_in_the_table_of_who_may_say_it():
    names = {one.model_fields["command"].default for one in (*get_args(Operating), *get_args(Configuring))}
    assert set(TO_LOOP) == names
    assert {name for name, who in TO_LOOP.items() if who is Speaker.ANYBODY} == {"stop", "hold", "configuration"}


@pytest.mark.parametrize("command", SAID, ids=lambda one: one.command)
def test_what_the_gateway_says_is_done_with_its_proof_and_refused_and_told_without(command):
    answers, loop = at_door([lambda _: command_bytes(command), signed(command)])
    assert answers == ["no-proof", "done"] and loop.done == [command]
    assert loop.proofs[0].statement.command == command.command
    assert loop.told == [("refused-at-the-door", "no-proof", 0)]


@pytest.mark.parametrize("command", [Stop(), Hold(), AskConfiguration()], ids=lambda one: one.command)
def test_what_is_safe_is_taken_from_anybody(command):
    answers, loop = at_door([lambda _: command_bytes(command)])
    assert answers == ["done"] and loop.done == [command] and loop.told == []


def test_a_proof_is_good_once_at_one_loop_of_one_line_for_a_while():
    once = []

    def kept(door):
        once.append(signed(deploy())(door))
        return once[0]

    stranger = Ed25519PrivateKey.generate()
    cases = [
        (kept, "done"),
        (lambda _: once[0], "proof-used-before"),
        (signed(deploy(), clock=NOW_S - 0.1, loop="0" * 32), "proof-of-another-loop"),
        (signed(deploy(), clock=NOW_S - 0.2, of=LineName(LINE.site, "another")), "proof-of-another-line"),
        (signed(deploy(), clock=NOW_S - 0.3, key=stranger), "proof-not-signed"),
        (signed(deploy(), clock=NOW_S - STALE_S - 1.0), "proof-of-another-time"),
        (signed(deploy(), clock=NOW_S + 3600.0), "proof-of-another-time"),
        (signed(deploy(epoch=2), clock=NOW_S - 1.0), "done"),  # later than one that was signed after it
    ]
    answers, loop = at_door([payload for payload, _ in cases])
    assert answers == [expected for _, expected in cases]
    assert [command.deployment.epoch for command in loop.done] == [1, 2]


MOTION = [one for one in SAID if one.command in OVERTAKEN]


@pytest.mark.parametrize("command", MOTION, ids=lambda one: one.command)
def test_what_sets_the_line_in_motion_and_was_held_back_for_longer_than_a_second_moves_nothing(command):
    said = [signed(command, clock=NOW_S - age_s) for age_s in (9.0, MOTION_STALE_S + 0.1, 0.9 * MOTION_STALE_S)]
    answers, loop = at_door(said)
    assert answers == ["proof-of-another-time", "proof-of-another-time", "done"] and loop.done == [command]
    assert {code for _, code, _ in loop.told} == {"proof-of-another-time"}


def test_what_waits_for_its_proof_to_be_verified_becomes_stale_meanwhile():
    """A thread that is held up is a way to hold a command back, too."""
    now_s = [NOW_S]

    async def story():
        loop = Loop()
        door = door_of(loop, LINE, lambda: now_s[0], loop.tell)
        payload = signed(Start())(door)
        try:
            answering = asyncio.create_task(door.command(payload))
            await asyncio.sleep(0)  # it has been looked at once, and is being verified
            now_s[0] = NOW_S + MOTION_STALE_S + 0.1
            return Reply.model_validate_json(await answering), loop
        finally:
            door.close()

    answer, loop = asyncio.run(story())
    assert [one.code for one in answer.findings] == ["proof-of-another-time"] and not loop.done


def test_all_that_moves_rollers_or_readies_drives_is_stale_soon():
    assert {"arm", "start", "prove", "drill", "set", "speed", "recipe", "experiment"} == OVERTAKEN
    assert not OVERTAKEN & {name for name, who in TO_LOOP.items() if who is Speaker.ANYBODY}


@pytest.mark.parametrize("safe", [Stop(), Hold()], ids=lambda one: one.command)
@pytest.mark.parametrize("command", MOTION, ids=lambda one: one.command)
def test_what_was_signed_before_a_stop_and_held_back_sets_nothing_in_motion_after_it(command, safe):
    clocks = (NOW_S - 5.0, NOW_S - 0.1, NOW_S)
    said = [lambda _: command_bytes(safe), *[signed(command, clock=clock) for clock in clocks]]
    answers, loop = at_door(said)
    assert answers == ["done", "proof-before-stop", "proof-before-stop", "done"]
    assert loop.done == [safe, command]
    assert [code for _, code, _ in loop.told] == ["proof-before-stop"]  # the other one was only overtaken


def test_what_takes_the_line_to_the_safe_side_or_holds_what_was_approved_is_overtaken_by_no_stop():
    others = [one for one in SAID if one not in MOTION]
    said = [lambda _: command_bytes(Stop()), *[signed(one, clock=NOW_S - 0.1 - k) for k, one in enumerate(others)]]
    answers, loop = at_door(said)
    assert answers == ["done"] * len(said) and loop.done == [Stop(), *others] and not loop.told


@pytest.mark.parametrize("lacks", ["proposal", "verdict", "approval"])
def test_what_changes_how_the_line_is_controlled_is_not_taken_without_its_grounds(lacks):
    less = GROUNDS.model_copy(update={lacks: None})
    grounded = (deploy(), Keep(epoch=1), JUDGED)
    said = [signed(one, NOW_S - k * 0.1, grounds=less) for k, one in enumerate((*grounded, Arm()))]
    answers, loop = at_door(said)
    assert answers == ["no-grounds"] * 3 + ["done"] and loop.done == [Arm()]


def test_an_experiment_runs_by_the_grounds_of_its_own_proposal_and_no_other():
    other = GROUNDS.model_copy(update={"proposal": "d" * 64})
    answers, loop = at_door([signed(JUDGED, NOW_S - 0.1, grounds=other), signed(JUDGED)])
    assert answers == ["no-grounds", "done"] and loop.done == [JUDGED]


def test_the_proof_of_one_command_carries_no_other():
    def exchanged(door):
        own = opened(signed(deploy())(door))
        return sealed(own.proof, command_bytes(deploy(OTHER)))

    def claims_less(door):
        """Signed by somebody who has the key, of something else than the command says: the loop reads both."""
        signer = signer_of(LINE, lambda: NOW_S)
        content = command_bytes(deploy(region=Region()))
        return sealed(signer.proof(deploy(), content, door.nonce, GROUNDS), content)

    answers, loop = at_door([exchanged, claims_less])
    assert answers == ["proof-of-another-command"] * 2 and loop.done == []


@given(data=st.data())
def test_any_byte_of_an_envelope_that_is_changed_or_missing_refuses_it(data):
    command = data.draw(st.sampled_from([deploy(), Keep(epoch=1), Narrow(region=Region()), Arm()]))

    def spoiled(door):
        whole = signed(command)(door)
        at = data.draw(st.integers(0, len(whole) - 1))
        if data.draw(st.booleans()):
            return whole[:at]
        changed = data.draw(st.integers(1, 255))
        return whole[:at] + bytes([whole[at] ^ changed]) + whole[at + 1 :]

    answers, loop = at_door([spoiled])
    assert answers != ["done"] and loop.done == []


FIELDS = {
    "number": st.integers(1, 2**63 - 1),
    "command": st.sampled_from(sorted(TO_LOOP)),
    "content": st.text("0123456789abcdef", min_size=64, max_size=64),
    "site": st.text("abc", min_size=1),
    "line": st.text("abc", min_size=1),
}


@given(data=st.data(), name=st.sampled_from(sorted(FIELDS)))
def test_any_field_that_is_changed_after_signing_refuses_it(data, name):
    def changed(door):
        own = opened(signed(deploy())(door))
        value = data.draw(FIELDS[name].filter(lambda value: value != getattr(own.proof.statement, name)))
        statement = own.proof.statement.model_copy(update={name: value})
        return sealed(own.proof.model_copy(update={"statement": statement}), own.command)

    answers, loop = at_door([changed])
    assert answers != ["done"] and loop.done == []


@given(payload=st.binary(max_size=300) | st.binary(max_size=300).map(lambda rest: b"\x01" + rest))
def test_rubbish_is_refused_and_raises_nothing(payload):
    answers, loop = at_door([lambda _: payload])
    assert answers != ["done"] and loop.done == []


def test_a_stranger_is_looked_at_now_and_then_and_the_gateway_always():
    gateway, stranger = Peer(1000, 11), Peer(1000, 12)
    forged = signed(deploy(), clock=NOW_S - 0.5, key=Ed25519PrivateKey.generate())
    told = [(signed(Renew(epoch=1)), gateway), *[(forged, stranger)] * 50, (signed(Arm(), clock=NOW_S - 0.2), gateway)]
    answers, loop = at_door([payload for payload, _ in told], peers=[peer for _, peer in told])
    assert answers[0] == answers[-1] == "done"
    assert answers.count("proof-not-signed") == 5 and answers.count("too-many-proofs") == 45
    assert len(loop.told) == 5 and {pid for _, _, pid in loop.told} == {12}  # and the rest is counted


def test_a_loop_without_a_key_takes_what_is_safe_and_finds_the_key_once_there_is_one():
    keys = []

    async def story():
        loop = Loop()
        door = Door(loop, name_of(LINE), lambda: keys[0] if keys else None, lambda: NOW_S)
        signer = signer_of(LINE, lambda: NOW_S)
        try:
            answers = [json.loads(await door.command(signer.sealed(Arm(), door.nonce)))]
            answers.append(json.loads(await door.command(command_bytes(Stop()))))
            keys.append(PUBLIC)
            answers.append(json.loads(await door.command(signer.sealed(Arm(), door.nonce))))
        finally:
            door.close()
        return answers

    answers = asyncio.run(story())
    assert [answer["ok"] for answer in answers] == [False, True, True]
    assert answers[0]["findings"][0]["code"] == "no-gateway-key"


def test_what_is_signed_is_the_command_as_it_is_parsed():
    for command in SAID:
        assert parse_command(opened(signed(command)(door_nonce())).command) == command


@pytest.mark.parametrize(("period_s", "answer"), [(0.01, "message-piece-too-long"), (0.1, "malformed")])
def test_what_would_keep_a_period_waiting_while_it_is_read_is_refused_with_what_is_allowed(period_s, answer):
    class Numbers:
        command = "watch-good"

        def model_dump_json(self):
            return json.dumps({"command": "watch-good", "watch": {"x": [0.123456789012345] * 4_000}})

    async def story():
        door = Door(Loop(), name_of(LINE), lambda: PUBLIC, lambda: NOW_S, period_s=period_s)
        try:
            payload = await asyncio.to_thread(signed(Numbers()), door)
            return json.loads(await door.command(payload))
        finally:
            door.close()

    told = asyncio.run(story())
    codes = [(one["code"], one["parameters"]["allowed_bytes"]) for one in told["findings"]]
    assert codes == ([] if answer == "malformed" else [(answer, most_at_once(period_s))]) and not told["ok"]


def door_nonce():
    class Named:
        nonce = "1" * 32

    return Named()
