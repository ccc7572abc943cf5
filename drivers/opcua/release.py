"""Leaving drives in order: first torque off, then a look whether it is, and only then the end of their supervision."""

import asyncio
from collections.abc import Sequence
from itertools import islice

from drivers.opcua.drive import Axis
from drivers.opcua.nodes import Reading
from drivers.opcua.prepare import Ask, NoAnswer
from drivers.opcua.status import BAD_TRANSACTION_FAILED, describe, is_done

_PATIENCE = 0.5  #: share of the watchdog time that an axis has to take its torque off, before it is left to it
_LOOKS = 5  #: in that time

Writes = list[tuple[int, float]]  #: places and numbers


async def release_axes(ask: Ask, axes: Sequence[Axis]) -> list[str]:
    """Tell `axes` to take torque off, look whether they have, and end the supervision of those.

    The watchdog of any other is left as it is: it is not fed any more and takes torque off. So are all of them after
    a reconnection: the server may be another, which never took the last command. What went wrong, by name.
    """
    try:
        heard, connection, troubles = await _tell_off(ask, list(axes))
        on = {axis: why for axis, reading in heard.items() if (why := axis.against_off(reading))}
        pause_s = _PATIENCE / _LOOKS * min((axis.watchdog.time_s for axis in axes), default=0.0)
        for _ in range(_LOOKS):
            if not on:
                break
            await asyncio.sleep(pause_s)
            look = await ask((), tuple(axis.statusword for axis in on), connection=connection)
            now = zip(on, look.readings, strict=True)
            on = {axis: why for axis, reading in now if (why := axis.against_off(reading))}
        troubles += [f"{axis.name}: {why}; it is left to its watchdog" for axis, why in on.items()]
        return troubles + await _end_supervision(ask, [axis for axis in heard if axis not in on], connection)
    except NoAnswer as error:
        return [f"the drives were not released, their watchdogs take torque off: {error}"]


async def _tell_off(ask: Ask, axes: list[Axis]) -> tuple[dict[Axis, Reading], int, list[str]]:
    """The statuswords after a last command, of those that took it, on which connection, and what the others said.

    Raises NoAnswer.

    A server may do nothing of a Write of which a part is refused: it is asked again without that part.
    """
    troubles: list[str] = []
    while axes:
        writes = [axis.farewell() for axis in axes]
        told = await ask(_flat(writes), ())
        refusals = _refusals(axes, writes, told.written)
        if not refusals:
            look = await ask((), tuple(axis.statusword for axis in axes), connection=told.connection)
            return dict(zip(axes, look.readings, strict=True)), told.connection, troubles
        for axis, status in refusals.items():
            why = f"its last command was refused ({describe(status)})"
            troubles.append(f"{axis.name}: {why}; it is left to its watchdog")
            axes.remove(axis)
    return {}, 0, troubles


async def _end_supervision(ask: Ask, axes: list[Axis], connection: int) -> list[str]:
    """The watchdogs off, so that none fires when nobody speaks any more, in one Write with a command, for drives that
    look at the setting then only. After that as before: they count from the next change of the life counter, which is
    far. What was refused. Raises NoAnswer."""
    if not axes:
        return []
    troubles: list[str] = []
    off = [[*axis.farewell(), (axis.watchdog.node, 0.0)] for axis in axes]
    as_before = [[(axis.watchdog.node, float(axis.watchdog.counts))] for axis in axes]
    for writes, wanted in ((off, "switched off"), (as_before, "set again")):
        answer = await ask(_flat(writes), (), connection=connection)
        for axis, status in _refusals(axes, writes, answer.written).items():
            troubles.append(f"{axis.name}: its watchdog cannot be {wanted}: {describe(status)}")
    return troubles


def _refusals(axes: Sequence[Axis], writes: Sequence[Writes], written: tuple[int, ...]) -> dict[Axis, int]:
    """Who is to blame, and the first StatusCode of each; everybody where nobody is. `writes` are those of `axes`."""
    all_refused: dict[Axis, int] = {}
    to_blame: dict[Axis, int] = {}
    statuses = iter(written)
    for axis, of_axis in zip(axes, writes, strict=True):
        for status in islice(statuses, len(of_axis)):
            if not is_done(status):
                all_refused.setdefault(axis, status)
                if status != BAD_TRANSACTION_FAILED:
                    to_blame.setdefault(axis, status)
    return to_blame or all_refused


def _flat(writes: Sequence[Writes]) -> tuple[tuple[int, float], ...]:
    return tuple(write for of_axis in writes for write in of_axis)
