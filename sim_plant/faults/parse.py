"""The words in which a fault is asked for.

    TARGET [NUMBER] FAULT [NAME=VALUE ...] [at SECONDS] [for SECONDS]

    load-cell 3 nan at 12.5 for 0.2
    canopen drop probability=0.1 direction=from-device

Targets are drive, load-cell, web (with a number), plc (without one), and the wires canopen, modbus-tcp and opcua (with
an address, or without for all of them). `at` is world time; without it the fault comes at once. Parsing is strict:
what is not understood is refused, with what is allowed and the nearest word.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from math import isfinite

from sim_plant.faults.table import BY_NAME, NUMBERED, WIRES, Choice, Fault, Kind, Lasting, Number

Value = float | str

LONGEST_TEXT = 400  #: characters
_MOST_S = 1e6
_ADDRESSES = {"canopen": (1, 127), "modbus-tcp": (0, 255)}  #: nodes, units
_GRAMMAR = "TARGET [NUMBER] FAULT [NAME=VALUE ...] [at SECONDS] [for SECONDS]"


class FaultRefused(ValueError):
    """A fault that cannot be asked for so, or not of this line. The text says what is wrong and what is allowed."""


@dataclass(frozen=True, slots=True)
class Target:
    """`number` counts from 1 as in `table.NUMBERED`; of a wire it is an address, and None means all of them."""

    kind: Kind
    number: int | None = None
    wire: str = ""  #: of a wire only

    def __str__(self) -> str:
        word = self.wire or self.kind.value
        return word if self.number is None else f"{word} {self.number}"


@dataclass(frozen=True, slots=True)
class Injection:
    """A fault of the table, what it is done to, with every parameter, and when."""

    fault: Fault
    target: Target
    values: dict[str, Value]  #: every parameter of the row, given or default
    at_s: float | None = None  #: world time; None is at once
    for_s: float | None = None  #: None is until cleared, or once

    def number(self, name: str) -> float:
        return float(self.values[name])

    def word(self, name: str) -> str:
        return str(self.values[name])

    def __str__(self) -> str:
        """The words that ask for this again."""
        given = [f"{p.name}={shown(self.values[p.name])}" for p in self.fault.parameters if self._differs(p)]
        when = [] if self.at_s is None else ["at", shown(self.at_s)]
        long = [] if self.for_s is None else ["for", shown(self.for_s)]
        return " ".join([str(self.target), self.fault.name, *given, *when, *long])

    def _differs(self, parameter: Number | Choice) -> bool:
        default = parameter.words[0] if isinstance(parameter, Choice) else parameter.default
        return self.values[parameter.name] != default


def parse_fault(text: str) -> Injection:
    """One fault. Raises FaultRefused."""
    if len(text) > LONGEST_TEXT:
        raise FaultRefused(f"the fault has {len(text)} characters; allowed: {LONGEST_TEXT}")
    words = text.split()
    if not words:
        raise FaultRefused(f"there is no fault in an empty text; it reads {_GRAMMAR}")
    target, rest = _target(words)
    if not rest:
        raise FaultRefused(f'"{text}" names no fault; it reads {_GRAMMAR}. Of {target}: {_names(target.kind)}')
    fault = _fault(rest[0], target)
    given, times = _arguments(rest[1:], fault)
    for_s = times.get("for")
    if fault.lasting is Lasting.ONCE and "for" in times:
        raise FaultRefused(f'{fault.name} happens once: leave out "for {times["for"]:g}"')
    return Injection(fault, target, _values(given, fault), times.get("at"), for_s)


def shown(value: Value) -> str:
    """So that it reads back as the same value."""
    if isinstance(value, str):
        return value
    return str(int(value)) if abs(value) < 1e15 and value == int(value) else repr(value)


def ranged(parameter: Number) -> str:
    """What is allowed, with its unit."""
    return f"{shown(parameter.lowest)} to {shown(parameter.highest)} {parameter.unit}".rstrip()


def _target(words: list[str]) -> tuple[Target, list[str]]:
    word, rest = words[0], words[1:]
    allowed = [kind.value for kind in Kind if kind is not Kind.WIRE] + list(WIRES)
    if word == "rack":
        raise FaultRefused("a rack is met by its unit, modbus-tcp 3 as a rule, or by a device in it, such as drive 2")
    if word not in allowed:
        raise _unknown("target", word, allowed)
    kind = Kind.WIRE if word in WIRES else Kind(word)
    wire = word if kind is Kind.WIRE else ""
    counted = NUMBERED[kind]
    if rest and _is_integer(rest[0]):
        if counted is None or word == "opcua":
            raise FaultRefused(f'"{word} {rest[0]}": {word} has no numbers; leave it out')
        return Target(kind, _address(rest[0], word), wire), rest[1:]
    if counted is not None and kind is not Kind.WIRE:
        raise FaultRefused(f"{word} needs a number, that of the {counted}: {word} 1 {' '.join(rest)}".rstrip())
    return Target(kind, None, wire), rest


def _address(word: str, target: str) -> int:
    number = int(word)
    lowest, highest = _ADDRESSES.get(target, (1, 999))
    if not lowest <= number <= highest:
        raise FaultRefused(f"{target} {word}: allowed are numbers from {lowest} to {highest}")
    return number


def _fault(word: str, target: Target) -> Fault:
    fault = BY_NAME.get(word)
    if fault is None:
        raise _unknown("fault", word, [f.name for f in BY_NAME.values() if target.kind in f.kinds])
    if target.kind not in fault.kinds:
        of = ", ".join("/".join(WIRES) if k is Kind.WIRE else k.value for k in fault.kinds)
        raise FaultRefused(f"{word} is a fault of {of}, not of {target}. Of {target}: {_names(target.kind)}")
    return fault


def _arguments(words: list[str], fault: Fault) -> tuple[dict[str, str], dict[str, float]]:
    """Parameters as they were given, and the times behind `at` and `for`."""
    given: dict[str, str] = {}
    times: dict[str, float] = {}
    waiting = iter(words)
    for word in waiting:
        name, equals, value = word.partition("=")
        if word in times or (equals and name in given):
            raise FaultRefused(f"{fault.name}: {name} is given twice")
        if word in ("at", "for"):
            times[word] = _seconds(word, next(waiting, ""))
        elif equals:
            given[name] = value
        else:
            parameters = [f"{p.name}=" for p in fault.parameters]
            raise _unknown(f"parameter of {fault.name}", word, [*parameters, "at", "for"])
    return given, times


def _seconds(word: str, text: str) -> float:
    value = _number(text)
    lowest = 0.001 if word == "for" else 0.0
    if value is None or not lowest <= value <= _MOST_S:
        raise FaultRefused(f'"{word} {text}": {word} takes a time in s from {lowest:g} to {_MOST_S:g}')
    return value


def _values(given: dict[str, str], fault: Fault) -> dict[str, Value]:
    for name in given:
        if fault.parameter(name) is None:
            raise _unknown(f"parameter of {fault.name}", name, [p.name for p in fault.parameters])
    return {p.name: _value(p, given.get(p.name), fault) for p in fault.parameters}


def _value(parameter: Number | Choice, text: str | None, fault: Fault) -> Value:
    if isinstance(parameter, Choice):
        if text is not None and text not in parameter.words:
            raise _unknown(f"{parameter.name} of {fault.name}", text, parameter.words)
        return parameter.words[0] if text is None else text
    if text is None:
        if parameter.default is None:
            example = f"for example: {fault.example}"
            raise FaultRefused(f"{fault.name} needs {parameter.name}=, {ranged(parameter)}; {example}")
        return parameter.default
    value = _number(text)
    if value is None or not parameter.lowest <= value <= parameter.highest:
        raise FaultRefused(f"{fault.name}: {parameter.name}={text}; allowed: {ranged(parameter)}")
    if parameter.whole and value != int(value):
        raise FaultRefused(f"{fault.name}: {parameter.name}={text}; allowed: whole numbers")
    return value


def _number(text: str) -> float | None:
    """A finite number, decimal or 0x-hexadecimal; None for anything else."""
    if "_" in text:  # Python would read 1_0 as 10
        return None
    try:
        value = float(int(text, 16)) if text.lower().startswith("0x") else float(text)
    except ValueError:
        return None
    return value if isfinite(value) else None


def _is_integer(word: str) -> bool:
    return word.isascii() and word.removeprefix("-").isdigit()


def _names(kind: Kind) -> str:
    return ", ".join(fault.name for fault in BY_NAME.values() if kind in fault.kinds)


def _unknown(what: str, word: str, allowed: Iterable[str]) -> FaultRefused:
    known = list(allowed)
    near = get_close_matches(word, known, n=1, cutoff=0.5)
    hint = f" Did you mean {near[0]}?" if near else ""
    there = f"allowed: {', '.join(known)}" if known else "there is none"
    return FaultRefused(f'"{word[:60]}" is no {what}; {there}.{hint}')
