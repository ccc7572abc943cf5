"""The page in Chromium, in figures: how old what it shows is, how soon something and how soon the line is seen, weight.

`python -m tests.bench.operator_page [SECONDS]` measures them on a simulated line with all its processes, and prints
them; `make bench-operator` has them among its own.
"""

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.operator.names import PASSWORD
from tests.system.page_line import AtPage, PageLine

SECONDS, PAINTS, SPANS = 30.0, 5, 6


@dataclass(frozen=True)
class PageFigures:
    """Age: of what is in the document, by the loop's own time, ten times a second, whether anything new came or not."""

    age_p50_s: float
    age_p95_s: float
    age_max_s: float
    looks: int
    first_paint_s: float  #: of the login; the middle of `paints`, each in a browser that knows nothing of the page
    line_seen_s: float  #: the middle of as many: from name and password to the line itself
    paints: int
    bytes: int  #: as they come over the network, until the line is seen


def page_figures(page: str, name: str, password: str, log: Path, seconds: float = SECONDS) -> PageFigures:
    """Of the page at this address, as a user who may look. `log`: a file for what the browser says.

    Raises PeerFailed where the browser cannot be started, or the page does not come.
    """
    paints_s: list[float] = []
    seen_s: list[float] = []
    with AtPage(log) as at:
        for _ in range(PAINTS):
            at.open(page)
            at("see", "#login")
            paints_s.append(at("first_paint_s"))
            at.fill_in(name, password)
            seen_s.append(at("enter_s"))
        weight = at("bytes")
        ages_s = at("ages", seconds)
    p50_s, p95_s, max_s = np.percentile(ages_s, [50.0, 95.0, 100.0]).tolist()
    first_s, line_s = float(np.median(paints_s)), float(np.median(seen_s))
    return PageFigures(p50_s, p95_s, max_s, len(ages_s), first_s, line_s, PAINTS, weight)


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else SECONDS
    with tempfile.TemporaryDirectory() as folder, PageLine(Path(folder), spans=SPANS) as line:
        line.run()
        line.operate()
        found = page_figures(line.page, "viewer", PASSWORD, Path(folder) / "browser.log", seconds)
    print(f"age of what the page shows: {1e3 * found.age_p50_s:.0f} ms at the median, {1e3 * found.age_p95_s:.0f} ms "
          f"p95, {1e3 * found.age_max_s:.0f} ms at most, of {found.looks} looks")  # fmt: skip
    print(f"first paint: {1e3 * found.first_paint_s:.0f} ms, the line after login: {1e3 * found.line_seen_s:.0f} ms, "
          f"of {found.paints}; weight: {found.bytes / 1e3:.0f} kB")  # fmt: skip


if __name__ == "__main__":
    main()
