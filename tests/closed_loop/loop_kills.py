"""The loop's process killed at each place of each write of a decision, and what the next one runs on the same folder.

A configuration is wrong where the loop that starts next runs neither what was decided last nor, where a decision was
under way at the kill, what was decided before it; or anything that somebody was told is taken back; or where it goes
back in its epochs. What was decided is read from the victims' own notes (`loop_victim`) by the model of `loop_model`:
what is granted counts as decided once it is done, for it must be on the disk before; what is taken back once it is
answered, for it is done at once and the disk follows.

A kill keeps what the kernel was given: an order of writes that only a power cut would show is not tested here.
"""

import json
import random
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from gateway.core.messages import Reply
from tests.closed_loop.loop_model import RUNS, Model, Runs, first_law
from tests.closed_loop.loop_victim import NOTES, PLACES, Order
from tests.closed_loop.loop_world import GIVEN, LINE

SAME_FOLDER = 20  #: kills until everything is begun anew
MOST_TIMES = 9  #: that a place is come to before the kill


@dataclass
class Tally:
    kills: int = 0
    wrong: int = 0
    ended: int = 0  #: victims that did not die of a kill
    under_way: int = 0  #: kills while more than one configuration may have been found
    places: Counter[str] = field(default_factory=Counter[str])
    problems: list[str] = field(default_factory=list[str])


def campaign(kills: int, seed: int, advance: Callable[[], None] = lambda: None) -> Tally:
    """`advance` is called after each kill."""
    rng, tally = random.Random(seed), Tally()
    while tally.kills < kills:
        with tempfile.TemporaryDirectory(prefix="r2r-loop-kill-") as folder:
            _site(Path(folder), min(SAME_FOLDER, kills - tally.kills), rng, tally, advance)
    return tally


def _site(folder: Path, kills: int, rng: random.Random, tally: Tally, advance: Callable[[], None]) -> None:
    arguments = [sys.executable, "-m", "tests.closed_loop.loop_victim", str(folder)]
    forks = subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert forks.stdin is not None and forks.stdout is not None
    given, notes = first_law(GIVEN, LINE), folder / NOTES
    model = Model(given, given)
    try:
        for number in range(kills + 1):
            before = notes.read_text() if notes.exists() else ""
            notes.unlink(missing_ok=True)
            place = PLACES[tally.kills % len(PLACES)]
            # The last one only shows what the one before has left.
            count, place = (rng.randint(1, MOST_TIMES), place) if number < kills else (1, "asked")
            forks.stdin.write(f"{rng.randrange(1 << 30)} {count} {place}\n")
            forks.stdin.flush()
            tally.ended += forks.stdout.readline() != "killed\n"
            _replay(model, notes, before, tally)
            if number < kills:
                tally.kills += 1
                tally.under_way += len(set(model.may)) > 1
                advance()
    finally:
        forks.stdin.close()
        forks.stdout.close()
        forks.wait(20.0)


def _judge(model: Model, found: Runs, before: str, tally: Tally) -> None:
    """`before`: the notes of the life that left it."""
    try:
        model.begin_anew(found)
    except AssertionError as wrong:
        tally.wrong += 1
        tally.problems.append(f"{wrong}; after {before}")
        model.may, model.epochs = [found], {}
        model.begin_anew(found)


def _replay(model: Model, notes: Path, before: str, tally: Tally) -> None:
    asked: list[Order] = []
    for line in notes.read_text().splitlines():
        note = json.loads(line)
        order = Order(**note["order"]) if "order" in note else None
        match note["kind"]:
            case "asked":
                assert order is not None
                asked.append(order)
            case "carried out":
                assert order is not None
                if order.kind == "rollback" and model.other:
                    model.rolled_back()
                done = Reply(ok=note["ok"], state="", text="")
                model.carried_out(order.command(), done, 0.0)
            case "answered":
                assert order is not None
                asked.remove(order)
                if order.kind in ("rollback", "narrow") and note["ok"] and not note["late"]:
                    model.settled()
            case "settled":
                model.settled()
            case "dies":
                tally.places[note["place"]] += 1
            case _:
                _judge(model, RUNS.validate_python(note["runs"]), before, tally)
        model.under_way([order.command() for order in asked])
