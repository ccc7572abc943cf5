"""What others have tried at the loop: told for a while, and noise of one kind hides nothing of another."""

import asyncio

from gateway.core.finding import finding
from gateway.core.messages import Event
from gateway.supervisor.intrusions import MOST_SHOWN, SHOWN_S, Intrusions
from gateway.supervisor.loop_records import LoopRecords


def test_however_many_are_refused_at_the_door_what_was_set_aside_is_told_first_until_its_time_is_over() -> None:
    now_s, recorded = 0.0, []

    async def append(kind: str, *_: object) -> None:
        recorded.append(kind)

    async def story() -> None:
        nonlocal now_s
        records = LoopRecords(append, print, lambda: now_s)
        told = Intrusions(records, lambda: now_s)
        aside = finding("configuration-unproven", configuration="c0ffee")
        told.hear(Event(time_s=0.0, kind="configuration-set-aside", text="", findings=[aside]))
        for pid in range(10 * MOST_SHOWN):
            one = finding("no-proof", command=f"arm {pid}")
            told.hear(Event(time_s=0.0, kind="refused-at-the-door", text="", findings=[one]))
        found = told.recent()
        assert found[0] == aside and len(found) == 1 + MOST_SHOWN
        assert found[-1].parameters["command"] == f"arm {10 * MOST_SHOWN - 1}"
        now_s = 1.01 * SHOWN_S
        assert not told.recent()
        await records.close()
        assert "set-aside" in recorded

    asyncio.run(story())
