"""The page before a real gateway process: what a person says there stands in the audit under their name."""

import asyncio
import json
import time
from pathlib import Path

import httpx
import pytest

from gateway.mailbox.unix import UnixMailbox
from gateway.operator.line_side import TOPICS, LineSide
from gateway.operator.page.app import page_app
from gateway.operator.page.login import TOKEN_HEADER
from gateway.operator.page.tick import tick_of
from tests.operator.fake_line import PASSWORD, check, role_of
from tests.unit.page_support import HERE
from tests.unit.supervisor_support import line_of, until
from tests.unit.test_line_side import told
from tests.unit.test_supervisor_process import gateway, run


@pytest.mark.wires
def test_what_is_said_through_the_page_is_recorded_and_told_there_again() -> None:
    async def story(folder: Path) -> None:
        with gateway(folder):
            mailbox = UnixMailbox()
            mailbox.connect(TOPICS, folder / "gateway.sock")
            side = LineSide(mailbox)
            watching = asyncio.create_task(side.watch())
            await until(lambda: side.status is not None and side.proposals is not None)
            await told(side, "gateway-start")
            assert side.status is not None
            tick = json.loads(json.dumps(tick_of(side.status, side.proposals, 1), allow_nan=False))
            assert tick["loop"]["running"] is False and tick["waiting"] == []
            transport = httpx.ASGITransport(page_app(line_of(6), side, check, role_of, time.monotonic))
            async with httpx.AsyncClient(transport=transport, base_url=HERE, headers={"origin": HERE}) as browser:
                entered = await browser.post("/api/login", json={"name": "operator", "password": PASSWORD})
                browser.headers[TOKEN_HEADER] = entered.json()["token"]
                shelve = {"command": "shelve", "alarm": "cycles-late", "for_s": 600.0, "because": "a trial"}
                assert (await browser.post("/api/say", json=shelve)).json()["ok"]
                stopped = await browser.post("/api/say", json={"command": "stop"})
                assert stopped.status_code == 409 and "loop not running" in stopped.json()["text"]
                records = (await browser.get("/api/records")).json()["records"]
                assert [one["kind"] for one in records[-2:]] == ["shelved", "operated"]
                assert records[-2]["text"].startswith("operator (operator, page) shelves alarm cycles-late")
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)
            await mailbox.close()

    run(story)
