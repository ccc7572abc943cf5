"""A line's file from the template, with edits, and what is said of it."""

from functools import partial
from types import ModuleType

import pytest

from gateway.core.line_checks import RULES
from gateway.core.line_file import CheckedLine, check_line
from gateway.core.line_problem import LineRefused, Problem
from gateway.core.line_template import line_template

MAPS = {
    "cia402-torque": ("canopen", "drive", ""),
    "other-drive": ("canopen", "drive", ""),
    "loadcell-amp": ("modbus-tcp", "load-cell", ""),
    "line-plc": ("modbus-tcp", "line-plc", ""),
}
TEMPLATE = line_template(6)
Edit = tuple[str, str]
#: name of the rule; edits; key of the only problem; text of the line it must be on; what must be said
Refused = tuple[str, list[Edit], str, str, str]


def edited(*edits: Edit, spans: int = 6) -> str:
    text = line_template(spans)
    for old, new in edits:
        assert old in text, f"{old!r} is not in the template"
        text = text.replace(old, new, 1)
    return text


def check(text: str) -> CheckedLine:
    return check_line(text, "line.toml", MAPS)


def problems(text: str) -> list[Problem]:
    with pytest.raises(LineRefused) as refused:
        check(text)
    return refused.value.problems


def table(header: str, name: str, text: str = TEMPLATE) -> str:
    """The text of the table with this name, to be taken away or doubled."""
    return next(block for block in text.split("\n\n") if block.startswith(header) and f'name = "{name}"\n' in block)


def assert_refused(edits: list[Edit], key: str, row: str, said: str) -> None:
    """At its place, with its words, and not for much else."""
    text = edited(*edits)
    found = problems(text)
    mine = [problem for problem in found if problem.key == key]
    assert len(mine) == 1, "\n".join(map(str, found))
    assert said in str(mine[0])
    assert text.split("\n")[mine[0].line - 1].startswith(row)
    # The same file may break one rule more (a load cell is missing because a span was misnumbered), but not the world.
    assert len(found) <= 2, "\n".join(map(str, found))


def rules_in_table(module: ModuleType) -> set[str]:
    """Names of the rules of `module` that every file is checked by."""
    checks = [rule.check.func if isinstance(rule.check, partial) else rule.check for rule in RULES]
    return {check.__name__ for check in checks if check.__module__ == module.__name__}


def rules_written(module: ModuleType) -> set[str]:
    """Names of all functions that are rules."""
    return {
        name
        for name, function in vars(module).items()
        if getattr(function, "__module__", "") == module.__name__
        and "Iterator[gateway.core.line_problem.Finding]"
        in str(getattr(function, "__annotations__", {}).get("return", ""))
        and not name.startswith("_")
    }
