"""What the maps of all protocols are made of: units, bits, ranges.

Numbers in a map are in the device's own unit; `scaling` makes SI of them.
"""

from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import Field

from gateway.core.line import Strict

SpeedUnit = Literal["m/s", "mm/s", "um/s", "m/min", "rad/s", "rpm", "mrpm"]
WebSpeedUnit = Literal["m/s", "mm/s", "um/s", "m/min"]  #: where there is no roller to convert an angular speed with
TorqueUnit = Literal["rated torque", "Nm", "mNm"]  #: "rated torque" is the drive's own, from the line's file
TensionUnit = Literal["N", "mN", "kN"]
TimeUnit = Literal["s", "ms"]
Range = Annotated[list[float], Field(min_length=2, max_length=2)]  #: lowest and highest, in the unit of the field
Format = Annotated[int, Field(ge=1, le=1)]  # not Literal, which takes `true` and 1.0 for 1
Bits = Annotated[int, Field(ge=0, le=31)]
TorqueAccuracy = Annotated[float, Field(ge=0.001, le=0.2)]  #: of the rated torque
TorqueFilter = Annotated[float, Field(ge=0.01, le=0.5)]  #: s

MAPS = Path(__file__).parent / "maps"  #: one file a device type

UNSEEN_POWER = "whether its power stage is supplied (voltage_enabled)"

M = TypeVar("M", bound=Strict)


class Bit(Strict):
    bit: Bits
    inverted: bool = False  #: true where 0 means yes

    def is_set(self, word: int) -> bool:
        """What the bit says in `word`."""
        return bool(word >> self.bit & 1) != self.inverted

    def word(self, says: bool) -> int:
        """The word in which the bit says so, and no other bit is set."""
        return (says != self.inverted) << self.bit


def refuse_together(model: M, problems: list[str]) -> M:
    """The model of a map whose fields fit together. Raises ValueError with every problem."""
    if problems:
        raise ValueError("\n".join(problems))
    return model
