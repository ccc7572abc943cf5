"""What the map of the line's PLC has no signal for, and what the line does without it: warnings of `check`."""

from collections.abc import Iterator

from drivers.device_map import MAPS, load_map
from gateway.core.line import Line
from gateway.core.line_problem import Problem, value_in_words
from gateway.core.toml_places import places


def missing_plc_signals(text: str, source: str, line: Line) -> list[Problem]:
    """A warning for each optional signal that the PLC's map lacks. `text` is the line's file, which is valid."""
    at = places(text.removeprefix("\ufeff").replace("\r\n", "\n")).get(("plc", "map"), 1)
    value = value_in_words(line.plc.map)
    return [Problem(source, at, "plc.map", value, wrong) for wrong in _missing(line)]


def _missing(line: Line) -> Iterator[str]:
    device = load_map(MAPS / f"{line.plc.map}.toml")
    if device.role != "line-plc":
        return
    if device.write.warning is None:
        yield (
            f"the map has no warning output (write.warning): a start waits {line.stages.start_warning_s:g} s "
            "(stages.start_warning_s), and nobody near the line is warned"
        )
    if device.read.local is None:
        yield "the map has no local signal (read.local): the line can be started while somebody works at it"
