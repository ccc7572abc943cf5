"""`python -m tests.system.page_pictures [FOLDER]`: pictures of the page, with a line and a gateway that are none.

They are written to docs/img, in few colours, and are to be looked at.
"""

import asyncio
import shutil
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

from gateway.mailbox.unix import UnixMailbox
from gateway.operator.line_side import TOPICS, LineSide
from gateway.operator.page.app import page_app
from gateway.operator.page.serve import serve_page
from tests.operator.fake_line import PASSWORD, FakeGateway, alarm, check, role_of
from tests.protocol.bus_support import free_port
from tests.system.page_line import AtPage
from tests.unit.supervisor_support import line_of

FOLDER = Path("docs/img")
SPANS, COLOURS = 6, 48
WAIT_S = 1.5  #: so that the last value of a trend is not the only one


async def pictures(folder: Path) -> None:
    line = line_of(SPANS)
    line = line.model_copy(
        update={"operator": line.operator.model_copy(update={"page": f"http://127.0.0.1:{free_port()}"})}
    )
    run = Path(tempfile.mkdtemp(prefix="r2r-"))
    served, asked = UnixMailbox(), UnixMailbox()
    gateway = FakeGateway(line, served)
    await served.listen(run / "gateway.sock")
    asked.connect(TOPICS, run / "gateway.sock")
    side = LineSide(asked)
    page = page_app(line, side, check, role_of, time.monotonic)
    tasks = [asyncio.create_task(side.watch()), asyncio.create_task(serve_page(page, line.operator.page))]
    try:
        await asyncio.to_thread(_taken, line.operator.page, gateway, folder, run / "browser.log")
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await asyncio.gather(asked.close(), served.close())
        shutil.rmtree(run)


def _taken(page: str, gateway: FakeGateway, folder: Path, log: Path) -> None:
    gateway.stage = "kept"
    with AtPage(log) as at:
        at.open(page, width=1280, height=1640)
        at.log_in("operator", PASSWORD)
        _picture(at, folder / "page-line.png")
        gateway.stage = "waiting"
        at("see", "#prompt")
        at.part("change")
        at("see", ".course canvas")
        at("size", 1280, 1700)
        _picture(at, folder / "page-change.png")
        gateway.approvals, gateway.first = 2, "anna"
        at.open(page, width=1280, height=860)
        at.log_in("operator", PASSWORD)
        at.part("change")
        at("click", "[data-focus=approve]")
        at("see", "dialog[open]")
        _picture(at, folder / "page-two-people.png")
        at("press", "Escape")
        at.part("history")
        at("see", "#view-history tbody")
        at("size", 1280, 620)
        _picture(at, folder / "page-history.png")
        gateway.alarms, gateway.absent = [alarm()], ["roller-3"]
        gateway.drives[2] = "ABSENT"
        at("see", "#now-alarms", "1")
        at.part("health")
        at("see", "#view-health", "roller-3")
        at("size", 1280, 720)
        _picture(at, folder / "page-condition.png")
        at.open(page, "de", width=820, height=1180)
        at.log_in("operator", PASSWORD)
        at("see", "#alarm-list .high")
        _picture(at, folder / "page-tablet-de.png")


def _picture(at: AtPage, path: Path) -> None:
    time.sleep(WAIT_S)
    path.parent.mkdir(parents=True, exist_ok=True)
    at("picture", str(path), False)
    with Image.open(path) as taken:
        few = taken.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    few.save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    asyncio.run(pictures(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER))
