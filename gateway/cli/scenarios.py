"""Scenarios by name or by file, for the commands."""

import tomllib
from pathlib import Path

from gateway.core.scenario import PAPER, Scenario, ScenarioRefused, scenario_of
from gateway.files import read_text

MOST_BYTES = 1_000_000


def load_scenario(given: str) -> Scenario:
    """`tension`, `velocity`, or the scenario of a TOML file. Raises ScenarioRefused."""
    known = {scenario.name: scenario for scenario in PAPER}
    if given in known:
        return known[given]
    try:
        document = tomllib.loads(read_text(Path(given), MOST_BYTES))
    except OSError as error:
        raise ScenarioRefused(
            f"{given} cannot be read: {error.strerror}; allowed: {', '.join(known)}, or a TOML file"
        ) from error
    except (ValueError, RecursionError) as error:
        raise ScenarioRefused(f"{given} is no TOML: {error}") from error
    try:
        return scenario_of(document)
    except ScenarioRefused as refused:
        raise ScenarioRefused(f"{given}: {refused}") from refused
