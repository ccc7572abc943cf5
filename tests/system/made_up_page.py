"""A page before a gateway that is none, for what no real line shows when it is wanted."""

import asyncio
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from gateway.mailbox.unix import UnixMailbox
from gateway.operator.line_side import TOPICS, LineSide
from gateway.operator.page.app import page_app
from gateway.operator.page.serve import serve_page
from tests.operator.fake_line import FakeGateway, check, role_of
from tests.support.ports import free_port
from tests.unit.supervisor_support import line_of, short_folder

BEGINS_S = 30.0


@contextmanager
def made_up_page(spans: int) -> Iterator[tuple[str, FakeGateway]]:
    """Its address, and the gateway, whose attributes may be set at any time. It is served by a thread."""
    line = line_of(spans)
    address = f"http://127.0.0.1:{free_port()}"
    line = line.model_copy(update={"operator": line.operator.model_copy(update={"page": address})})
    with short_folder() as folder:
        served = UnixMailbox()
        gateway, loop, ready, stop = FakeGateway(line, served), asyncio.new_event_loop(), threading.Event(), []

        async def serve() -> None:
            asked = UnixMailbox()
            await served.listen(folder / "gateway.sock")
            asked.connect(TOPICS, folder / "gateway.sock")
            side = LineSide(asked)
            page = page_app(line, side, check, role_of, time.monotonic)
            tasks = [asyncio.create_task(side.watch()), asyncio.create_task(serve_page(page, address))]
            stop.extend(tasks)
            ready.set()
            await asyncio.gather(*tasks, return_exceptions=True)
            await asyncio.gather(asked.close(), served.close())

        thread = threading.Thread(target=lambda: loop.run_until_complete(serve()))
        thread.start()
        try:
            assert ready.wait(BEGINS_S)
            yield address, gateway
        finally:
            for task in stop:
                loop.call_soon_threadsafe(task.cancel)
            thread.join()
            loop.close()
