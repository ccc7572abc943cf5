"""Whether what is installed is what was tested, and whether another package has overwritten a part of it."""

import platform
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import metadata, util
from pathlib import Path

from gateway.cli.doctor_check import Check

DISTRIBUTION = "r2rgate"
#: Import names that other packages use, too: pip overwrites one with the other without a word.
GENERIC_NAMES = ("agents", "drivers", "safety", "gateway", "sim_plant")
_GROUP = "software"
_OWN_ENVIRONMENT = "install r2rgate into an environment of its own"
_PINNED = re.compile(r"^([A-Za-z0-9_.-]+)(?:\[[^]]*\])?==([^;, ]+)$")
_NAME = re.compile(r"^[A-Za-z0-9_.-]+")


def software() -> list[Check]:
    """Versions of r2rgate and of what it needs, and the owners of its import names."""
    required = [line for line in metadata.requires(DISTRIBUTION) or [] if "extra ==" not in line]
    checks = [*versions(required, _installed), *names(metadata.packages_distributions(), _origins())]
    python = f"Python {platform.python_version()}, {platform.system()} {platform.release()}"
    return [Check(_GROUP, "r2rgate", "", "OK", f"{metadata.version(DISTRIBUTION)}, {python}"), *checks]


def _installed(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def versions(required: Sequence[str], installed: Callable[[str], str | None]) -> Iterator[Check]:
    """One check for all that are there, one for each that is not or is another than the pinned one."""
    there: list[str] = []
    for requirement in required:
        match = _NAME.match(requirement)
        assert match is not None, requirement
        found, pinned = installed(match[0]), _PINNED.match(requirement.replace(" ", ""))
        if found is None:
            yield Check(_GROUP, match[0], "", "FAIL", "not installed", requirement, "install r2rgate anew")
        elif pinned is not None and found != pinned[2]:
            yield Check(_GROUP, match[0], "", "FAIL", found, requirement, _OWN_ENVIRONMENT)
        else:
            there.append(f"{match[0]} {found}")
    if there:
        yield Check(_GROUP, "libraries", "", "OK", ", ".join(sorted(there)))


def names(owners: Mapping[str, Sequence[str]], origins: Mapping[str, Path]) -> Iterator[Check]:
    """`owners`: distributions by import name; `origins`: the folder from which each name is imported.

    A name that nobody owns and that cannot be imported is fine: that part is not there.
    """
    home = origins["gateway"].parent
    wrong = False
    for name in GENERIC_NAMES:
        foreign = sorted({owner for owner in owners.get(name, ()) if owner != DISTRIBUTION})
        origin = origins.get(name)
        if foreign:
            wrong = True
            todo = f"uninstall {foreign[0]}, then {_OWN_ENVIRONMENT}"
            yield Check(_GROUP, f"import {name}", "", "FAIL", f"also of {', '.join(foreign)}", "of r2rgate alone", todo)
        elif origin is not None and origin.parent != home:
            wrong = True
            yield Check(_GROUP, f"import {name}", "", "FAIL", f"comes from {origin}", f"in {home}", _OWN_ENVIRONMENT)
    if not wrong:
        there = ", ".join(name for name in GENERIC_NAMES if name in origins)
        yield Check(_GROUP, "import names", "", "OK", f"{there}: of r2rgate alone")


def _origins() -> dict[str, Path]:
    origins: dict[str, Path] = {}
    for name in GENERIC_NAMES:
        spec = util.find_spec(name)
        if spec is not None and spec.submodule_search_locations:
            origins[name] = Path(next(iter(spec.submodule_search_locations)))
    return origins
