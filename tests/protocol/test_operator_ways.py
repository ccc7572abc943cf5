"""The ways in to the operator's process: what is shut is tried again, and told once."""

import asyncio
import socket

import pytest
from asyncua import Client, ua

from gateway.operator import ways
from gateway.operator.opcua import service
from gateway.operator.opcua.server import CannotServe
from gateway.operator.page.serve import CannotServe as PageCannotServe
from gateway.operator.ways import Way
from tests.protocol.operator_support import bench, shown
from tests.protocol.test_operator_nodes import record
from tests.protocol.test_operator_security import run


@pytest.mark.parametrize("error", [CannotServe, PageCannotServe])
def test_a_way_that_is_shut_is_tried_again_until_it_is_open_and_told_once(monkeypatch, error):
    monkeypatch.setattr(ways, "AGAIN_S", 0.0)
    told: list[str] = []

    async def story():
        left, serving = [5], asyncio.Event()

        async def begin():
            left[0] -= 1
            if left[0] >= 0:
                raise error("the port is taken" if left[0] else "another one")

        async def serve():
            serving.set()
            await asyncio.Event().wait()

        way = Way("page", begin, serve, told.append)
        assert not await way.open() and way.trouble == "the port is taken"
        keeping = asyncio.create_task(way.keep())
        await serving.wait()
        assert way.trouble == "" and not keeping.done()
        keeping.cancel()
        await asyncio.gather(keeping, return_exceptions=True)

    run(story)
    assert [text.partition(":")[2].strip() or text for text in told] == ["the port is taken", "another one", "page now"]


def test_a_way_that_shuts_while_it_serves_is_opened_again(monkeypatch):
    monkeypatch.setattr(ways, "AGAIN_S", 0.0)

    async def story():
        served = [0]
        again = asyncio.Event()

        async def begin():
            pass

        async def serve():
            served[0] += 1
            if served[0] == 1:
                raise PageCannotServe("its certificate is damaged")
            again.set()
            await asyncio.Event().wait()

        way = Way("page", begin, serve, lambda _: None)
        assert await way.open()
        keeping = asyncio.create_task(way.keep())
        await again.wait()
        keeping.cancel()
        await asyncio.gather(keeping, return_exceptions=True)

    run(story)


def test_the_server_listens_once_its_port_is_free_and_tells_of_a_page_that_is_not():
    async def story():
        with socket.socket() as holder:
            holder.bind(("127.0.0.1", 0))
            holder.listen()
            port = holder.getsockname()[1]
            async with bench(spans=1, begin=False, opc_ua=f"opc.tcp://127.0.0.1:{port}") as b:
                for _ in range(2):
                    with pytest.raises(CannotServe, match="cannot listen"):
                        await b.opcua.start()
                holder.close()
                await b.opcua.start()
                assert await Client(b.url).connect_and_get_server_endpoints()
                running = asyncio.create_task(b.opcua.run())
                async with b.connected("vera") as client:
                    for trouble in ("", "the port is taken"):
                        b.opcua.page_trouble = lambda trouble=trouble: trouble
                        path = "Line.Connection.PageTrouble"
                        await b.until(client, path, lambda one, trouble=trouble: one.Value.Value == trouble)
                running.cancel()
                await asyncio.gather(running, return_exceptions=True)

    run(story)


def test_nodes_are_made_once_and_before_the_certificate_is_there(monkeypatch):
    """They take a second, in which nobody could stop the line, if they came when the page is served already."""

    async def story():
        async with bench(spans=1, begin=False) as b:
            made = []
            make = b.opcua._make  # noqa: SLF001

            async def counted():
                made.append("once")
                await make()

            monkeypatch.setattr(b.opcua, "_make", counted)
            (b.pki / "opcua-server.pem").rename(b.pki / "later.pem")
            for _ in range(2):
                with pytest.raises(CannotServe, match="pki init"):
                    await b.opcua.start()
                assert made == ["once"]
            (b.pki / "later.pem").rename(b.pki / "opcua-server.pem")
            await b.opcua.start()
            assert made == ["once"]
            async with b.connected("vera") as client:
                uris = [(await client.get_namespace_array())[1], await client.get_node(ua.NodeId(2254)).read_value()]
                assert uris == ["urn:r2rgate:test:line", ["urn:r2rgate:test:line"]]

    run(story)


def test_a_fault_of_this_program_ends_nothing_is_told_once_and_what_it_hides_does_not_look_true(monkeypatch):
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:

            def good(found):
                return found.StatusCode.is_good()

            def bad(found):
                return found.StatusCode.is_bad()

            b.gateway.waiting = [shown()]
            await b.until(client, "Line.Proposals.Current.Id", lambda one: good(one) and one.Value.Value)
            await b.until(client, "Line.Spans.1.Tension", good)
            with monkeypatch.context() as broken:
                broken.setattr(service, "of_status", lambda _: 1 / 0)
                broken.setattr(b.opcua._proposals, "show", lambda _: 1 / 0)  # noqa: SLF001
                broken.setattr(b.opcua._events, "_tell", lambda _: 1 / 0)  # noqa: SLF001
                b.gateway.records = [record(1), record(2)]
                await b.until(client, "Line.Spans.1.Tension", bad)
                assert (await b.value(client, "Line.Connection.Trouble")).startswith(
                    "the line cannot be shown: ZeroDiv"
                )
                assert await b.value(client, "Line.Connection.Fresh") is False
                await b.until(client, "Line.Proposals.Current.Id", bad)
                while b.opcua._events._after != 2:  # noqa: ASYNC110, SLF001
                    await asyncio.sleep(0.01)
            await b.until(client, "Line.Spans.1.Tension", good)
            await b.until(client, "Line.Connection.Fresh", lambda one: one.Value.Value)
            assert await b.value(client, "Line.Connection.Trouble") == ""
            await b.until(client, "Line.Proposals.Current.Id", lambda one: good(one) and one.Value.Value)
            assert set(b.said) == {"OPC UA does not tell all: ZeroDivisionError: division by zero"}
            assert len(b.said) <= 3 + 1  # by each task once, and again after it had gone well in between

    run(story)
