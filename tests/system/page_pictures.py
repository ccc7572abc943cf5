"""`python -m tests.system.page_pictures [FOLDER]`: pictures of the page, before a simulated line with its processes.

They are written to docs/img, in few colours, and are to be looked at. It takes some minutes: what they show happens.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

from tests.system.page_line import AtPage, PageLine

FOLDER = Path("docs/img")
SPANS, COLOURS = 6, 48
TREND_S = 60.0  #: of a run, so that its course can be seen
SETTLES_S = 1.5  #: so that nothing is half drawn
JUDGED_S, KEPT_S = 240.0, 120.0
FAULT = "load-cell 3 nan for 60"
REASON = "An LQG in place of the LQI in service: its observer takes the noise of the load cells out of the torques."
APPROVE, YES = "[data-focus=approve]", "dialog[open] button.main"


def pictures(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="r2r-") as work, PageLine(Path(work), spans=SPANS) as line:
        line.run()
        line.operate()
        with AtPage(Path(work) / "browser.log") as at:
            _in_order(line, at, folder)
            _out_of_order(line, at, folder)


def _in_order(line: PageLine, at: AtPage, folder: Path) -> None:
    at.open(line.page, width=1280, height=1500)
    at.log_in("operator")
    time.sleep(TREND_S)
    _picture(at, folder / "page-line.png")
    at.part("health")
    at("see", "#view-health h2")
    at("size", 1280, 860)
    _picture(at, folder / "page-condition.png")
    proposal = line.propose(line.other, REASON)
    line.until(proposal, "waiting", JUDGED_S)
    at.part("change")
    at("see", ".course canvas")
    at("size", 1280, 1700)
    _picture(at, folder / "page-change.png")
    at("click", APPROVE)
    at("fill", "#ask-comment", "looks well")
    at("click", YES)
    at("see", "#change-body", "On probation")
    line.until(proposal, "kept", KEPT_S)
    at.part("history")
    at("see", "#view-history tbody tr:first-child", "Kept")
    at("click", "#reply button")
    at("size", 1280, 640)
    _picture(at, folder / "page-history.png")


def _out_of_order(line: PageLine, at: AtPage, folder: Path) -> None:
    """The line stops itself."""
    words = [sys.executable, "-m", "gateway.cli", "fault", "inject", FAULT, "--control", str(line.folder / "recording")]
    subprocess.run(words, check=True, timeout=60)
    at("see", "#now-state", "stopped")
    at.open(line.page, "de", width=820, height=1180)
    at.log_in("operator")
    at("see", "#alarm-list .high")
    _picture(at, folder / "page-tablet-de.png")


def _picture(at: AtPage, path: Path) -> None:
    time.sleep(SETTLES_S)
    at("picture", str(path), False)
    with Image.open(path) as taken:
        few = taken.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    few.save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    pictures(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
