"""`make bench-kill`: the gateway process killed at random instants of proposals' lives, beside a loop that runs on.

A stand-in takes milliseconds where the judge takes seconds, and time runs six times as fast; deployer, audit, stores,
mailbox and loop are the product's. What the loop does is held against the records on the disk after every kill.
"""

import argparse

from tests.bench.figures import Bench
from tests.closed_loop.gate_kills import campaign

KILLS = 1000


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--kills", type=int, default=KILLS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=120.0, help="no folder is begun after that")
    given = parser.parse_args()
    bench = Bench("kill", [given.seed], libraries=("apsw", "pydantic", "numpy"))
    tally = campaign(given.kills, given.seed, given.minutes)
    bench.figure("acknowledged_records_lost", tally.lost, "", tally.told)
    bench.figure("replies_without_a_record", tally.denied, "", tally.replies)
    bench.figure("unexplained_in_the_loop", tally.unexplained, "", tally.looks)
    bench.figure("chains_unsound", tally.unsound, "", tally.kills)
    bench.figure("left_half_way", tally.shut, "", tally.kills)
    bench.tables = {"last record at the kill": tally.stages, "problems": {"first": "; ".join(tally.problems)}}
    bench.finish()


if __name__ == "__main__":
    main()
