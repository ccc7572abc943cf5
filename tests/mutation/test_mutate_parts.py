"""What `make mutate` makes of mutmut's names and files; that the reasons of survivors are of functions that exist."""

import json
from importlib import import_module
from pathlib import Path

import pytest

from tests.mutation import mutate
from tests.mutation.mutate import Mutant, ask_again, explained, mutants


@pytest.mark.parametrize(
    ("name", "function"),
    [
        ("safety.actions.x_most_severe__mutmut_1", "safety.actions.most_severe"),
        ("safety.monitor.x__rows__mutmut_12", "safety.monitor._rows"),
        ("safety.recoverability.xǁRecoveryǁ_bounds__mutmut_3", "safety.recoverability.Recovery._bounds"),
        ("safety.recoverability.xǁRecoveryǁ__init____mutmut_3", "safety.recoverability.Recovery.__init__"),
    ],
)
def test_a_mutant_is_of_a_function_as_it_stands_in_the_code(name: str, function: str) -> None:
    assert Mutant(name, "", "survived").function == function


def test_what_lived_is_asked_again_and_what_was_noticed_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    meta = tmp_path / "safety" / "rules" / "decay.py.meta"
    meta.parent.mkdir(parents=True)
    codes = {"safety.rules.decay.x_check__mutmut_1": 0, "safety.rules.decay.x_check__mutmut_2": 1}
    meta.write_text(json.dumps({"exit_code_by_key": codes, "durations_by_key": {}}))
    monkeypatch.setattr(mutate, "MUTANTS", tmp_path)
    lived, killed = mutants()
    assert (lived.path, lived.lives, killed.lives) == ("safety/rules/decay.py", True, False)
    ask_again([lived])
    assert [one.status for one in mutants()] == ["not checked", "killed"]


def test_reasons_are_of_functions_that_there_are() -> None:
    for function, before, after in explained():
        parts = function.split(".")
        at = next(k for k in range(len(parts), 0, -1) if _is_module(".".join(parts[:k])))
        found: object = import_module(".".join(parts[:at]))
        for part in parts[at:]:
            found = getattr(found, part)
        assert callable(found) and before != after


def _is_module(name: str) -> bool:
    try:
        import_module(name)
    except ModuleNotFoundError:
        return False
    return True
