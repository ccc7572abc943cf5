"""`make bench-loop-kill`: the loop's process killed at each place of each write of what it has decided.

What counts as wrong, and what a kill cannot show, is said in tests/closed_loop/loop_kills.py.
"""

import argparse

from rich.progress import Progress

from tests.bench.figures import Bench
from tests.closed_loop.loop_kills import campaign

KILLS = 1000


def main() -> None:
    parser = argparse.ArgumentParser(prog="make bench-loop-kill")
    parser.add_argument("--kills", type=int, default=KILLS)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with Progress() as progress:
        bar = progress.add_task("kills", total=given.kills)
        tally = campaign(given.kills, given.seed, lambda: progress.advance(bar))
    bench = Bench("loop-kill", [given.seed], libraries=("pydantic", "numpy"))
    bench.figure("kills", tally.kills, "", tally.kills)
    bench.figure("wrong_configurations", tally.wrong, "", tally.kills)
    bench.figure("kills_with_a_decision_under_way", tally.under_way, "", tally.kills)
    bench.figure("not_killed", tally.ended, "", tally.kills)
    bench.tables = {"places": dict(tally.places), "problems": {"first": "; ".join(tally.problems[:5])}}
    for place, count in sorted(tally.places.items()):
        print(f"{count:>6}  {place}")
    for problem in tally.problems[:5]:
        print(problem)
    bench.finish()


if __name__ == "__main__":
    main()
