"""What each wire fault of the table makes of a frame, for any kind of frame."""

from collections.abc import Callable
from random import Random

from sim_plant.faults.frames import Direction, Effect, F, FrameKind, Freezer, Passed, Way
from sim_plant.faults.parse import FaultRefused, Injection

Held = dict[Way, list[F]]  #: frames that are held back
#: All faults of the table that are done to frames.
FRAME_FAULTS = frozenset(
    "drop delay duplicate reorder corrupt wrong-function wrong-length freeze one-way mute disconnect "
    "heartbeat-lost sdo-abort".split()
)

_Choose = Callable[[], bool]


def effect_of(injection: Injection, kind: FrameKind[F], dice: Random, held: Held[F]) -> Effect[F]:
    """The effect of one injected fault. It keeps in `held` what it holds back.

    Raises FaultRefused for a fault that this kind of frame does not have.
    """
    name = injection.fault.name
    if name in ("mute", "disconnect", "drop"):
        return _meant(lambda frame: [])
    if name == "one-way":
        return _only(injection.word("direction"))
    if name == "reorder":
        return _swapped(held)
    if name == "freeze":
        return _frozen(kind.freezer())
    own = kind.own_effect(injection) or _change(injection, kind, dice)
    if own is None:
        raise FaultRefused(f"{injection.target} {name}: the frames of this wire have no such fault")
    return own


def _change(injection: Injection, kind: FrameKind[F], dice: Random) -> Effect[F] | None:
    """The effects that look at one frame alone."""
    name = injection.fault.name
    if name == "delay":
        delay_s = injection.number("delay_s")
        return _meant(lambda frame: [(delay_s, frame)])
    if name == "duplicate":
        copies = int(injection.number("copies"))
        return _meant(lambda frame: [(0.0, frame)] * copies)
    if name == "corrupt":
        return _meant(lambda frame: _at_once(kind.corrupted(frame, dice)))
    if name == "wrong-function":
        return _meant(lambda frame: [(0.0, kind.other_function(frame))])
    if name == "wrong-length":
        by, fits = int(injection.number("by")), injection.word("field") == "fits"
        return _meant(lambda frame: [(0.0, kind.other_length(frame, by, fits))])
    return None


def _at_once(frame: F | None) -> Passed[F]:
    return [] if frame is None else [(0.0, frame)]


def _meant(change: Callable[[F], Passed[F]]) -> Effect[F]:
    """`change` for the frames that are meant; the others pass."""

    def effect(way: Way, frame: F, choose: _Choose) -> Passed[F]:
        return change(frame) if choose() else [(0.0, frame)]

    return effect


def _only(direction: str) -> Effect[F]:
    def effect(way: Way, frame: F, choose: _Choose) -> Passed[F]:
        return [(0.0, frame)] if way[0].value == direction or not choose() else []

    return effect


def _swapped(held: Held[F]) -> Effect[F]:
    """Holds one frame for each way, and lets it go behind the next one."""

    def effect(way: Way, frame: F, choose: _Choose) -> Passed[F]:
        if way in held:
            return [(0.0, frame), *((0.0, before) for before in held.pop(way))]
        if not choose():
            return [(0.0, frame)]
        held[way] = [frame]
        return []

    return effect


def _frozen(freezer: Freezer[F]) -> Effect[F]:
    def effect(way: Way, frame: F, choose: _Choose) -> Passed[F]:
        if way[0] is Direction.FROM_DEVICE:
            return [(0.0, freezer.answer(frame) if choose() else frame)]
        freezer.request(frame)
        return [(0.0, frame)]

    return effect
