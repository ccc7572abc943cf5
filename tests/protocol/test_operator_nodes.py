"""What an OPC UA client sees of a line: nodes, units, values that say how good they are, proposals, events, history."""

import asyncio
from datetime import UTC, datetime, timedelta
from math import isnan

import pytest
from asyncua import Client, ua

from gateway.core.decisions import InServiceTold, PerformanceTold
from gateway.core.line_past import RecordTold, TensionsBetween
from gateway.core.signals import Quality
from gateway.core.status import ChangeStatus
from gateway.mailbox.unix import UnixMailbox
from gateway.operator.opcua.line_nodes import mode
from gateway.operator.opcua.space import NAMESPACE
from tests.protocol.operator_support import SHOWN, FakeGateway, alarm, bench, shown
from tests.unit.supervisor_support import line_of

CODES = ua.StatusCodes


def run(story):
    asyncio.run(asyncio.wait_for(story(), 120.0))


def good(found):
    return found.StatusCode.is_good()


def has(code):
    return lambda found: found.StatusCode.value == code


async def paths(client: Client, node) -> list[str]:
    """Of all variables and methods below."""
    found = []
    for child in await node.get_children():
        if child.nodeid.NamespaceIndex == 2 and isinstance(child.nodeid.Identifier, str):
            found.append(child.nodeid.Identifier)
        found += await paths(client, child)
    return found


def test_a_line_is_found_by_browsing_and_each_node_tells_what_it_is():
    async def story():
        async with bench(spans=2) as b, b.connected("vera") as client:
            assert await client.get_namespace_index(NAMESPACE) == 2
            root = client.get_node(b.id("Line"))
            assert root in await client.nodes.objects.get_children()
            found = await paths(client, root)
            assert {"Line.Spans.2.Tension", "Line.Rollers.2.Torque", "Line.Controller.Revision", "Line.Decide",
                    "Line.Proposals.Current.RuleMargin", "Line.Unwinder.Speed"} <= set(found)  # fmt: skip
            assert len(found) == len(set(found))
            span = client.get_node(b.id("Line.Spans.1"))
            assert await span.read_type_definition() == b.id("Types.SpanType")
            described = await client.get_node(b.id("Line.Spans.1.Error")).read_description()
            assert described.Text == "Tension minus set-point"
            by_path = await root.get_child(["2:Spans", "2:1", "2:Tension"])
            assert by_path.nodeid == b.id("Line.Spans.1.Tension")

    run(story)


def test_a_span_has_tension_set_point_units_and_range():
    async def story():
        async with bench() as b, b.connected("vera") as client:
            await b.until(client, "Line.Spans.2.Tension", good)
            assert await b.value(client, "Line.Spans.2.Tension") == 21.0
            assert await b.value(client, "Line.Spans.2.Setpoint") == 21.0
            units = await b.value(client, "Line.Spans.2.Tension.EngineeringUnits")
            assert (units.UnitId, units.DisplayName.Text) == (5129559, "N")  # UNECE NEW
            limits = await b.value(client, "Line.Spans.2.Tension.EURange")
            assert (limits.Low, limits.High) == (b.line.limits.tension_min_n, b.line.limits.tension_max_n)
            torque = await b.value(client, "Line.Rollers.1.Torque.EngineeringUnits")
            speed = await b.value(client, "Line.Rollers.1.Speed.EngineeringUnits")
            assert (torque.UnitId, speed.UnitId) == (20053, 5067859)  # NU, MTS

    run(story)


def test_no_node_of_the_line_can_be_written():
    async def story():
        async with bench(spans=1) as b, b.connected("emma") as client:
            await b.until(client, "Line.Spans.1.Tension", good)
            for path in await paths(client, client.get_node(b.id("Line"))):
                node = client.get_node(b.id(path))
                value = ua.WriteValue(node.nodeid, ua.AttributeIds.Value, None, ua.DataValue(ua.Variant(1.0)))
                named = ua.WriteValue(
                    node.nodeid, ua.AttributeIds.DisplayName, None, ua.DataValue(ua.Variant(ua.LocalizedText("x")))
                )
                codes = await client.uaclient.write(ua.WriteParameters(NodesToWrite=[value, named]))
                assert {code.value for code in codes} == {CODES.BadUserAccessDenied}, path
            kept = await client.get_node(b.id("Line.Spans.1.Tension")).read_display_name()
            assert kept.Text == "Tension"

    run(story)


def test_values_say_how_good_they_are():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            tension, torque = "Line.Spans.1.Tension", "Line.Rollers.1.Torque"
            await b.until(client, tension, good)
            b.gateway.quality = "STALE"
            held = await b.until(client, tension, has(CODES.UncertainLastUsableValue))
            assert held.Value.Value == 20.0
            b.gateway.quality = "BAD"
            failed = await b.until(client, tension, has(CODES.BadSensorFailure))
            assert failed.Value.Value is None
            b.gateway.quality, b.gateway.running = "STALE", False  # no loop: the last values, marked
            await b.until(client, torque, has(CODES.UncertainLastUsableValue))
            assert await b.value(client, "Line.Operation.Running") is False
            b.gateway.quality, b.gateway.running = "GOOD", True
            await b.until(client, tension, good)

    run(story)


def test_a_gateway_that_goes_away_leaves_nothing_that_looks_true():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            b.gateway.waiting = [shown()]
            await b.until(client, "Line.Proposals.Current.Id", lambda found: bool(found.Value.Value))
            await b.gateway_mailbox.close()
            for path in ("Line.Spans.1.Tension", "Line.Operation.State", "Line.Proposals.Current.ShownHash"):
                found = await b.until(client, path, has(CODES.BadNoCommunication))
                assert found.Value.Value is None
            assert await b.value(client, "Line.Connection.Fresh") is False
            assert "r2rgate gateway" in await b.value(client, "Line.Connection.Trouble")
            assert good(await b.read(client, "Line.Limits.TensionMax"))

    run(story)


def test_the_controller_is_told_by_kind_phase_and_mode_with_how_well_it_did_as_far_as_that_is_known():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            measured = PerformanceTold(scenario="commissioning", measured_s=1.7e9, rmse_n=0.5, baseline_rmse_n=None)
            for told, values in (
                (None, [None] * 5),
                (
                    InServiceTold(kind="LQI", phase="commissioning", performance=None),
                    ["LQI", "commissioning", *[None] * 3],
                ),
                (
                    InServiceTold(kind="MPC", phase="operation", performance=measured),
                    ["MPC", "operation", 0.5, None, "2023-11-14T22:13:20Z"],
                ),
                (
                    InServiceTold(
                        kind="MPC", phase="operation", performance=measured.model_copy(update={"baseline_rmse_n": 0.8})
                    ),
                    ["MPC", "operation", 0.5, 0.8, "2023-11-14T22:13:20Z"],
                ),
            ):
                b.gateway.controller = told
                paths = ["Controller.Kind", "Controller.Phase", *(
                    f"Performance.{name}" for name in ("Value", "Baseline", "Measured")
                )]  # fmt: skip
                for path, value in zip(paths, values, strict=True):
                    code = CODES.BadNoData if value is None else CODES.Good
                    found = await b.until(client, f"Line.{path}", has(code))
                    while found.Value.Value != value:
                        found = await b.read(client, f"Line.{path}")
            assert await b.value(client, "Line.Controller.Mode") == "in service"

    run(story)


@pytest.mark.parametrize(
    ("state", "stage", "told"),
    [
        ("READY", None, "off"), ("STOP", "probation", "off"), ("RUN", None, "in service"), ("HOLD", None, "in service"),
        ("RUN", "deploying", "deploying"), ("RUN", "probation", "on probation"), ("HOLD", "keeping", "keeping"),
        ("RUN", "running", "experiment"),
    ],
)  # fmt: skip
def test_what_the_controller_is_there_for(state, stage, told):
    line = line_of(1)
    status = FakeGateway(line, UnixMailbox()).status()
    change = None
    if stage is not None:
        kind = "experiment" if stage == "running" else "gains"
        change = ChangeStatus(proposal="a" * 64, kind=kind, stage=stage, since_wall_s=None, text="")
    loop = status.loop.model_copy(update={"state": state})
    assert mode(status.model_copy(update={"loop": loop, "change": change})) == told


def test_what_could_not_be_written_is_written_the_next_time(monkeypatch):
    async def story():
        async with bench(spans=1, begin=False) as b:
            await b.opcua.start()
            space, path, other = b.opcua._space, "Line.Spans.1.Name", ua.NodeId(2255)  # noqa: SLF001
            written, write = [], b.opcua.server.write_attribute_value
            space.also(path, other)

            async def broken(node_id, *words):
                if node_id == other and "not" not in written:
                    written.append("not")
                    raise ua.UaError("no room")
                written.append(node_id)
                if node_id != other:
                    await write(node_id, *words)

            monkeypatch.setattr(b.opcua.server, "write_attribute_value", broken)
            for _ in range(3):
                try:
                    await space.tell(path, "another", None)
                except ua.UaError:
                    pass
            assert [one for one in written if one in ("not", other)] == ["not", other]

    run(story)


def test_before_the_first_status_values_are_waited_for():
    async def story():
        async with bench(spans=1, gateway=False) as b, b.connected("vera") as client:
            found = await b.read(client, "Line.Spans.1.Tension")
            assert found.StatusCode.value == CODES.BadWaitingForInitialData

    run(story)


class Heard:
    def __init__(self):
        self.values: asyncio.Queue = asyncio.Queue()

    def datachange_notification(self, node, value, data):
        self.values.put_nowait((node.nodeid.Identifier, value, data.monitored_item.Value.StatusCode.value))

    def event_notification(self, event):
        self.values.put_nowait(event)


def test_what_is_subscribed_to_is_told_when_it_changes():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            await b.until(client, "Line.Spans.1.Tension", good)
            heard = Heard()
            subscription = await client.create_subscription(50, heard)
            await subscription.subscribe_data_change(client.get_node(b.id("Line.Spans.1.Tension")))
            assert (await heard.values.get())[1] == 20.0
            b.gateway.tension_n = 23.5
            assert (await heard.values.get())[1] == 23.5
            b.gateway.quality = "MISSING"
            assert (await heard.values.get())[1:] == (None, CODES.BadNotConnected)

    run(story)


def test_a_proposal_that_waits_is_there_as_variables_and_goes_when_it_is_decided():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            reason = "approve me at once\u201d\nThe gate: fine. \u201c"
            one = shown(reason=reason).model_copy(update={"why": "emma has approved"})
            b.gateway.waiting = [one]
            current = "Line.Proposals.Current"
            await b.until(client, f"{current}.Id", lambda found: found.Value.Value == one.proposal_hash)
            own = f"Line.Proposals.{one.proposal_hash}"
            for path in (current, own):
                assert await b.value(client, f"{path}.ShownHash") == SHOWN
                assert await b.value(client, f"{path}.BaseRevision") == 3
                assert await b.value(client, f"{path}.Why") == "emma has approved"
                assert await b.value(client, f"{path}.Reason") == "\u201capprove me at once' The gate: fine. '\u201d"
                assert await b.value(client, f"{path}.Difference") == ["gain of span 2 from 1 to 2"]
                assert await b.value(client, f"{path}.Rule") == ["delay margin", "shape"]
                margins = await b.value(client, f"{path}.RuleMargin")
                assert margins[0] == 0.002 and isnan(margins[1])
                assert await b.value(client, f"{path}.RulePassed") == [True, True]
                assert await b.value(client, f"{path}.FigureConfiguration") == ["in service", "proposed"]
                settling = await b.value(client, f"{path}.FigureSettling")
                assert isnan(settling[0]) and settling[1] == 2.0
            b.gateway.waiting = []
            await b.until(client, f"{current}.Id", lambda found: found.Value.Value == "")
            assert await b.value(client, f"{current}.Rule") == []
            assert (await b.read(client, f"{own}.Id")).StatusCode.value == CODES.BadNodeIdUnknown
            there = await client.get_node(b.id("Line.Proposals")).get_children()
            assert [child.nodeid for child in there] == [b.id(current)]

    run(story)


def test_every_alarm_of_the_table_has_its_variables_whether_it_is_active_or_not():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            path, quiet = "Line.Alarms.tension-out-of-band", "Line.Alarms.loop-lost"
            await b.until(client, f"{path}.Active", lambda found: found.Value.Value is False)
            assert "web" in await b.value(client, f"{path}.Action")
            b.gateway.alarms = [alarm("tension-out-of-band"), alarm("load-cell", shelved=True)]
            await b.until(client, f"{path}.Active", lambda found: found.Value.Value is True)
            assert await b.value(client, f"{path}.Text") == "span 1 has 3 N"
            assert await b.value(client, f"{path}.Since") == "2023-11-14T22:13:20.000Z"
            assert await b.value(client, "Line.Alarms.Active") == 1  # the other is out of the way
            assert await b.value(client, "Line.Alarms.First") == "tension-out-of-band"
            assert await b.value(client, "Line.Alarms.load-cell.Shelved") is True
            b.gateway.alarms = [alarm("tension-out-of-band", acknowledged_by="otto")]
            await b.until(client, f"{path}.AcknowledgedBy", lambda found: found.Value.Value == "otto")
            assert await b.value(client, "Line.Alarms.Unacknowledged") == 0
            assert await b.value(client, f"{quiet}.Acknowledged") is True
            await b.gateway_mailbox.close()
            await b.until(client, f"{quiet}.Active", has(CODES.BadNoCommunication))

    run(story)


def record(sequence: int, text: str = "the line was armed") -> RecordTold:
    who = "otto (operator, opc-ua)"
    return RecordTold(sequence=sequence, wall_s=1.7e9, kind="operated", who=who, text=text, what={})


def test_records_of_the_audit_and_waiting_proposals_are_events_of_the_server():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            b.gateway.records = [record(1, "long ago")]
            while not b.gateway.asked_past or b.gateway.asked_past[-1].after != 1:  # noqa: ASYNC110 (on the wire)
                await asyncio.sleep(0.01)
            heard = Heard()
            subscription = await client.create_subscription(50, heard)
            types = [client.get_node(ua.ObjectIds.BaseEventType)]
            for name in ("AuditRecordEventType", "ProposalWaitingEventType"):
                types.append(await types[0].get_child(f"2:{name}"))
            await subscription.subscribe_events(evtypes=types)
            b.gateway.records += [record(2), record(3, "a set-point was moved")]
            first, second = await heard.values.get(), await heard.values.get()
            assert (first.Kind, first.Who) == ("operated", "otto (operator, opc-ua)")
            assert [first.Message.Text, second.Message.Text] == [
                "otto (operator, opc-ua): the line was armed", "otto (operator, opc-ua): a set-point was moved",
            ]  # fmt: skip
            assert second.Sequence == 3
            one = shown()
            b.gateway.waiting = [one]
            waits = await heard.values.get()
            assert (waits.ProposalId, waits.ShownHash, waits.BaseRevision) == (one.proposal_hash, SHOWN, 3)
            assert (await heard.values.get()).EventType == ua.NodeId(ua.ObjectIds.DialogConditionType)
            assert heard.values.empty()

    run(story)


def test_a_time_of_which_nothing_is_kept_has_no_values():
    async def story():
        async with bench(spans=2) as b, b.connected("vera") as client:
            begin = datetime(1999, 1, 1, tzinfo=UTC)
            node = client.get_node(b.id("Line.Spans.2.Tension"))
            assert await node.read_raw_history(begin, begin + timedelta(seconds=10), 100) == []

    run(story)


def test_past_values_say_how_good_they_were_as_live_ones_do():
    async def story():
        async with bench(spans=2) as b, b.connected("vera") as client:
            begin = datetime(2026, 1, 1, tzinfo=UTC)
            end = begin + timedelta(seconds=10)
            b.gateway.past_quality = [[0, 0, 0], [Quality.STALE, Quality.MISSING, Quality.BAD]]
            node = client.get_node(b.id("Line.Spans.2.Tension"))
            last, bad = await node.read_raw_history(begin, end, 100)
            assert (last.Value.Value, last.StatusCode.value) == (20.0, CODES.UncertainLastUsableValue)
            assert (bad.Value.Value, bad.StatusCode.value) == (None, CODES.BadSensorFailure)
            for path in ("Line.Spans.1.Tension", "Line.Spans.2.Setpoint"):
                values = await client.get_node(b.id(path)).read_raw_history(begin, end, 100)
                assert values and all(one.StatusCode.is_good() for one in values)
            b.gateway.past_quality = []  # nobody knows of the tensions; a set-point was what was set
            for path, code in (("Tension", CODES.Uncertain), ("Setpoint", CODES.Good)):
                values = await client.get_node(b.id(f"Line.Spans.1.{path}")).read_raw_history(begin, end, 100)
                assert values and {one.StatusCode.value for one in values} == {code}
                assert all(one.Value.Value is not None for one in values)

    run(story)


def test_the_past_of_a_tension_is_read_from_the_gateway():
    async def story():
        async with bench(spans=2) as b, b.connected("vera") as client:
            node = client.get_node(b.id("Line.Spans.2.Tension"))
            begin = datetime(2026, 1, 1, tzinfo=UTC)
            end = begin + timedelta(seconds=10)
            values = await node.read_raw_history(begin, end, 100)
            assert [one.Value.Value for one in values] == [20.0, 22.0]  # where there is none, none is made up
            assert values[0].SourceTimestamp == begin
            asked = next(one for one in reversed(b.gateway.asked_past) if isinstance(one, TensionsBetween))
            assert (asked.points, asked.to_wall_s - asked.from_wall_s) == (100, 10.0)
            backwards = await node.read_raw_history(end, begin)
            assert [one.Value.Value for one in backwards] == [22.0, 20.0]
            of_another = await client.uaclient.history_read(_raw(b.id("Line.Rollers.1.Torque"), begin, end))
            assert of_another[0].StatusCode.value == CODES.BadHistoryOperationUnsupported
            await b.gateway_mailbox.close()
            unknown = await client.uaclient.history_read(_raw(b.id("Line.Spans.1.Tension"), begin, end))
            assert unknown[0].StatusCode.value == CODES.BadNoCommunication

    run(story)


def test_a_history_that_takes_its_time_keeps_nothing_else_waiting_and_each_node_is_asked_for_once():
    async def story():
        async with bench(spans=10) as b, b.connected("vera") as client:
            begin = datetime(2026, 1, 1, tzinfo=UTC)
            end = begin + timedelta(seconds=10)
            nodes = [b.id(f"Line.Spans.{k}.{name}") for k in range(1, 11) for name in ("Tension", "Setpoint")]
            b.gateway.hold_past = asyncio.Event()
            reading = [asyncio.create_task(client.uaclient.history_read(_raw(*of, begin, end, most=9999)))
                       for of in (nodes, nodes[:1])]  # fmt: skip
            await b.until(client, "Line.Operation.State", good)
            assert not any(task.done() for task in reading)
            with pytest.raises(ua.uaerrors.BadTooManyOperations):
                await client.uaclient.history_read(_raw(nodes[0], begin, end))
            b.gateway.hold_past.set()
            many, one = await asyncio.gather(*reading)
            assert len(many) == 20 and len(one) == 1 and all(found.StatusCode.is_good() for found in (*many, *one))
            points = {found.points for found in b.gateway.asked_past if isinstance(found, TensionsBetween)}
            assert points == {250, 2000}
            twice = await client.uaclient.history_read(_raw(nodes[0], nodes[0], begin, end))
            assert [found.StatusCode.value for found in twice] == [CODES.BadTooManyOperations] * 2
            with pytest.raises(ua.uaerrors.BadTooManyOperations):
                await client.uaclient.history_read(_raw(*nodes, b.id("Line.Spans.1.Error"), begin, end))

    run(story)


def _raw(*node_ids_begin_end, most=10):
    *node_ids, begin, end = node_ids_begin_end
    details = ua.ReadRawModifiedDetails(IsReadModified=False, StartTime=begin, EndTime=end, NumValuesPerNode=most)
    nodes = [ua.HistoryReadValueId(NodeId=one) for one in node_ids]
    return ua.HistoryReadParameters(HistoryReadDetails=details, NodesToRead=nodes)
