"""Frames for the fuzz bench: valid ones, mutants of them, and noise. Seeded."""

import struct
from random import Random

#: 32-bit floats that are trouble: NaN, infinities, the largest, a subnormal, minus zero.
AWKWARD = (b"\x7f\xc0\0\0", b"\x7f\x80\0\0", b"\xff\x80\0\0", b"\x7f\x7f\xff\xff", b"\0\0\0\1", b"\x80\0\0\0")
LONGEST_NOISE = 300
_DOUBLES = (float("nan"), float("inf"), float("-inf"), 1.7e308, 5e-324, -0.0)


def mutate(valid: bytes, dice: Random) -> bytes:
    """`valid`, a mutant of it or noise; about a fifth stays as it is."""
    kind = dice.randrange(10)
    if kind < 2:
        return valid
    if kind == 2:
        return dice.randbytes(len(valid))
    if kind == 3:
        return dice.randbytes(dice.randrange(LONGEST_NOISE if dice.random() < 0.1 else 20))
    data = bytearray(valid)
    for _ in range(1 + dice.randrange(3)):
        _change(data, kind, dice)
    return bytes(data)


def _change(data: bytearray, kind: int, dice: Random) -> None:
    at = dice.randrange(len(data) + 1)
    if kind == 4:
        del data[at:]
    elif kind == 5:
        data[at:at] = dice.randbytes(1 + dice.randrange(4))
    elif kind == 6:
        awkward = dice.choice(AWKWARD) if dice.random() < 0.5 else struct.pack("<d", dice.choice(_DOUBLES))
        awkward = awkward if dice.random() < 0.5 else awkward[::-1]
        data[at : at + len(awkward)] = awkward
    elif kind == 7:
        del data[at : at + 1 + dice.randrange(3)]
    elif data:
        place = dice.randrange(len(data))
        data[place] = dice.choice((0, 1, 0x7F, 0x80, 0xFF)) if kind == 8 else data[place] ^ 1 << dice.randrange(8)
