"""Proposals as nodes: which one is current, what is told of one that goes, and of what is not known."""

from asyncua import ua

from tests.protocol.operator_support import bench, shown
from tests.protocol.test_operator_nodes import Heard, good, has, run

CODES = ua.StatusCodes


def test_the_current_proposal_stays_while_it_waits_unchanged_and_then_it_is_the_newest():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            old, new, newer = shown(reason="the first"), shown(reason="the second"), shown(reason="the third")
            path = "Line.Proposals.Current"
            b.gateway.waiting = [old]
            await b.until(client, f"{path}.Id", lambda found: found.Value.Value == old.proposal_hash)
            b.gateway.waiting = [new, old]
            await b.until(client, f"Line.Proposals.{new.proposal_hash}.Id", good)
            assert await b.value(client, f"{path}.Id") == old.proposal_hash
            anew = old.model_copy(update={"shown": "6" * 64, "why": "emma has approved"})
            b.gateway.waiting = [new, anew, shown(reason="to be listed anew")]  # shown anew: the newest is looked at
            await b.until(client, f"{path}.Id", lambda found: found.Value.Value == new.proposal_hash)
            b.gateway.waiting = [newer, anew]
            await b.until(client, f"{path}.Id", lambda found: found.Value.Value == newer.proposal_hash)

    run(story)


def test_who_watches_a_proposal_is_told_that_it_waits_no_more():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            one = shown()
            b.gateway.waiting = [one]
            path = f"Line.Proposals.{one.proposal_hash}.Stage"
            await b.until(client, path, good)
            heard = Heard()
            subscription = await client.create_subscription(50, heard)
            await subscription.subscribe_data_change(client.get_node(b.id(path)))
            assert (await heard.values.get())[1] == "waiting"
            b.gateway.waiting = []
            assert (await heard.values.get())[1:] == (None, CODES.BadNoData)

    run(story)


def test_a_proposal_that_cannot_be_shown_hides_no_other():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            whole, broken = shown(reason="the first"), shown(reason="the second")
            b.gateway.waiting, b.gateway.hidden = [broken, whole], {broken.proposal_hash}
            path = "Line.Proposals.Current.Id"
            await b.until(client, path, lambda found: found.Value.Value == whole.proposal_hash)
            b.gateway.hidden = {broken.proposal_hash, whole.proposal_hash}  # it has been told; now another is not
            b.gateway.waiting = [broken]
            await b.until(client, path, has(CODES.BadNoCommunication))  # not "none waits"
            b.gateway.hidden = set()
            await b.until(client, path, lambda found: found.Value.Value == broken.proposal_hash)

    run(story)


def test_proposals_are_unsure_when_their_list_is_old_though_the_status_is_new():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            b.gateway.waiting = [shown()]
            paths = ("Line.Proposals.Current.Id", "Line.Controller.InService", "Line.Controller.Revision")
            for path in paths:
                await b.until(client, path, good)
            b.gateway.lists = False
            for path in paths:
                assert (await b.until(client, path, has(CODES.BadNoCommunication))).Value.Value is None
            assert good(await b.read(client, "Line.Spans.1.Tension"))
            b.gateway.lists = True
            for path in paths:
                await b.until(client, path, good)

    run(story)
