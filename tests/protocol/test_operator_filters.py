"""What a client asks of the items that it watches never keeps others from being told."""

import asyncio

import pytest
from asyncua import ua

from gateway.operator.opcua import limits
from gateway.operator.opcua.filters import Items
from gateway.operator.opcua.space import GOOD, NO_COMMUNICATION
from tests.protocol.operator_support import bench
from tests.protocol.test_operator_nodes import Heard, record

CODES = ua.StatusCodes


def run(story):
    asyncio.run(asyncio.wait_for(story(), 60.0))


def field(*names: str | None, attribute: int = ua.AttributeIds.Value) -> ua.SimpleAttributeOperand:
    path = [ua.QualifiedName(name, 0) for name in names]
    return ua.SimpleAttributeOperand(BrowsePath=path, AttributeId=attribute)


def chosen(*selects, elements=()) -> ua.EventFilter:
    return ua.EventFilter(SelectClauses=list(selects), WhereClause=ua.ContentFilter(Elements=list(elements)))


def element(*to: int) -> ua.ContentFilterElement:
    operands = [ua.ElementOperand(Index=index) for index in to]
    return ua.ContentFilterElement(FilterOperator=ua.FilterOperator.InList, FilterOperands=operands)


BAD = [
    chosen(field(attribute=99)),
    chosen(*[field(name) for name in ("Message", "data_types")]),
    chosen(field("init")), chosen(field("_freeze")), chosen(field("__class__")), chosen(field("")), chosen(field(None)),
    chosen(field("Message", attribute=99)),
    chosen(),
    chosen(*[field("Message")] * 101),
    chosen(field("Message"), elements=[element(0)]),  # leads to itself
    chosen(field("Message"), elements=[element(1, 1), element(2, 2), element()]),  # twice as long with each
    chosen(field("Message"), elements=[element()] * 51),
    ua.DataChangeFilter(),
    None,
]  # fmt: skip


async def created(client, subscription, node, attribute, wanted) -> ua.MonitoredItemCreateResult:
    item = ua.MonitoredItemCreateRequest()
    item.ItemToMonitor = ua.ReadValueId(NodeId=node, AttributeId=attribute)
    item.MonitoringMode = ua.MonitoringMode.Reporting
    item.RequestedParameters = ua.MonitoringParameters(ClientHandle=7, QueueSize=10, Filter=wanted)
    params = ua.CreateMonitoredItemsParameters(
        SubscriptionId=subscription.subscription_id, TimestampsToReturn=ua.TimestampsToReturn.Both,
        ItemsToCreate=[item],
    )  # fmt: skip
    (result,) = await client.uaclient.create_monitored_items(params)
    return result


async def modified(client, subscription, number, wanted) -> int:
    item = ua.MonitoredItemModifyRequest(
        MonitoredItemId=number,
        RequestedParameters=ua.MonitoringParameters(ClientHandle=7, QueueSize=10, Filter=wanted),
    )
    params = ua.ModifyMonitoredItemsParameters(
        SubscriptionId=subscription.subscription_id, TimestampsToReturn=ua.TimestampsToReturn.Both,
        ItemsToModify=[item],
    )  # fmt: skip
    (result,) = await client.uaclient.modify_monitored_items(params)
    return result.StatusCode.value


async def looked(b) -> None:
    """The events have been asked for once: what comes now is told."""
    while not b.gateway.asked_past or b.gateway.asked_past[-1].after != 1:  # noqa: ASYNC110 (it is on the wire)
        await asyncio.sleep(0.01)


def test_a_filter_that_no_event_can_be_held_against_is_refused_and_others_are_told():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as vera, b.connected("otto") as otto:
            b.gateway.records = [record(1)]
            await looked(b)
            server, events = ua.NodeId(ua.ObjectIds.Server), ua.AttributeIds.EventNotifier
            bad = await vera.create_subscription(50, Heard())
            good = await created(vera, bad, server, events, chosen(field("Message"), field("NoSuch"), field()))
            assert good.StatusCode.is_good()
            for wanted in BAD:
                result = await created(vera, bad, server, events, wanted)
                assert result.StatusCode.value == CODES.BadFilterNotAllowed, wanted
                if wanted is not None:  # which leaves it as it is
                    found = await modified(vera, bad, good.MonitoredItemId, wanted)
                    assert found == CODES.BadFilterNotAllowed, wanted
            assert await modified(vera, bad, 4711, None) == CODES.BadMonitoredItemIdInvalid
            heard = Heard()
            subscription = await otto.create_subscription(50, heard)
            await subscription.subscribe_events()
            b.gateway.records += [record(2, "a set-point was moved")]
            assert (await heard.values.get()).Message.Text.endswith("a set-point was moved")

    run(story)


def test_a_subscription_that_cannot_be_told_of_an_event_ends_alone(monkeypatch):
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as vera, b.connected("otto") as otto:
            b.gateway.records = [record(1)]
            await looked(b)
            heard = Heard()
            broken, whole = await vera.create_subscription(50, Heard()), await otto.create_subscription(50, heard)
            await broken.subscribe_events()
            await whole.subscribe_events()
            there = b.opcua.server.iserver.subscription_service.subscriptions

            async def raises(event, mid=None):
                raise KeyError("data_types")

            monkeypatch.setattr(there[broken.subscription_id].monitored_item_srv, "trigger_event", raises)
            b.gateway.records += [record(2, "a set-point was moved")]
            assert (await heard.values.get()).Message.Text.endswith("a set-point was moved")
            assert list(there) == [whole.subscription_id]

    run(story)


def test_a_condition_that_is_changed_counts_from_then_on():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            b.gateway.records = [record(1)]
            await looked(b)
            heard = Heard()
            subscription = await client.create_subscription(50, heard)
            await subscription.subscribe_events()
            (items,) = [one.monitored_item_srv for one in
                        b.opcua.server.iserver.subscription_service.subscriptions.values()]  # fmt: skip
            assert isinstance(items, Items)
            (number,) = items._monitored_items  # noqa: SLF001
            equals = ua.ContentFilterElement(
                FilterOperator=ua.FilterOperator.Equals,
                FilterOperands=[field("Severity"), ua.LiteralOperand(Value=ua.Variant(1, ua.VariantType.UInt16))],
            )
            assert await modified(client, subscription, number, chosen(field("Message"), elements=[equals])) == GOOD
            held = items._monitored_items[number]  # noqa: SLF001
            assert held.where_clause_evaluator.elements == [equals]

    run(story)


@pytest.mark.wires
def test_values_that_are_watched_take_their_own_kind_of_filter_and_lose_nothing_where_there_is_no_number():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            heard = Heard()
            subscription = await client.create_subscription(50, heard)
            node, value = b.id("Line.Spans.1.Tension"), ua.AttributeIds.Value
            await b.until(client, "Line.Spans.1.Tension", lambda found: found.StatusCode.is_good())
            refused = await created(client, subscription, node, value, chosen(field("Message")))
            assert refused.StatusCode.value == CODES.BadFilterNotAllowed
            made = await subscription.subscribe_data_change(client.get_node(node))
            deadband = ua.DataChangeFilter(
                Trigger=ua.DataChangeTrigger.StatusValue, DeadbandType=ua.DeadbandType.Absolute, DeadbandValue=1.0
            )
            assert await modified(client, subscription, made, chosen(field("Message"))) == CODES.BadFilterNotAllowed
            assert await modified(client, subscription, made, deadband) == GOOD
            assert (await heard.values.get())[1] == 20.0
            b.gateway.tension_n = 20.5
            await b.until(client, "Line.Spans.1.Tension", lambda found: found.Value.Value == 20.5)
            b.gateway.tension_n = 22.0
            assert (await heard.values.get())[1] == 22.0
            await b.gateway_mailbox.close()
            assert (await heard.values.get())[1:] == (None, NO_COMMUNICATION)

    run(story)


def test_items_that_watch_events_are_few():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            server, events = ua.NodeId(ua.ObjectIds.Server), ua.AttributeIds.EventNotifier
            for _ in range(2):
                subscription = await client.create_subscription(1000, None)
                for _ in range(limits.MAX_EVENT_ITEMS // 2):
                    made = await created(client, subscription, server, events, chosen(field("Message")))
                    assert made.StatusCode.is_good()
            with pytest.raises(ua.uaerrors.BadTooManyMonitoredItems):
                await created(client, subscription, server, events, chosen(field("Message")))

    run(story)
