"""Faults of the frames on one wire. Pure: whoever carries frames asks for each what becomes of it.

`WireFaults.pass_` is given every frame in either direction and answers with the frames that go on in its place, each
with the time by which it is late. Without faults that is the frame itself, at once.
"""

from collections.abc import Callable
from functools import partial
from math import inf
from random import Random
from typing import Generic

from sim_plant.faults.frame_effects import Held, effect_of
from sim_plant.faults.frames import Direction, F, FrameKind, Passed, Way
from sim_plant.faults.parse import Injection
from sim_plant.faults.table import BOTH


class WireFaults(Generic[F]):
    """The faults of one wire. Frames from and for a device have its address; on CAN those for all nodes have 0.

    A fault of one address does not touch what is meant for all. Several faults act one after the other, in the order in
    which they came. What the dice say depends on the seed, the number of the fault and the frames alone.
    """

    def __init__(self, kind: FrameKind[F], seed: int = 0) -> None:
        self.before_request: Callable[[float | None], object] = _no_time
        """Called before each frame towards a device with the time at which it came (None: now), so that time can bring
        and take faults before it acts. It must not go beyond: the device lives in the time of its frames."""
        self.on_disconnect: Callable[[], object] = _nothing  #: called when connections are to be broken off
        self._kind = kind
        self._seed = seed
        self._active: dict[int, _Active[F]] = {}
        self._begun = 0
        self._left: Held[F] = {}  #: held back by a fault that has ended

    @property
    def disconnected(self) -> bool:
        """Whether connections are refused."""
        return any(active.disconnects for active in self._active.values())

    def begin(self, injection: Injection, address: int | None) -> int:
        """Let a fault act on the frames of an address, or of all. Returns the number by which it ends.

        Raises FaultRefused for a fault that frames of this kind do not have.
        """
        dice = Random(f"{self._seed}/{self._begun + 1}")
        active = _Active(injection, address, self._kind, dice)
        self._begun += 1
        self._active[self._begun] = active
        if active.disconnects:
            self.on_disconnect()
        return self._begun

    def check(self, injection: Injection) -> None:
        """Raises FaultRefused for a fault that frames of this kind do not have."""
        _Active(injection, None, self._kind, Random())

    def end(self, number: int) -> int:
        """End a fault. Returns how many frames it has taken, held or changed. What it holds back goes on before the
        next frame of the same way. Raises KeyError when it has ended before.
        """
        active = self._active.pop(number)
        for way, frames in active.held.items():
            self._left.setdefault(way, []).extend(frames)
        return active.affected

    def carry(
        self,
        direction: Direction,
        address: int,
        frame: F,
        deliver: Callable[[F, float], object],
        later: Callable[[float, Callable[[], object]], object],
        arrived_s: float | None = None,
    ) -> None:
        """`pass_`, and `deliver` (frame, delay in s) what goes on: at once, or by `later` (delay in s, call)."""
        if direction is Direction.TO_DEVICE:
            self.before_request(arrived_s)
        if not (self._active or self._left):  # as nearly always
            deliver(frame, 0.0)
            return
        for delay_s, after in self._passing(direction, address, frame):
            if delay_s > 0.0:
                later(delay_s, partial(deliver, after, delay_s))
            else:
                deliver(after, 0.0)

    def pass_(self, direction: Direction, address: int, frame: F, arrived_s: float | None = None) -> Passed[F]:
        """What goes on in place of a frame: (delay in s, frame), in this order where the delays are equal.

        `arrived_s` is the world time at which a frame towards a device came in; None is now.
        """
        if direction is Direction.TO_DEVICE:
            self.before_request(arrived_s)
        return self._passing(direction, address, frame)

    def _passing(self, direction: Direction, address: int, frame: F) -> Passed[F]:
        way = (direction, address)
        waiting = self._left.pop(way, [])
        passing: Passed[F] = [(0.0, held) for held in waiting]
        passing.append((0.0, frame))
        for active in self._active.values():
            if active.address is None or active.address == address:
                passing = [
                    (late + later, after) for late, before in passing for later, after in active.pass_(way, before)
                ]
        return passing


class _Active(Generic[F]):
    """A fault that acts, with what it has counted and holds."""

    def __init__(self, injection: Injection, address: int | None, kind: FrameKind[F], dice: Random) -> None:
        self.address = address
        self.affected = 0
        self.held: Held[F] = {}
        self.disconnects = injection.fault.name == "disconnect"
        values = injection.values
        # Of a one-way fault the direction is the one that is spared: its effect knows that.
        self._direction = BOTH if injection.fault.name == "one-way" else values.get("direction", BOTH)
        self._probability = float(values.get("probability", 1.0))
        self._most = float(values.get("count", inf))
        self._dice = dice
        self._effect = effect_of(injection, kind, dice, self.held)

    def pass_(self, way: Way, frame: F) -> Passed[F]:
        return self._effect(way, frame, lambda: self._choose(way[0]))

    def _choose(self, direction: Direction) -> bool:
        if self._direction not in (BOTH, direction.value) or self.affected >= self._most:
            return False
        if self._probability < 1.0 and self._dice.random() >= self._probability:
            return False
        self.affected += 1
        return True


def _nothing() -> None: ...


def _no_time(arrived_s: float | None) -> None: ...
