"""The past of tensions and their set-points, as the gateway has kept it: thinned out to what is asked for.

Of each stretch the least and the greatest stay, so that no peak is lost. There is no continuation point: whoever wants
more of a time asks for a shorter one.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from math import isfinite
from typing import Any

from asyncua import ua as asyncua_ua
from pydantic import ValidationError

from gateway.core.line import Line
from gateway.core.line_past import MOST_POINTS, TensionsBetween, TensionsTold
from gateway.core.signals import Quality
from gateway.operator.line_side import LineSide, NotTold
from gateway.operator.opcua.limits import MAX_HISTORY_POINTS
from gateway.operator.opcua.line_nodes import CODES, ROOT
from gateway.operator.opcua.space import DOUBLE, GOOD, UNCERTAIN, Space

POINTS = 600  #: where a client leaves open how many
OPEN_S = 3600.0  #: before or behind the one end that is told

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

Columns = Callable[[TensionsTold], Sequence[Sequence[Any]]]  #: by span


class History:
    """Takes the place of asyncua's HistoryManager, which keeps values itself."""

    def __init__(self, space: Space, line: Line, side: LineSide, wall_clock: Callable[[], float] = time.time) -> None:
        self._side = side
        self._wall_clock = wall_clock
        self._columns: Mapping[Any, tuple[int, Columns, Columns | None]] = {
            space.id(f"{ROOT}.Spans.{k + 1}.{name}"): (k, values, quality)
            for k in range(line.n)
            for name, values, quality in (
                ("Tension", lambda told: told.tension_n, lambda told: told.quality),
                ("Setpoint", lambda told: told.setpoint_n, None),
            )
        }

    async def init(self) -> None:
        """As asyncua asks for."""

    async def stop(self) -> None:
        """As asyncua asks for."""

    async def read_history(self, params: Any) -> list[Any]:
        details = params.HistoryReadDetails
        if not isinstance(details, ua.ReadRawModifiedDetails) or details.IsReadModified:
            return [_refused(ua.StatusCodes.BadHistoryOperationUnsupported)] * len(params.NodesToRead)
        nodes = [one.NodeId for one in params.NodesToRead]
        if len(set(nodes)) < len(nodes):
            return [_refused(ua.StatusCodes.BadTooManyOperations)] * len(nodes)
        known = [one in self._columns for one in nodes]
        if not any(known):
            return [_refused(ua.StatusCodes.BadHistoryOperationUnsupported)] * len(known)
        start_s, end_s = _seconds(details.StartTime), _seconds(details.EndTime)
        if start_s is None and end_s is None:
            return [_refused(ua.StatusCodes.BadInvalidTimestampArgument)] * len(known)
        backwards = start_s is None or (end_s is not None and start_s > end_s)
        most = min(int(details.NumValuesPerNode or 0) or POINTS, MOST_POINTS, MAX_HISTORY_POINTS // sum(known))
        try:
            told = await self._side.tensions(self._between(start_s, end_s, most))
        except (NotTold, ValidationError):
            return [_refused(ua.StatusCodes.BadNoCommunication)] * len(known)
        return [self._values(one, told, backwards, most) for one in nodes]

    def update_history(self, params: Any) -> list[Any]:
        raise ua.UaStatusCodeError(ua.StatusCodes.BadServiceUnsupported)

    def _between(self, start_s: float | None, end_s: float | None, most: int) -> TensionsBetween:
        ends = [one for one in (start_s, end_s) if one is not None]
        first = min(ends) if len(ends) == 2 or start_s is not None else ends[0] - OPEN_S
        last = max(ends) if len(ends) == 2 or start_s is None else min(ends[0] + OPEN_S, self._wall_clock())
        return TensionsBetween(from_wall_s=first, to_wall_s=max(first, last), points=max(most, 2))

    def _values(self, node_id: Any, told: TensionsTold, backwards: bool, most: int) -> Any:
        found = self._columns.get(node_id)
        if found is None:
            return _refused(ua.StatusCodes.BadHistoryOperationUnsupported)
        span, columns, qualities = found
        if span >= len(columns(told)):  # nothing is kept of that time, or of a line with fewer spans
            return ua.HistoryReadResult(
                StatusCode=ua.StatusCode(ua.StatusCodes.GoodNoData), HistoryData=ua.HistoryData()
            )
        codes = _codes(told, span, qualities)
        values = [
            _as_of(wall_s, value, code)
            for wall_s, value, code in zip(told.wall_s, columns(told)[span], codes, strict=True)
            if value is not None
        ]
        if backwards:
            values.reverse()
        held = ua.HistoryData()
        held.DataValues = values[:most]
        return ua.HistoryReadResult(HistoryData=held)


def _codes(told: TensionsTold, span: int, qualities: Columns | None) -> list[int]:
    """How good each value was. `qualities`: None for what was set, not measured; of unknown ones nobody can be sure."""
    if qualities is None:
        return [GOOD] * len(told.wall_s)
    if not qualities(told):
        return [UNCERTAIN] * len(told.wall_s)
    return [CODES[Quality(one).name] for one in qualities(told)[span]]


def _as_of(wall_s: float, value: float, code: int) -> Any:
    """As it was told at that time: what is bad has no value."""
    held = ua.Variant(None) if ua.StatusCode(code).is_bad() else ua.Variant(value, DOUBLE)
    return ua.DataValue(held, SourceTimestamp=datetime.fromtimestamp(wall_s, UTC), StatusCode=ua.StatusCode(code))


def _refused(code: int) -> Any:
    return ua.HistoryReadResult(StatusCode=ua.StatusCode(code))


def _seconds(when: datetime | None) -> float | None:
    """Unix time; None where it is left open, for which OPC UA sends its earliest time."""
    if when is None or when.year <= 1601:
        return None
    seconds = when.replace(tzinfo=when.tzinfo or UTC).timestamp()
    return seconds if isfinite(seconds) else None
