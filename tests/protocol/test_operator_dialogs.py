"""Proposals as dialogs: one for each as it is shown, its answer bound to that, all once more for whoever asks."""

from typing import Any

import pytest
from asyncua import ua

from gateway.core.decisions import Decide
from gateway.core.messages import Reply
from gateway.operator.opcua import dialogs
from tests.protocol.operator_support import SHOWN, bench, comes, shown
from tests.protocol.test_operator_nodes import Heard, run

CODES = ua.StatusCodes
RESPOND = ua.NodeId(ua.ObjectIds.DialogConditionType_Respond)
CONDITION = ua.NodeId(ua.ObjectIds.ConditionType)
REFRESH = ua.NodeId(ua.ObjectIds.ConditionType_ConditionRefresh)
REFRESH2 = ua.NodeId(ua.ObjectIds.ConditionType_ConditionRefresh2)


def of_dialogs() -> ua.EventFilter:
    """All conditions, of whatever subtype; and where a refresh begins and ends."""
    paths = [["EventType"], ["Message"], ["Severity"], ["Retain"], ["ConditionName"], ["EnabledState", "Id"],
             ["Quality"], ["DialogState", "Id"], ["Prompt"], ["ResponseOptionSet"], ["DefaultResponse"], ["OkResponse"],
             ["CancelResponse"], ["LastResponse"], ["EventId"]]  # fmt: skip
    selects = [
        ua.SimpleAttributeOperand(BrowsePath=[ua.QualifiedName(name, 0) for name in path], AttributeId=13)
        for path in paths
    ]
    selects.append(ua.SimpleAttributeOperand(TypeDefinitionId=CONDITION, AttributeId=ua.AttributeIds.NodeId))
    system = ua.NodeId(ua.ObjectIds.SystemEventType)
    either = ua.ContentFilterElement(
        FilterOperator=ua.FilterOperator.Or, FilterOperands=[ua.ElementOperand(Index=1), ua.ElementOperand(Index=2)]
    )
    elements = [either, *(_of_type(one) for one in (CONDITION, system))]
    return ua.EventFilter(SelectClauses=selects, WhereClause=ua.ContentFilter(Elements=elements))


def _of_type(kind: ua.NodeId) -> ua.ContentFilterElement:
    operand = ua.LiteralOperand(Value=ua.Variant(kind, ua.VariantType.NodeId))
    return ua.ContentFilterElement(FilterOperator=ua.FilterOperator.OfType, FilterOperands=[operand])


async def watched(client: Any) -> tuple[Heard, Any, int]:
    heard = Heard()
    subscription = await client.create_subscription(50, heard)
    item = await subscription.subscribe_events(evfilter=of_dialogs())
    return heard, subscription, item


async def called(client: Any, of: Any, method: Any, *arguments: ua.Variant) -> int:
    (result,) = await client.uaclient.call([ua.CallMethodRequest(of, method, list(arguments))])
    return result.StatusCode.value


async def answered(client: Any, dialog: Any, selected: Any, kind: Any = ua.VariantType.Int32) -> int:
    return await called(client, dialog, RESPOND, ua.Variant(selected, kind))


def test_what_waits_is_a_dialog_and_its_answer_a_decision_on_what_was_shown():
    async def story():
        async with bench(spans=1) as b, b.connected("otto") as client:
            heard, _, _ = await watched(client)
            one = shown()
            b.gateway.waiting = [one]
            told = await heard.values.get()
            assert told.EventType == ua.NodeId(ua.ObjectIds.DialogConditionType)
            assert told.Retain is True and getattr(told, "EnabledState/Id") is True
            assert getattr(told, "DialogState/Id") is True and told.Quality.is_good()
            assert "gain of span 2 from 1 to 2" in told.Prompt.Text and one.proposal.reason not in told.Prompt.Text
            assert [option.Text for option in told.ResponseOptionSet] == ["approve", "reject"]
            assert (told.DefaultResponse, told.OkResponse, told.CancelResponse, told.LastResponse) == (-1, -1, -1, -1)
            assert await answered(client, told.NodeId, 0) == CODES.Good
            (said,) = b.gateway.heard
            assert said.person.name == "otto"
            assert said.said == Decide(
                proposal=one.proposal_hash, shown=SHOWN, revision=one.epoch, approve=True, comment=""
            )
            answer = await heard.values.get()
            assert (answer.NodeId, answer.LastResponse, answer.Retain) == (told.NodeId, 0, True)
            b.gateway.waiting = []
            ended = await heard.values.get()
            assert (ended.NodeId, ended.Retain, getattr(ended, "DialogState/Id")) == (told.NodeId, False, False)
            assert await answered(client, told.NodeId, 0) != CODES.Good
            assert len(b.gateway.heard) == 1 and heard.values.empty()

    run(story)


def test_what_is_shown_anew_is_another_dialog_and_the_first_is_answered_by_nobody():
    async def story():
        async with bench(spans=1) as b, b.connected("otto") as client:
            heard, _, _ = await watched(client)
            one = shown()
            b.gateway.waiting = [one]
            first = await heard.values.get()
            b.gateway.waiting = [one.model_copy(update={"shown": "6" * 64}), shown(reason="to be listed anew")]
            ended, *begun = [await heard.values.get() for _ in range(3)]
            assert ended.NodeId == first.NodeId and ended.Retain is False
            assert first.NodeId not in [other.NodeId for other in begun]
            assert await answered(client, first.NodeId, 0) != CODES.Good
            assert b.gateway.heard == []
            assert await answered(client, begun[1].NodeId, 1) == CODES.Good
            assert b.gateway.heard[0].said == Decide(
                proposal=one.proposal_hash, shown="6" * 64, revision=one.epoch, approve=False, comment=""
            )

    run(story)


def test_who_may_not_decide_answers_no_dialog_and_neither_does_what_is_no_answer():
    async def story():
        async with bench(spans=1) as b, b.connected("otto") as client, b.connected("vera") as viewer:
            heard, _, _ = await watched(client)
            b.gateway.waiting = [shown(epoch=2)]
            told = await heard.values.get()
            b.gateway.reply = Reply(ok=False, state="RUN", text="a viewer may not")
            assert await answered(viewer, told.NodeId, 0) == CODES.BadUserAccessDenied
            assert [one.person.name for one in b.gateway.heard] == ["vera"]  # the audit has to know
            for selected in (2, -1, 2**31 - 1):
                assert await answered(client, told.NodeId, selected) == CODES.BadDialogResponseInvalid
            assert await answered(client, told.NodeId, True, ua.VariantType.Boolean) == CODES.BadInvalidArgument
            assert await called(client, told.NodeId, RESPOND) == CODES.BadArgumentsMissing
            for nobody in (b.id("Line"), RESPOND, ua.NodeId(ua.ObjectIds.DialogConditionType)):
                assert await answered(client, nobody, 0) == CODES.BadDialogNotActive
            assert len(b.gateway.heard) == 1
            assert await answered(client, told.NodeId, 0) == CODES.BadInvalidState  # the gateway has refused it
            await b.gateway_mailbox.close()
            assert await answered(client, told.NodeId, 0) != CODES.Good

    run(story)


def test_who_comes_later_asks_for_all_that_waits_and_for_nobody_else(monkeypatch):
    monkeypatch.setattr(dialogs, "REFRESH_S", 0.0)

    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client, b.connected("otto") as other:
            b.gateway.waiting = [shown(reason="the second"), shown(reason="the first")]
            path = f"Line.Proposals.{b.gateway.waiting[0].proposal_hash}.Id"
            await b.until(client, path, lambda found: found.StatusCode.is_good())
            heard, subscription, item = await watched(client)
            strange, theirs, _ = await watched(other)
            number = ua.Variant(subscription.subscription_id, ua.VariantType.UInt32)
            assert await called(client, CONDITION, REFRESH, number) == CODES.Good
            kinds = [(await heard.values.get()).EventType.Identifier for _ in range(4)]
            dialog = ua.ObjectIds.DialogConditionType
            ends = ua.ObjectIds.RefreshStartEventType, ua.ObjectIds.RefreshEndEventType
            assert kinds == [ends[0], dialog, dialog, ends[1]]
            of_item = ua.Variant(item, ua.VariantType.UInt32)
            assert await called(client, CONDITION, REFRESH2, number, of_item) == CODES.Good
            assert [(await heard.values.get()).EventType.Identifier for _ in range(4)] == kinds
            not_mine = ua.Variant(theirs.subscription_id, ua.VariantType.UInt32)
            assert await called(client, CONDITION, REFRESH, not_mine) == CODES.BadSubscriptionIdInvalid
            no_item = ua.Variant(4711, ua.VariantType.UInt32)
            assert await called(client, CONDITION, REFRESH2, number, no_item) == CODES.BadMonitoredItemIdInvalid
            assert await called(client, CONDITION, REFRESH) == CODES.BadArgumentsMissing
            monkeypatch.setattr(dialogs, "REFRESH_S", 60.0)
            assert await called(client, CONDITION, REFRESH, number) == CODES.BadRefreshInProgress
            assert await called(other, CONDITION, REFRESH, not_mine) == CODES.Good  # each for itself
            assert [(await strange.values.get()).EventType.Identifier for _ in range(4)] == kinds
            assert heard.values.empty() and strange.values.empty()

    run(story)


@pytest.mark.wires
def test_nobody_is_told_that_something_waits_which_nobody_knows():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            heard, _, _ = await watched(client)
            b.gateway.waiting = [shown()]
            told = await heard.values.get()
            nodes = client.get_node(told.NodeId)
            b.gateway.lists = False
            unsure = await heard.values.get()
            assert unsure.Quality.value == CODES.BadNoCommunication and unsure.Retain is True
            quality = await nodes.get_child("0:Quality")
            assert (await quality.read_value()).value == CODES.BadNoCommunication
            b.gateway.lists = True
            again = await heard.values.get()
            assert again.Quality.is_good() and again.NodeId == told.NodeId
            b.gateway.waiting = []
            assert (await heard.values.get()).Retain is False
            await comes(lambda: told.NodeId not in b.opcua.server.iserver.aspace)
            b.gateway.waiting = [shown(reason="the type has kept its method")]
            assert await answered(client, (await heard.values.get()).NodeId, 0) == CODES.BadUserAccessDenied

    run(story)


def test_a_dialog_can_be_browsed_and_answered_by_its_own_method():
    async def story():
        async with bench(spans=1) as b, b.connected("otto") as client:
            one = shown()
            b.gateway.waiting = [one]
            heard, _, _ = await watched(client)
            (folder,) = await client.get_node(b.id("Line")).get_children_by_path([["2:Dialogs"]])
            told = await heard.values.get()
            (dialog,) = await folder[0].get_children()
            assert await dialog.read_type_definition() == ua.NodeId(ua.ObjectIds.DialogConditionType)
            for name, value in (("EventId", told.EventId), ("Message", told.Message)):
                assert await (await dialog.get_child(f"0:{name}")).read_value() == value
            options = await dialog.get_child("0:ResponseOptionSet")
            assert await options.read_value_rank() == ua.ValueRank.OneDimension
            prompt = await (await dialog.get_child("0:Prompt")).read_value()
            assert prompt.Text.startswith("Put this controller into service?")
            assert await (await dialog.get_child(["0:DialogState", "0:Id"])).read_value() is True
            respond = await dialog.get_child("0:Respond")
            chosen = ua.Variant(1, ua.VariantType.Int32)
            assert await called(client, dialog.nodeid, respond.nodeid, chosen) == CODES.Good
            assert b.gateway.heard[0].said.approve is False

    run(story)


def test_a_dialog_that_cannot_be_made_hides_no_proposal_and_is_made_when_it_can(monkeypatch):
    async def story():
        async with bench(spans=1) as b, b.connected("otto") as client:
            with monkeypatch.context() as fault:
                fault.setattr(dialogs, "prompt", lambda _: 1 / 0)
                one = shown(reason="for two")
                b.gateway.waiting = [one.model_copy(update={"approvals": 2})]
                path = f"Line.Proposals.{one.proposal_hash}.Id"
                await b.until(client, path, lambda found: found.StatusCode.is_good())
                await comes(lambda: any("ZeroDivisionError" in said for said in b.said))
                assert (await b.read(client, path)).StatusCode.is_good()
                assert await b.opcua.server.get_node(b.id("Line.Dialogs")).get_children() == []
            heard, _, _ = await watched(client)
            assert "It takes 2 different people." in (await heard.values.get()).Prompt.Text

    run(story)
