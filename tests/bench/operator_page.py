"""The page in Chromium, in figures: how old what it shows is, how soon the first of it is seen, how much it weighs.

`python -m tests.bench.operator_page [SECONDS]` measures them on a simulated line with all its processes, and prints
them; `make bench-operator` has them among its own.
"""

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.system.page_line import PASSWORD, AtPage, PageLine

SECONDS, PAINTS, SPANS = 30.0, 5, 6


@dataclass(frozen=True)
class PageFigures:
    """Latency: from the loop's own time of a sample to its being in the document, over all that was shown."""

    latency_p50_s: float
    latency_p95_s: float
    latency_max_s: float
    shown: int  #: samples
    first_paint_s: float  #: the middle of `paints`, each in a browser that knows nothing of the page
    paints: int
    bytes: int  #: as they come over the network, until the line is seen


def page_figures(page: str, name: str, password: str, log: Path, seconds: float = SECONDS) -> PageFigures:
    """Of the page at this address, as a user who may look. `log`: a file for what the browser says.

    Raises PeerFailed where the browser cannot be started, or the page does not come.
    """
    paints_s: list[float] = []
    with AtPage(log) as at:
        for _ in range(PAINTS):
            at.open(page)
            at("see", "#login")
            paints_s.append(at("first_paint_s"))
        at.log_in(name, password)
        weight = at("bytes")
        latencies_s = at("latencies", seconds)
    p50_s, p95_s, max_s = np.percentile(latencies_s, [50.0, 95.0, 100.0]).tolist()
    return PageFigures(p50_s, p95_s, max_s, len(latencies_s), float(np.median(paints_s)), PAINTS, weight)


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else SECONDS
    with tempfile.TemporaryDirectory() as folder, PageLine(Path(folder), spans=SPANS) as line:
        line.run()
        line.start_operator()
        found = page_figures(line.page, "viewer", PASSWORD, Path(folder) / "browser.log", seconds)
    print(f"telemetry to page: {1e3 * found.latency_p50_s:.0f} ms at the median, {1e3 * found.latency_p95_s:.0f} ms "
          f"p95, {1e3 * found.latency_max_s:.0f} ms at most, of {found.shown} samples")  # fmt: skip
    print(f"first paint: {1e3 * found.first_paint_s:.0f} ms, of {found.paints}; weight: {found.bytes / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
