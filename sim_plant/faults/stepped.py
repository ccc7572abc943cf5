"""Faults of a line in stepped time: devices and web, without wires.

line = SteppedLine(plant, seed, latency_s)
faults = injector_of(line)
faults.add(parse_fault("load-cell 3 nan at 12.5 for 0.2"), line.world.now_s)
"""

from functools import partial

from sim_plant.faults.injector import Injector
from sim_plant.faults.targets import FaultyLine
from sim_plant.stepped import SteppedLine


def injector_of(line: SteppedLine) -> Injector:
    """What brings faults into `line`; they come and go as its world's time passes."""
    n = line.world.n
    faulty = FaultyLine(
        spans=n,
        drives=[_SteppedDrive(line, index) for index in range(n)],
        amplifier=line.amplifier,
        plc=line.plc,
        web=line.world,
        restarts={("drive", index + 1): partial(line.take_off, index) for index in range(n)},
    )
    return Injector(faulty, line.recorder.note, line.world.timer)


class _SteppedDrive:
    """A drive of a line that has none of its own. All that takes torque off is the same there.

    It stays off until it has been told off and enabled anew, which is all that can be said of STO too.
    """

    def __init__(self, line: SteppedLine, index: int) -> None:
        self._line = line
        self._index = index

    def fault(self, code: int, now_s: float) -> None:
        self._line.take_off(self._index, now_s)

    def set_sto(self, active: bool, now_s: float) -> None:
        if active:
            self._line.take_off(self._index, now_s)

    def jump_speed(self, delta_m_per_s: float) -> None:
        self._line.encoders[self._index].offset(delta_m_per_s, 0.0, self._line.world.steps)

    def freeze_speed(self) -> None:
        self._line.encoders[self._index].stick()

    def heal_speed(self) -> None:
        self._line.encoders[self._index].heal()

    def turn_encoder(self) -> None:
        self._line.encoders[self._index].scale(-1.0)

    def reverse(self, reverse: bool) -> None:
        self._line.direction[self._index] = -1.0 if reverse else 1.0

    def give_share(self, share: float) -> None:
        self._line.torque_share[self._index] = share

    def lose_mode(self, mode: int, now_s: float, *, says_follows: bool) -> None:
        self._line.torque_share[self._index] = 0.0

    def regain_mode(self) -> None:
        self._line.torque_share[self._index] = 1.0

    def set_powered(self, powered: bool, now_s: float) -> None:
        self._line.powered[self._index] = powered
        if not powered:
            self._line.take_off(self._index, now_s)
