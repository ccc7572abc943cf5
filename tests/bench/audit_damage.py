"""Audits damaged at random in database, journal and anchor, and who notices: `make bench-audit`."""

import argparse
import shutil
import tempfile
from pathlib import Path

from tests.bench.figures import Bench
from tests.unit.audit_damage import campaign

TRIES = 10_000


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--tries", type=int, default=TRIES)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="r2rgate-audit-"))
    bench = Bench(
        "audit-damage", [given.seed], command="python -m tests.bench.audit_damage", libraries=("apsw", "pydantic")
    )
    try:
        damages = campaign(folder, given.tries, given.seed)
    finally:
        shutil.rmtree(folder)
    bench.figure("damages_undetected", damages.undetected, "", damages.tried)
    told = sum(n for what, n in damages.by.items() if what.endswith("says so"))
    bench.figure("damages_told", told, "", damages.tried)
    bench.tables = {"outcomes": dict(sorted(damages.by.items())), "examples": damages.examples[:20]}
    bench.finish()


if __name__ == "__main__":
    main()
