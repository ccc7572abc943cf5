"""`make bench-trials`: good and bad configurations on trial on lines whose answers are late now and then.

    python -m tests.bench.trials [--bad 200] [--good 200] [--late 0.01] [--envelope] [--first-seed N]

Bad: on its own line, alone, a tension is off or swings, or a torque chatters, by at least a fifth more than is allowed,
in most whiles of two seconds, where nothing is late and where as many answers are late as in the trial. Of most of them
nobody knows but who looks at the telemetry: at most 15 % take the line down alone, and at most 25 % have torques
that the loop's own monitor notices. Good: by at least a fifth less in all whiles. What is true is the recorder's at the
simulated line.

With each of eight answers a period late in 1 of 100 cases the envelope stops the line for want of samples every half a
minute, whatever controls it. So that trials come to an end it does not here; how often it would have is a figure.
`--envelope`: it does.
"""

import argparse
import asyncio
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest
from math import inf

from pydantic import ValidationError

from gateway.control.design import DesignRefused
from gateway.core.controller import Controller, config_hash
from gateway.core.line import Line
from gateway.supervisor.lifecycle import Stage
from tests.bench.figures import Bench
from tests.bench.monitor_runs import Case
from tests.bench.trials_runs import BAD, GOOD, Trial, TrialRun, Truth, draw_bad, draw_good, truth_of
from tests.closed_loop.recorded import demonstration_line

FIRST_SEED = 9_300_000
LONGEST_S = 90.0  #: of a trial
#: Of the bad: that stop the line by themselves, and of whose torques the loop knows without any look.
MOST = {"stops": 0.15, "noticed": 0.25, "quiet": 1.0}

Drawn = tuple[Case, str, Controller, Truth]


@dataclass
class Left:
    """Out of the draw.

    Bad where nothing is late, and not here: outputs that are held slow an integral down. Or such that no proposal can
    say it: it is refused as it is read.
    """

    bad_on_punctual_wires_only: int = 0
    no_configuration: int = 0


def drawn(line: Line, first_seed: int, count: int, good: bool, late: float, left: Left) -> Iterator[Drawn]:
    """`count` that are truly so, on lines that stand well within what is allowed with what is in service."""
    seed, found = first_seed, Counter[str]()
    while found.total() < count:
        seed += 1
        try:
            case, kind, config, truth = (draw_good if good else draw_bad)(line, seed)
        except DesignRefused:
            continue
        if not _can_be_said(config):
            left.no_configuration += 1
            continue
        if config_hash(config) == config_hash(case.good):
            continue
        if not (truth.most <= GOOD if good else truth.share >= BAD):
            continue
        how = "stops" if truth.share == inf else "noticed" if truth.noticed else "quiet"
        if not good and found[how] >= MOST[how] * count:
            continue
        if not truth_of(case, case.good, late).most <= GOOD:
            continue  # what the line did before is allowed after the change, too
        if not good and not truth_of(case, config, late).share >= BAD:
            left.bad_on_punctual_wires_only += 1
            continue
        found[how] += 1
        yield case, kind, config, truth


def _can_be_said(config: Controller) -> bool:
    try:
        type(config).model_validate(config.model_dump())
    except ValidationError:
        return False
    return True


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.trials")
    parser.add_argument("--bad", type=int, default=200)
    parser.add_argument("--good", type=int, default=200)
    parser.add_argument("--late", type=float, default=0.01, help="share of answers, each by itself")
    parser.add_argument("--envelope", action="store_true", help="it stops the line for want of samples")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    asked = parser.parse_args()
    line, bench, began_s = demonstration_line(), Bench("trials"), time.perf_counter()
    bench.seeds = [asked.first_seed, asked.first_seed + 100_000]
    if asked.late != 0.01 or asked.envelope:
        bench.name = "trials-other"
    trials: dict[str, list[tuple[Drawn, Trial]]] = {"bad": [], "good": []}
    left = Left()
    turns = zip_longest(
        drawn(line, bench.seeds[0], asked.bad, False, asked.late, left),
        drawn(line, bench.seeds[1], asked.good, True, asked.late, left),
    )
    for k, turn in enumerate(turns, 1):
        for (name, found), one in zip(trials.items(), turn, strict=True):
            if one is not None:
                trial = asyncio.run(TrialRun(one[0], one[2], asked.late, asked.envelope).run(LONGEST_S))
                found.append((one, trial))
                if (name == "bad") is (trial.stage is Stage.KEPT):
                    print(f"  {name}: {_words(one, trial)}", flush=True)
        if k % 10 == 0:
            stages = {name: dict(Counter(str(one[1].stage) for one in found)) for name, found in trials.items()}
            print(f"  {k}: {stages}, {time.perf_counter() - began_s:.0f} s", flush=True)
    figures(bench, trials)
    bench.figure("left_out_bad_on_punctual_wires_only", left.bad_on_punctual_wires_only, "", asked.bad)
    bench.figure("left_out_no_configuration", left.no_configuration, "", asked.bad)
    bench.finish()


def figures(bench: Bench, trials: dict[str, list[tuple[Drawn, Trial]]]) -> None:
    bad, good = trials["bad"], trials["good"]
    every = [trial for found in trials.values() for _, trial in found]
    kept = [one for one in bad if one[1].stage is Stage.KEPT]
    lost = [one for one in good if one[1].stage is not Stage.KEPT]
    ran_s, answers = sum(trial.ran_s for trial in every), sum(trial.answers for trial in every)
    bench.figure("bad_kept", len(kept), "", len(bad))
    bench.figure("good_lost", len(lost), "", len(good))
    bench.figure("late_pct", 100.0 * sum(trial.late for trial in every) / answers, "%", answers)
    bench.figure("virtual_time_h", ran_s / 3600.0, "h", len(every))
    bench.figure(
        "stops_for_want_of_samples_per_h", 3600.0 * sum(trial.stops for trial in every) / ran_s, "", len(every)
    )
    bench.figure("deployments_refused_for_a_late_sample", sum(trial.refused for trial in every), "", len(every))
    bench.figure("good_kept_after_most_s", max((trial.decided_s for _, trial in good), default=0.0), "s", len(good))
    kinds: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for (_, kind, _, truth), trial in bad:
        quiet = "" if truth.noticed else ", quiet"
        kinds[f"{kind}, {truth.figure}{quiet}"][str(trial.stage)] += 1
    bench.tables["bad"] = {kind: dict(stages) for kind, stages in sorted(kinds.items())}
    for name, found in (("bad_kept", kept), ("good_lost", lost)):
        bench.tables[name] = [_words(*one) for one in found]
    bench.tables["taken_back"] = [_words(*one) for one in bad if one not in kept]


def _words(one: Drawn, trial: Trial) -> str:
    case, kind, config, truth = one
    return (
        f"seed {case.seed}, {case.plant.name}, {kind} of {config.kind}, {truth.share:.2f} of what is allowed "
        f"({truth.figure}): {trial.stage} after {trial.decided_s:.1f} s: {trial.why}"
    )


if __name__ == "__main__":
    main()
