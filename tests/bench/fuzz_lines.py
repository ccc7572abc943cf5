"""Lines for the fuzz targets: every role on one wire, as in `lines`."""

from functools import cache

from gateway.cli.line_commands import known_maps
from gateway.core.line import Line
from gateway.core.line_file import load_line
from tests.bench.lines import WIRINGS, Ports, line_text

RATED_NM, CAPACITY_N = 60.0, 100.0  #: of `lines`


@cache
def lines(wiring: str) -> Line:
    """The line of a wiring of `lines.WIRINGS`. Its ports are never opened."""
    return load_line(line_text(WIRINGS[wiring], 0.01, Ports(43113, 5020, 4840)), "line.toml", known_maps())
