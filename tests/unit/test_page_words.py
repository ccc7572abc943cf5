"""The catalogue of the page's words: each in every language, none that nobody says, none that is missing."""

import re
from pathlib import Path
from typing import get_args

import pytest

from gateway.core.alarms import ALARMS, Priority
from gateway.core.people import ROLES
from gateway.core.proposal import Kind
from gateway.core.signals import Quality
from gateway.core.states import LoopState
from gateway.core.verdict import ScenarioFigures, Verdict
from gateway.operator.page.tick import DRIVES_THAT_FAIL
from gateway.operator.page.words import ALARM_PARTS, LANGUAGES, catalogue, words_of
from gateway.supervisor.lifecycle import Stage
from safety.rules.improvement import NAMES

STATIC = Path("gateway/operator/page/static")
STATES = [*LoopState.__members__, "UNKNOWN"]
COMMANDS = ("arm", "start")
#: Symbols of the paper.
UNTRANSLATED = {"paper: C_safe", "paper: P_improved", "paper: S_robust"}
#: Keys that are put together while the page runs: what stands before the value, and the values there are.
FAMILIES: dict[str, list[str]] = {
    "state.": STATES,
    "next.": STATES,
    "role.": [*ROLES],
    "priority.": [*get_args(Priority)],
    "alarm.": [f"{alarm.name}.{part}" for alarm in ALARMS for part in ALARM_PARTS],
    "kind.": [*get_args(Kind)],
    "stage.": [stage.value for stage in Stage],
    "configuration.": [*get_args(ScenarioFigures.model_fields["configuration"].annotation)],
    "change.then-": [*get_args(Kind)],
    "measure.": ["rmse_n", "overshoot_pct", "settling_s", "effort_n2m2s"],
    "command.": ["arm", "start", "hold"],
    "table.": ["span", "tension", "setpoint", "speed", "torque", "condition"],
    "history.": ["when", "kind", "author", "stage", "why", "epoch", "open"],
    "health.": ["cycle", "lateness"],
    "operate.": ["tension", "speed", "recipe"],
    "reply.not-": ["stop", "said"],
    "tier.": ["1", "2", "3"],
    "operate.sure-": [*COMMANDS],
    "operate.then-": [*COMMANDS],
}
#: Said as `word(why)`: the page is told which.
TOLD = {"span.outside", "span.off"} | {f"drive.{name}" for name in DRIVES_THAT_FAIL}
TOLD |= {f"quality.{name}" for name in Quality.__members__ if name != "GOOD"}


def named_by_the_gate() -> set[str]:
    """Rules and courses, as the code of the gate has them, and as they stand in a verdict of it."""
    verdict = Verdict.model_validate_json(Path("docs/examples/verdict.json").read_bytes())
    names = {one.rule for one in verdict.findings + verdict.reported} - UNTRANSLATED
    names |= {one.scenario for one in verdict.figures} | set(NAMES.values()) | {"in service", "baseline"}
    for file in [*Path("safety").rglob("*.py"), Path("gateway/supervisor/judging.py")]:
        text = file.read_text()
        for constants in re.findall(r"^(?:[A-Z]+_)?RULE\b.* = (.*)$", text, re.MULTILINE):
            names |= set(re.findall(r'"([^"]+)"', constants))
        names |= set(re.findall(r'"(?:\{RULE\}|corners|experiment|paper|model): ([a-z-]+(?: [a-z]+)*)"', text))
    return names


def said() -> set[str]:
    """Every key that the page's files name, and those that they put together."""
    keys = set(TOLD)
    for file in STATIC.glob("*.js"):
        if file.name.startswith("uplot"):
            continue
        text = file.read_text()
        for call in re.findall(r"word\(([^()]*)", text):
            keys |= set(re.findall(r'"([a-z-]+(?:\.[\w -]+)?)"', re.sub(r"\{[^{}]*\}\s*$", "", call)))
        for prefix in re.findall(r"word\(`([\w.-]+)\$\{", text):
            keys |= {prefix + value for value in FAMILIES[prefix]}
    keys |= {f"gate.{part}" for name in named_by_the_gate() for part in re.split(": |, ", name)}
    page = (STATIC / "index.html").read_text()
    return keys | set(re.findall(r'data-(?:word|label)="([^"]+)"', page))


def test_no_word_is_missing():
    assert said() - catalogue().keys() == set()


def test_no_word_is_there_that_nobody_says():
    assert catalogue().keys() - said() == set()


@pytest.mark.parametrize("key", catalogue())
def test_every_word_is_there_in_every_language_with_the_same_places_to_fill_in(key: str):
    words = catalogue()[key]
    assert words.keys() == set(LANGUAGES) and all(words.values())
    places = {language: sorted(re.findall(r"\{(\w+)\}", text)) for language, text in words.items()}
    assert len({tuple(found) for found in places.values()}) == 1, places


def test_the_page_offers_the_languages_there_are():
    page = (STATIC / "index.html").read_text()
    assert re.findall(r'<option value="(\w+)"', page) == list(LANGUAGES)
    assert words_of("de")["command.stop"] == "Stopp"


@pytest.mark.parametrize("key", ["stale.old", "stale.loop", "stale.none", "stale.broken", "next.UNKNOWN"])
def test_old_data_never_sound_as_if_the_line_stood(key: str):
    assert "The line may be running." in words_of("en")[key] and "läuft vielleicht" in words_of("de")[key]


def test_a_state_in_which_rollers_may_turn_does_not_say_that_they_stand():
    assert [words_of("en")[f"state.{name}"] for name in ("STOP", "HOLD", "SILENT", "UNKNOWN")] == [
        "Stopping / stopped",
        "Hold",
        "Not armed",
        "Unknown",
    ]
    for key in ("next.HOLD", "next.STOP"):
        assert "Rollers may still turn" in words_of("en")[key].replace("rollers", "Rollers")
        assert "Walzen können sich noch drehen" in words_of("de")[key]
