"""What the page asks for and what people say through it, down to a gateway behind a socket."""

import asyncio

import pytest

from gateway.core.decisions import Decide
from gateway.core.finding import finding
from gateway.core.people import LEAST, ROLES, Person, Role, may
from gateway.wording.catalogue import sentence
from tests.operator.fake_line import alarm
from tests.unit.page_support import page
from tests.unit.supervisor_support import until

HASH = "ab" * 32
SAID: dict[str, dict[str, object]] = {
    "arm": {},
    "start": {},
    "hold": {},
    "stop": {},
    "set": {"span": 1, "tension_n": 21.0},
    "speed": {"speed_m_per_s": 0.02},
    "recipe": {"name": "tension"},
    "experiment-abort": {},
    "decide": {"proposal": HASH, "shown": HASH, "approve": False},
    "roll-back": {"comment": "it hums"},
    "acknowledge": {"alarm": "device-absent"},
    "shelve": {"alarm": "device-absent", "for_s": 60.0, "because": "fitter is there"},
    "archive": {"configuration": "abc", "name": "spring", "because": "it was good"},
    "line-changed": {"because": "new web"},
    "confirm": {"configuration": HASH, "because": "it followed"},
}


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("command", SAID)
def test_each_role_says_what_it_may_in_its_own_name(role: Role, command: str):
    async def story() -> None:
        async with page() as there:
            await there.log_in(role)
            answer = await there.say(command, **SAID[command])
            heard = there.gateway.said[-1]  # also where it is refused: the audit has to know that it was tried
            assert heard.person == Person(name=role, role=role, through="page") and heard.said.command == command
            assert (answer.status_code == 403) == (not may(role, command))
            assert answer.json()["ok"] == (may(role, command) and command != "decide")

    asyncio.run(story())


def test_no_command_of_the_table_was_forgotten_here():
    assert SAID.keys() | {"experiment"} == LEAST.keys()


@pytest.mark.parametrize(
    "said", [{}, {"command": "deploy"}, {"command": "rollback", "reason": "x"}, {"command": "stop", "person": "x"},
             {"command": "set", "span": 0, "tension_n": 1.0}, {"command": "set", "span": 1, "tension_n": "nan"}]
)  # fmt: skip
def test_what_is_nothing_that_people_say_never_reaches_the_gateway(said: dict[str, object]):
    async def story() -> None:
        async with page() as there:
            await there.log_in("engineer")
            answer = await there.browser.post("/api/say", json=said)
            assert answer.status_code == 400 and answer.json()["text"]
            assert there.gateway.said == []

    asyncio.run(story())


def test_a_decision_is_on_what_was_shown():
    async def story() -> None:
        async with page() as there:
            await there.log_in()
            shown = (await there.browser.get(f"/api/proposals/{there.gateway.hash}")).json()
            parts = {
                "proposal": shown["proposal_hash"],
                "shown": shown["shown"],
                "approve": True,
                "comment": "looks well",
            }
            assert (await there.say("decide", **parts)).json()["ok"]
            assert there.gateway.said[-1].said == Decide(**parts)
            again = await there.say("decide", **parts)
            assert again.status_code == 409 and again.json()["reasons"]

    asyncio.run(story())


def test_a_decision_on_what_has_changed_meanwhile_does_not_count_and_says_why():
    async def story() -> None:
        async with page() as there:
            await there.log_in()
            shown = (await there.browser.get(f"/api/proposals/{there.gateway.hash}")).json()
            there.gateway.epoch += 1
            parts = {"proposal": shown["proposal_hash"], "shown": shown["shown"], "approve": True}
            answer = await there.say("decide", **parts)
            assert answer.status_code == 409 and "no longer" in answer.json()["reasons"][0]
            assert there.gateway.stage == "waiting"

    asyncio.run(story())


def test_a_proposal_is_told_with_every_rule_and_without_its_matrices():
    async def story() -> None:
        async with page() as there:
            await there.log_in("viewer")
            answer = await there.browser.get(f"/api/proposals/{there.gateway.hash}")
            told, verdict = answer.json(), there.gateway.verdict
            assert [one["rule"] for one in told["verdict"]["findings"]] == [one.rule for one in verdict.findings]
            assert len(told["verdict"]["figures"]) == len(verdict.figures)
            assert told["reason"] == there.gateway.proposal.reason and told["shown"] == there.gateway.shown
            assert "gain_input" not in answer.text and len(answer.content) < 20_000

    asyncio.run(story())


@pytest.mark.parametrize("path, status", [("proposals/" + "00" * 32, 503), ("proposals/xyz", 400),
                                          ("records?after=-1", 400), ("records?after=x", 400), ("tensions", 400),
                                          ("tensions?from_wall_s=0&to_wall_s=1&points=100000", 400)])  # fmt: skip
def test_what_cannot_be_told_is_refused_in_words(path: str, status: int):
    async def story() -> None:
        async with page() as there:
            await there.log_in("viewer")
            answer = await there.browser.get(f"/api/{path}")
            assert answer.status_code == status and answer.json()["text"]

    asyncio.run(story())


def test_the_past_is_told_in_sentences_and_columns():
    async def story() -> None:
        async with page() as there:
            await there.log_in("viewer")
            records = (await there.browser.get("/api/records?after=1")).json()["records"]
            assert [one["kind"] for one in records] == ["kept"] and "what" not in records[0]
            asked = {"from_wall_s": 0.0, "to_wall_s": 600.0, "points": 50}
            told = (await there.browser.get("/api/tensions", params=asked)).json()
            assert len(told["wall_s"]) == 50 and len(told["tension_n"]) == 3

    asyncio.run(story())


def test_a_gateway_that_is_away_has_refused_nothing_not_even_a_stop():
    async def story() -> None:
        async with page() as there:
            await there.log_in()
            await there.gateway_mailbox.close()
            answer = await there.say("stop")
            assert answer.status_code == 504 and not answer.json()["ok"] and answer.json()["text"]
            await until(lambda: there.side.trouble != "")
            assert (await there.browser.get("/api/records")).status_code == 503

    asyncio.run(story())


def test_an_alarm_is_acknowledged_and_shelved_in_a_persons_name():
    async def story() -> None:
        async with page() as there:
            there.gateway.alarms = [alarm()]
            await there.log_in()
            await there.say("acknowledge", alarm="device-absent")
            await there.say("shelve", alarm="device-absent", for_s=60.0, because="fitter is there")
            (one,) = there.gateway.alarms
            assert one.acknowledged_by == "operator" and one.shelved_until_wall_s is not None

    asyncio.run(story())


def test_what_speaks_against_it_is_told_with_its_sentence_in_the_other_languages():
    async def story() -> None:
        async with page() as there:
            there.gateway.against = [finding("part-failed", part="the lease", error="ValueError: 1.5")]
            await there.log_in("operator")
            told = (await there.say("arm")).json()
            (english,) = told["reasons"]
            assert told["said"]["de"][english] == sentence(there.gateway.against[0], "de") != english
            assert told["findings"] == [there.gateway.against[0].model_dump()]

    asyncio.run(story())
