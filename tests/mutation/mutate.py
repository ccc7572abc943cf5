"""`make mutate`: is there a change of safety/ that its tests do not notice?

mutmut changes safety/ in one place at a time (a comparison, a number, an argument, a text) and runs the tests that
come by there, the quickest first; what the type checker refuses is noticed too, as `make check` would. What nobody
notices survives: it is killed by a test, or stands in tests/mutation/survivors.toml with the reason why it may live.
Anything else is printed, and the command fails.

Takes half an hour on two cores; what is known is kept in mutants/ and not asked again until the function has changed.
What has survived without a reason is asked again each time, for there may be a test of it by now.
    make mutate ARGS="safety.envelope.*"      only these
    make mutate ARGS=--known                  runs nothing: what is known
"""

import argparse
import json
import os
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from mutmut.mutation.diff_apply import get_diff_for_mutant
from mutmut.stats import status_by_exit_code

from gateway.core.line import Strict
from tests.bench.figures import Bench

REASONS = Path(__file__).parent / "survivors.toml"
MUTANTS = Path("mutants")
STATS = MUTANTS / "mutmut-stats.json"
NOTICED = {"killed", "caught by type check", "timeout"}
OPEN = "not checked"


class Explained(Strict):
    """Why mutants may live that turn `before` into `after` in `function`."""

    function: str  #: module.function or module.Class.method
    before: str
    after: str
    reason: str


class Reasons(Strict):
    survivor: list[Explained] = []


@dataclass(frozen=True)
class Mutant:
    name: str  #: as mutmut calls it: module.x_function__mutmut_3, or module.xǁClassǁmethod__mutmut_3
    path: str
    status: str

    @property
    def function(self) -> str:
        module, _, mangled = self.name.rpartition(".")
        plain = mangled.partition("__mutmut_")[0].removeprefix("x").removeprefix("_").strip("ǁ").replace("ǁ", ".")
        return f"{module}.{plain}"

    @cached_property
    def change(self) -> tuple[str, str, str]:
        """The function, and its lines that have changed, before and after, without indentation."""
        lines = get_diff_for_mutant(self.name, path=self.path).splitlines()[2:]
        before, after = ("\n".join(line[1:].strip() for line in lines if line.startswith(sign)) for sign in "-+")
        return self.function, before, after

    @property
    def lives(self) -> bool:
        return self.status not in NOTICED | {OPEN}


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="make mutate", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="of mutants, with * for any text (all that are not known yet)")
    parser.add_argument("--known", action="store_true", help="run nothing: tell what is known")
    given = parser.parse_args()
    reasons = explained()
    if not given.known:
        if STATS.exists() and _tests_changed():
            STATS.unlink()
        ask_again([one for one in mutants() if one.lives and one.change not in reasons])
        beside = Path(sys.executable).parent
        path = f"{beside}{os.pathsep}{os.environ['PATH']}"
        single = {f"{name}_NUM_THREADS": "1" for name in ("OPENBLAS", "OMP", "NUMBA")}
        subprocess.run([beside / "mutmut", "run", *given.names], check=True, env=os.environ | {"PATH": path} | single)
    sys.exit(told(list(mutants()), reasons, all_of_them=not given.names))


def told(found: list[Mutant], reasons: set[tuple[str, str, str]], *, all_of_them: bool) -> bool:
    """Print what lives, write the figures; whether any lives without a reason, or of all one is not known yet."""
    living = [one for one in found if one.lives]
    unexplained = [one for one in living if one.change not in reasons]
    unneeded = reasons - {one.change for one in living}
    for one in unexplained:
        print(f"\n{one.status}: {one.name}{_as_diff(*one.change[1:])}")
    for function, before, after in sorted(unneeded):
        print(f"\nexplained in {REASONS.name}, and does not live: {function}{_as_diff(before, after)}")
    bench = Bench("mutate", command="make mutate", libraries=("mutmut", "pytest", "numpy"))
    count = Counter(one.status for one in found)
    bench.figure("mutants", len(found), "", len(found))
    for status, number in count.most_common():
        bench.figure(status.replace(" ", "_"), number, "", len(found))
    bench.figure("living_without_a_reason", len(unexplained), "", len(found))
    bench.figure("reasons_for_none", len(unneeded), "", len(reasons))
    paths = sorted({one.path for one in found})
    bench.tables["by file"] = {path: dict(Counter(one.status for one in found if one.path == path)) for path in paths}
    bench.finish()
    return bool(unexplained or (all_of_them and count[OPEN]))


def explained() -> set[tuple[str, str, str]]:
    """Changes that may live."""
    reasons = Reasons.model_validate(tomllib.loads(REASONS.read_text())).survivor
    return {(one.function, one.before, one.after) for one in reasons}


def mutants() -> Iterator[Mutant]:
    """All that mutmut has made, as far as it has come."""
    for meta in sorted((MUTANTS / "safety").rglob("*.meta")):
        path = meta.relative_to(MUTANTS).with_suffix("").as_posix()
        for name, code in json.loads(meta.read_text())["exit_code_by_key"].items():
            yield Mutant(name, path, status_by_exit_code[code])


def ask_again(known: list[Mutant]) -> None:
    """Forget what has become of them."""
    for path in {one.path for one in known}:
        meta = MUTANTS / f"{path}.meta"
        content = json.loads(meta.read_text())
        content["exit_code_by_key"] |= {one.name: None for one in known if one.path == path}
        meta.write_text(json.dumps(content))


def _tests_changed() -> bool:
    """Since mutmut has looked which test comes by which function."""
    since = STATS.stat().st_mtime
    return any(path.stat().st_mtime > since for path in Path("tests").rglob("*.py"))


def _as_diff(before: str, after: str) -> str:
    return "".join(f"\n  {sign} {line}" for sign, text in (("-", before), ("+", after)) for line in text.splitlines())


if __name__ == "__main__":
    main()
