"""Which requests make one transaction with a unit, from what its devices read and write. Pure.

Reading spans gaps (they are read and not used); writing does not: a register that is nobody's is left alone. What
one device writes is never torn apart. Where a read and a write are left they go together in one function 23, which
writes first.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.map_rules import registers_of
from drivers.modbus.maps import MAX_WRITE_REGISTERS
from drivers.modbus.registers import Field, RegisterBlock, spans

Block = tuple[int, int]  #: address (from 0, as on the wire) and number of registers


@dataclass(frozen=True, slots=True)
class Request:
    """One request: reads `read` and writes `write`; one of both may be missing."""

    read: Block | None
    write: Block | None


@dataclass(frozen=True, slots=True)
class _Part:
    """What one read holds of a device: the fields `places`, from byte `start` of the registers of the `read`-th."""

    read: int
    start: int
    block: RegisterBlock
    places: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Wish:
    """What a device wants of every transaction."""

    name: str
    reads: Sequence[Field]
    word_order: str
    write: Block | None = None


class Plan:
    """The requests for all `wishes`; `together`: function 23 may be used.

    Raises ValueError when two devices write the same register.
    """

    def __init__(self, wishes: Sequence[Wish], together: bool = True) -> None:
        fields = [field for wish in wishes for field in wish.reads]
        groups = spans(fields)
        self.reads: list[Block] = [_around([fields[k] for k in group]) for group in groups]
        self._parts: list[tuple[_Part, ...]] = []
        before = 0
        for wish in wishes:
            own = [sorted(k - before for k in group if before <= k < before + len(wish.reads)) for group in groups]
            parts = [self._part(wish, read, places) for read, places in enumerate(own) if places]
            self._parts.append(tuple(parts))
            before += len(wish.reads)
        self.writes, self._written_by = _writes(wishes)
        self.read_only = [Request(read, None) for read in self.reads]
        #: The k-th of `writes` is written by the k-th request.
        self.read_write = (
            [Request(_at(self.reads, k), _at(self.writes, k)) for k in range(max(len(self.reads), len(self.writes)))]
            if together
            else [Request(None, write) for write in self.writes] + self.read_only
        )

    def _part(self, wish: Wish, read: int, places: list[int]) -> _Part:
        block = RegisterBlock([wish.reads[k] for k in places], wish.word_order)
        return _Part(read, 2 * (block.address - self.reads[read][0]), block, tuple(places))

    def decode(self, answers: Sequence[Sequence[int]]) -> list[list[float]]:
        """The numbers of every wish, in the order of its `reads`, from the registers of every read.

        Raises ValueError where an answer has another length than was asked for.
        """
        try:
            return self.decode_bytes([struct.pack(f">{len(registers)}H", *registers) for registers in answers])
        except struct.error as error:
            raise ValueError(f"no registers: {error}") from error

    def decode_bytes(self, answers: Sequence[bytes]) -> list[list[float]]:
        """The same from registers as they come on the wire."""
        for (_, count), data in zip(self.reads, answers, strict=True):
            if len(data) != 2 * count:
                raise ValueError(f"{len(data) // 2} registers, asked for {count}")
        return [self._numbers(parts, answers) for parts in self._parts]

    def _numbers(self, parts: tuple[_Part, ...], answers: Sequence[bytes]) -> list[float]:
        if len(parts) == 1:
            part = parts[0]
            return part.block.decode_bytes(answers[part.read], part.start)
        numbers: dict[int, float] = {}
        for part in parts:
            found = part.block.decode_bytes(answers[part.read], part.start)
            numbers.update(zip(part.places, found, strict=True))
        return [numbers[k] for k in range(len(numbers))]

    def payloads(self, registers: Sequence[Sequence[int]]) -> list[list[int]]:
        """What each of `writes` carries, from what each wish writes (in the order of the wishes that write)."""
        return [[register for k in run for register in registers[k]] for run in self._written_by]


def _around(fields: Sequence[Field]) -> Block:
    first = min(address for address, _ in fields)
    return first, max(address + registers_of(kind) for address, kind in fields) - first


def _writes(wishes: Sequence[Wish]) -> tuple[list[Block], list[list[int]]]:
    """The runs of registers to write, and of which of the writing wishes each is made, in order of address."""
    writing = [(wish.write, wish.name) for wish in wishes if wish.write is not None]
    runs: list[Block] = []
    made_of: list[list[int]] = []
    end, last = -1, ""
    for k in sorted(range(len(writing)), key=lambda k: writing[k][0]):
        ((address, count), name) = writing[k]
        if address < end:
            raise ValueError(f"{name}: register {address} is already written by {last}")
        if address == end and runs[-1][1] + count <= MAX_WRITE_REGISTERS:
            runs[-1] = (runs[-1][0], runs[-1][1] + count)
            made_of[-1].append(k)
        else:
            runs.append((address, count))
            made_of.append([k])
        end, last = address + count, name
    return runs, made_of


def _at(blocks: list[Block], k: int) -> Block | None:
    return blocks[k] if k < len(blocks) else None
