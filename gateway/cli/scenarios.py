"""Scenarios by name or by file, for the commands."""

import tomllib
from pathlib import Path

from gateway.core.scenario import PAPER, Scenario, ScenarioRefused, scenario_of


def load_scenario(given: str) -> Scenario:
    """`tension`, `velocity`, or the scenario of a TOML file. Raises ScenarioRefused."""
    known = {scenario.name: scenario for scenario in PAPER}
    if given in known:
        return known[given]
    try:
        document = tomllib.loads(Path(given).read_text(encoding="utf-8"))
    except OSError as error:
        raise ScenarioRefused(
            f"{given} cannot be read: {error.strerror}; allowed: {', '.join(known)}, or a TOML file"
        ) from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ScenarioRefused(f"{given} is no TOML: {error}") from error
    try:
        return scenario_of(document)
    except ScenarioRefused as refused:
        raise ScenarioRefused(f"{given}: {refused}") from refused
