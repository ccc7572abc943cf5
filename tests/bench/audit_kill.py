"""A process that writes the audit, killed at random instants, and how long a record takes: `make bench-audit`.

After each kill the whole chain is verified, and every record that the process had been told is stored is looked up.
"""

import argparse
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

from gateway.core.audit_record import Who
from gateway.supervisor.audit import Audit
from tests.bench.figures import Bench
from tests.unit.audit_victim import campaign

KILLS = 1000
COMMITS = 2000


def commit_times_ms(folder: Path, commits: int) -> np.ndarray:
    """From the call of `append` to its return, one record after the other, each with a blob of 2 kB."""
    audit = Audit(folder)
    audit.start()
    took = np.empty(commits)
    try:
        for k in range(commits):
            began_s = time.perf_counter()
            audit.append_and_wait("proposed", Who(name="a bench"), {"k": k}, {"verdict": b"%2048d" % k})
            took[k] = 1e3 * (time.perf_counter() - began_s)
    finally:
        audit.close()
    return took


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--kills", type=int, default=KILLS)
    parser.add_argument("--commits", type=int, default=COMMITS)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="r2rgate-audit-"))
    bench = Bench(
        "audit-kill", [given.seed], command="python -m tests.bench.audit_kill", libraries=("apsw", "pydantic")
    )
    try:
        took_ms = commit_times_ms(folder / "timed", given.commits)
        tally = campaign(folder / "killed", given.kills, given.seed)
    finally:
        shutil.rmtree(folder)
    bench.figure("acknowledged_records_lost", tally.lost, "", tally.told)
    bench.figure("acknowledged_records_called_not_done", tally.denied, "", tally.told)
    bench.figure("unanchored_records_not_called_so", tally.unnamed, "", tally.interrupted)
    bench.figure("chains_unsound_after_kill", tally.unsound, "", tally.kills)
    bench.figure("kills_between_commit_and_anchor", tally.interrupted, "", tally.kills)
    bench.figure("commit_p50_ms", float(np.percentile(took_ms, 50)), "ms", len(took_ms))
    bench.figure("commit_p99_ms", float(np.percentile(took_ms, 99)), "ms", len(took_ms))
    bench.tables = {"kills": {"problems": tally.problems}}
    bench.finish()


if __name__ == "__main__":
    main()
