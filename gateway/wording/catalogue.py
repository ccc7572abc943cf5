"""Findings as sentences, in every language that has a file in this folder. What one of them lacks is said in English.

An entry is a table named by the code: `text`, and in `do` what a person does next. Parameters stand in braces, with a
format as Python has it, and a factor before it where people use another unit: `{taken_up_m:1000*.0f} mm`.
"""

import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from gateway.core.finding import Finding, Value

ENGLISH = "en"
_FIELD = re.compile(r"\{(\w+)(?::(?:([0-9.]+)\*)?([^{}]*))?\}")


@dataclass(frozen=True)
class Entry:
    """What a language says of a code."""

    text: str
    do: str  #: what to do next; empty: the text says it

    @property
    def said(self) -> str:
        """Both, with the fields in it."""
        return f"{self.text}: {self.do}" if self.do else self.text


@dataclass(frozen=True)
class Catalogue:
    """A language."""

    language: str
    decimal: str  #: between a number's whole part and its fraction
    entries: Mapping[str, Entry]


@cache
def languages() -> tuple[str, ...]:
    """Their short names, English first."""
    found = {
        file.name.removesuffix(".toml") for file in files("gateway.wording").iterdir() if file.name[-5:] == ".toml"
    }
    return (ENGLISH, *sorted(found - {ENGLISH}))


@cache
def catalogue(language: str) -> Catalogue:
    """Of one language. Raises FileNotFoundError where there is none."""
    return parsed(language, (files("gateway.wording") / f"{language}.toml").read_text(encoding="utf-8"))


def parsed(language: str, text: str) -> Catalogue:
    """A language's file. Raises ValueError with what is wrong."""
    document = tomllib.loads(text)
    decimal = document.pop("language", {}).get("decimal", ".")
    entries: dict[str, Entry] = {}
    for code, entry in document.items():
        if not isinstance(entry, dict) or not set(entry) <= {"text", "do"} or "text" not in entry:
            raise ValueError(f"{language}.toml: {code}: `text` is needed; `do` is allowed beside it")
        entries[code] = Entry(entry["text"], entry.get("do", ""))
    return Catalogue(language, decimal, entries)


def sentence(found: Finding, language: str = ENGLISH) -> str:
    """What was found and what to do next, for a person."""
    for one in _in_order(language):
        if (entry := one.entries.get(found.code)) is not None:
            return filled(entry.said, found.parameters, one.decimal)
    return _plain(found)


def sentences(found: Iterable[Finding], language: str = ENGLISH) -> str:
    """Of several, one after the other."""
    return "; ".join(sentence(one, language) for one in found)


def filled(template: str, parameters: Mapping[str, Value], decimal: str = ".") -> str:
    """`template` with its fields filled in. A parameter that is not there is a question mark; nothing is raised."""

    def field(match: re.Match[str]) -> str:
        name, factor, spec = match.groups()
        return _formatted(parameters.get(name, "?"), float(factor or 1.0), spec or "", decimal)

    return _FIELD.sub(field, template)


def fields(template: str) -> set[str]:
    """The names of the parameters that a template says."""
    return {match.group(1) for match in _FIELD.finditer(template)}


def templates(language: str) -> dict[str, str]:
    """By the English sentence that of `language`, with names in braces and no formats.

    For reasons that are told on as text: why a configuration was rolled back, say.
    """
    there = catalogue(language).entries
    return {_bare(one.said): _bare(there[code].said) for code, one in _english.entries.items() if code in there}


def _bare(template: str) -> str:
    return _FIELD.sub(r"{\1}", template)


def _in_order(language: str) -> list[Catalogue]:
    if language == ENGLISH or language not in languages():
        return [_english]
    return [catalogue(language), _english]


def _formatted(value: Value, factor: float, spec: str, decimal: str) -> str:
    if isinstance(value, str):
        return value  # also a number that is none
    number = value if factor == 1.0 else factor * value
    try:
        said = format(number, spec or ("g" if isinstance(number, float) else ""))
    except ValueError:
        said = str(number)
    return said.replace(".", decimal)


_english = catalogue(ENGLISH)  # read here: the loop says its first sentence within a period


def _plain(found: Finding) -> str:
    """Of a code that no catalogue has: a newer loop beside an older gateway."""
    return " ".join([found.code, *(f"{name}={value}" for name, value in found.parameters.items())])
