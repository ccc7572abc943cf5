"""Whether a reading is new, by the source time stamp that the server gives with it. No I/O.

A server goes on answering for a device that it has lost: value and time stamp are then those of the last time. A map
may say that a server stamps the last change of a value instead (OPC 10000-4, 7.11.3 lets it): then, as without time
stamps, there is nothing to see here, and what is left are StatusCodes, sample counter and the echo of the life counter.
"""

from drivers.opcua.maps import SourceTimeKind

SAME_ALLOWED = 3  #: answers in a row with the same time stamp, after the first, until a reading counts as missed
STANDS_STILL = "its source time stamp stands still"


class SourceTime:
    """Of one node."""

    def __init__(self, kind: SourceTimeKind) -> None:
        self._watched = kind == "sample"
        self._last_us = 0
        self._same = 0

    def stands_still(self, source_us: int) -> bool:
        """Whether the reading with this time stamp, as answered now, is an old one. 0: there is no time stamp."""
        same = self._watched and source_us != 0 and source_us == self._last_us
        self._same = self._same + 1 if same else 0
        self._last_us = source_us
        return self._same >= SAME_ALLOWED
