"""What people have done through OPC UA: by role, in their name, bound to what they were shown; and wrong calls."""

import asyncio

import pytest
from asyncua import ua

from gateway.core.messages import Reply
from gateway.mailbox import places
from gateway.operator import line_side
from gateway.operator.opcua import limits
from gateway.operator.opcua.methods import METHODS
from gateway.operator.opcua.trust import fingerprint
from tests.protocol.operator_support import SHOWN, alarm, bench, der, pair, shown

CODES = ua.StatusCodes
TEXT, NUMBER, REAL, YES = ua.VariantType.String, ua.VariantType.UInt32, ua.VariantType.Double, ua.VariantType.Boolean


def run(story):
    asyncio.run(asyncio.wait_for(story(), 60.0))


def text(value):
    return ua.Variant(value, TEXT)


def number(value):
    return ua.Variant(value, NUMBER)


def real(value):
    return ua.Variant(value, REAL)


def decide(one, shown_hash=SHOWN, revision=3, approve=True):
    return [text(one.proposal_hash), text(shown_hash), number(revision), ua.Variant(approve, YES), text("looks right")]


SINCE = "2026-11-23T15:00:00.250Z"
ARGUMENTS = {
    "SetTension": lambda _: [number(1), real(22.0)], "SetSpeed": lambda _: [real(0.05)],
    "SelectRecipe": lambda _: [text("web-a")], "Rollback": lambda _: [text("it squeals")],
    "AcknowledgeAlarm": lambda _: [text("tension-low"), text(SINCE), text(None)], "Decide": decide,
    "ShelveAlarm": lambda _: [text("tension-low"), real(30.0), text("being mended")],
    "Archive": lambda _: [text("12"), text("phi_stable"), text("it held all week")],
    "LineChanged": lambda _: [text("a thinner web")],
    "Confirm": lambda _: [text("ab" * 32), text("it followed")],
}  # fmt: skip


def test_every_method_is_said_in_the_name_of_who_calls_and_refused_to_viewers():
    async def story():
        async with bench(spans=1) as b, b.connected("emma") as emma, b.connected("vera") as vera:
            one = shown()
            b.gateway.waiting = [one]
            for method in METHODS:
                arguments = ARGUMENTS.get(method.name, lambda _: [])(one)
                for _ in range(2):
                    assert await b.call(vera, method.name, *arguments) == (CODES.BadUserAccessDenied, [])
                assert await b.call(emma, method.name, *arguments) == (CODES.Good, [True, "done"]), method.name
            tried = [one for one in b.gateway.heard if one.person.name == "vera"]  # once each, for the audit
            assert [(one.said.command, one.person.role) for one in tried] == [
                (method.command, "viewer") for method in METHODS
            ]  # fmt: skip
            done = [one for one in b.gateway.heard if one.person.name != "vera"]
            assert [one.said.command for one in done] == [method.command for method in METHODS]
            for heard in done:
                assert (heard.person.name, heard.person.role, heard.person.through) == ("emma", "engineer", "opc-ua")
                assert heard.person.certificate == fingerprint(der(pair("client")))
            tension = next(one.said for one in done if one.said.command == "set")
            assert (tension.span, tension.tension_n, tension.step) == (1, 22.0, False)
            decided = done[0].said
            assert (decided.proposal, decided.shown, decided.approve, decided.script) == (
                one.proposal_hash, SHOWN, True, "",
            )  # fmt: skip

    run(story)


def test_two_people_who_call_at_the_same_time_are_not_taken_for_each_other():
    async def story():
        async with bench(spans=1) as b, b.connected("otto") as otto, b.connected("emma") as emma:
            b.gateway.hold = asyncio.Event()
            calls = [asyncio.create_task(b.call(client, "SelectRecipe", text(name)))
                     for client, name in ((otto, "of-otto"), (emma, "of-emma"), (otto, "of-otto"))]  # fmt: skip
            await asyncio.sleep(0)
            b.gateway.hold.set()
            await asyncio.gather(*calls)
            assert sorted((one.person.name, one.said.name) for one in b.gateway.heard) == [
                ("emma", "of-emma"), ("otto", "of-otto"), ("otto", "of-otto"),
            ]  # fmt: skip

    run(story)


def test_of_which_revision_it_was_is_for_the_gateway_to_judge_and_what_is_no_decision_is_not_sent():
    async def story():
        async with bench(spans=1) as b, b.connected("otto") as client:
            one = shown(epoch=4)
            b.gateway.waiting = [one]
            await b.call(client, "Decide", *decide(one, revision=3))
            await b.call(client, "Decide", text(one.proposal_hash[:12]), *decide(one, revision=4)[1:])
            await b.call(client, "Decide", text("f" * 64), *decide(one)[1:])  # that there is none is on record, too
            hashes = [one.proposal_hash, one.proposal_hash, "f" * 64]
            assert [(heard.said.proposal, heard.said.revision) for heard in b.gateway.heard] == [
                *zip(hashes, (3, 4, 3), strict=True)
            ]
            b.gateway.heard.clear()
            code, (ok, sentence) = await b.call(client, "Decide", text("f" * 12), *decide(one)[1:])
            assert code == CODES.Good and not ok and "there is no such proposal" in sentence
            code, (ok, sentence) = await b.call(client, "Decide", *decide(one, shown_hash="5", revision=4))
            assert not ok and "shown" in sentence
            code, (ok, sentence) = await b.call(client, "Decide", text("no hash"), *decide(one)[1:])
            assert not ok
            assert b.gateway.heard == []

    run(story)


def test_what_the_gateway_refuses_is_told_with_every_reason():
    async def story():
        async with bench(spans=1) as b, b.connected("otto") as client:
            one = shown()
            b.gateway.waiting = [one]
            b.gateway.reply = Reply(ok=False, state="", text="not decided", reasons=["it was decided already"])
            told = await b.call(client, "Decide", *decide(one))
            assert told == (CODES.Good, [False, "not decided; it was decided already"])
            await b.gateway_mailbox.close()
            code, (ok, sentence) = await b.call(client, "Stop")
            assert (code, ok) == (CODES.Good, False) and "gateway not running" in sentence

    run(story)


WRONG = [
    ("SetTension", [number(1)], CODES.BadArgumentsMissing, []),
    ("SetTension", [], CODES.BadArgumentsMissing, []),
    ("SetTension", [number(1), real(1.0), real(1.0)], CODES.BadTooManyArguments, []),
    ("Arm", [number(1)], CODES.BadTooManyArguments, []),
    ("SetTension", [real(1.0), real(1.0)], CODES.BadInvalidArgument, [CODES.BadTypeMismatch, CODES.Good]),
    ("SetTension", [number(1), text("22")], CODES.BadInvalidArgument, [CODES.Good, CODES.BadTypeMismatch]),
    ("SetSpeed", [ua.Variant([0.1], REAL)], CODES.BadInvalidArgument, [CODES.BadTypeMismatch]),
    ("SetSpeed", [ua.Variant(None)], CODES.BadInvalidArgument, [CODES.BadTypeMismatch]),
]


def test_a_call_that_cannot_be_one_gets_its_code_and_the_session_lives():
    async def story():
        async with bench(spans=1) as b, b.connected("otto") as client:
            for method, arguments, code, each in WRONG:
                request = ua.CallMethodRequest(b.id("Line"), b.id(f"Line.{method}"), arguments)
                (result,) = await client.uaclient.call([request])
                assert result.StatusCode.value == code, (method, arguments)
                assert [one.value for one in result.InputArgumentResults or ()][: len(each)] == each
            assert await b.call(client, "Hold") == (CODES.Good, [True, "done"])
            assert [one.said.command for one in b.gateway.heard] == ["hold"]

    run(story)


def test_numbers_that_are_none_are_refused_in_words():
    async def story():
        async with bench(spans=1) as b, b.connected("emma") as client:
            for method, arguments in (
                ("SetTension", [number(1), real(float("nan"))]), ("SetSpeed", [real(float("inf"))]),
                ("SetTension", [number(0), real(20.0)]), ("Rollback", [text("x" * 1001)]),
                ("AcknowledgeAlarm", [text("No Such"), text(SINCE), text("")]),
                ("ShelveAlarm", [text("load-cell"), real(float("nan")), text("why")]),
                ("ShelveAlarm", [text("load-cell"), real(1e9), text("why")]),
                ("ShelveAlarm", [text("load-cell"), real(30.0), text("")]), ("LineChanged", [text("")]),
            ):  # fmt: skip
                code, (ok, sentence) = await b.call(client, method, *arguments)
                assert (code, ok) == (CODES.Good, False) and sentence.startswith("nothing was sent: "), method
            assert b.gateway.heard == []

    run(story)


def test_a_method_that_takes_its_time_keeps_nothing_else_of_its_client_waiting():
    async def story():
        async with bench(spans=1) as b, b.connected("otto") as client:
            b.gateway.hold = asyncio.Event()
            calling = asyncio.create_task(b.call(client, "Arm"))
            await asyncio.sleep(0)
            await b.until(client, "Line.Operation.State", lambda found: found.Value.Value == "RUN")
            assert not calling.done()
            others = [asyncio.create_task(b.call(client, "Start")) for _ in range(5)]  # more than may be at once
            refused, _ = await asyncio.wait(others, return_when=asyncio.FIRST_COMPLETED)
            with pytest.raises(ua.uaerrors.BadTooManyOperations):
                await refused.pop()
            b.gateway.hold.set()
            assert await calling == (CODES.Good, [True, "done"])
            await asyncio.gather(*others, return_exceptions=True)

    run(story)


def test_what_stops_the_line_is_not_refused_because_other_methods_take_their_time(monkeypatch):
    for module in (line_side, places):
        monkeypatch.setattr(module, "SAFE_S", 60.0)  # nobody is told meanwhile that there is no answer

    async def story():
        async with bench(spans=1) as b, b.connected("otto") as client:
            b.gateway.hold = asyncio.Event()
            tasks = [asyncio.create_task(b.call(client, "Start")) for _ in range(limits.MAX_CALLS)]
            safe = ["Stop", "Hold"] * limits.MAX_URGENT
            tasks += [asyncio.create_task(b.call(client, name)) for name in safe]
            await b.read(client, "Line.Operation.State")  # they have all come
            assert not any(task.done() for task in tasks)
            for name in ("Stop", "Hold", "Arm"):  # there is an end to these, too
                with pytest.raises(ua.uaerrors.BadTooManyOperations):
                    await b.call(client, name)
            b.gateway.hold.set()
            assert await asyncio.gather(*tasks) == [(CODES.Good, [True, "done"])] * len(tasks)

    run(story)


def test_methods_say_what_they_take_and_return():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            inputs = await (await client.get_node(b.id("Line.Decide")).get_child("0:InputArguments")).read_value()
            assert [one.Name for one in inputs] == ["id", "hash", "base_revision", "approve", "comment"]
            outputs = await (await client.get_node(b.id("Line.Decide")).get_child("0:OutputArguments")).read_value()
            assert [one.Name for one in outputs] == ["ok", "sentence"]

    run(story)


def test_what_takes_an_engineer_is_refused_to_an_operator():
    async def story():
        async with bench(spans=1) as b, b.connected("otto") as otto:
            for name in ("Archive", "LineChanged"):
                assert await b.call(otto, name, *ARGUMENTS[name](None)) == (CODES.BadUserAccessDenied, [])

    run(story)


def test_an_alarm_is_acknowledged_as_it_was_shown():
    async def story():
        async with bench(spans=1) as b, b.connected("otto") as client:
            b.gateway.alarms = [alarm("load-cell").model_copy(update={"since_wall_s": 1.7e9 + 0.125})]
            path = "Line.Alarms.load-cell.Since"
            since = (await b.until(client, path, lambda found: bool(found.Value.Value))).Value.Value
            assert (await b.call(client, "AcknowledgeAlarm", text("load-cell"), text(since), text("")))[1][0]
            for wrong in ("", "yesterday", "2026-11-23T15:00:00", "9" * 5000):
                _, (ok, sentence) = await b.call(client, "AcknowledgeAlarm", text("load-cell"), text(wrong), text(""))
                assert not ok and "allowed: Since of the alarm" in sentence and len(sentence) < 200
            (heard,) = b.gateway.heard
            assert (heard.said.alarm, heard.said.since_wall_s) == ("load-cell", 1.7e9 + 0.125)

    run(story)
