"""From trials to what is said of a policy. Pure."""

from collections.abc import Sequence

import numpy as np

from gateway.cli.eval_result import Asked, PolicyFigures, TaskResult, Trial
from gateway.cli.eval_stages import together


def figures_of(tasks: Sequence[TaskResult]) -> list[PolicyFigures]:
    """A row for each policy, in the order in which they were tried."""
    policies = dict.fromkeys(trial.policy for task in tasks for trial in task.trials)
    return [policy_figures(name, [t for task in tasks for t in task.trials if t.policy == name]) for name in policies]


def policy_figures(name: str, trials: Sequence[Trial]) -> PolicyFigures:
    """Of one trial at least."""
    ratios = [ratio for one in trials for ratio in one.to_truth.values()]
    to_begin = [ratio for one in trials for ratio in one.to_begin.values()]
    asked = [one.asked for one in trials]
    return PolicyFigures(
        policy=name,
        trials=len(trials),
        reached=sum(one.reached for one in trials),
        converged=sum(one.converged for one in trials),
        iterations=float(np.mean([one.iterations for one in trials])),
        deployments=float(np.mean([one.deployments for one in trials])),
        overruled=sum(one.overruled for one in trials),
        to_truth_p50=float(np.median(ratios)) if ratios else None,
        to_truth_p95=float(np.percentile(ratios, 95)) if ratios else None,
        to_truth_worst=max(ratios, default=None),
        to_begin_worst=max(to_begin, default=None),
        unsafe_accepted=sum(one.unsafe_accepted for one in trials),
        stopped=sum(len(one.stopped) for one in trials),
        rejections=together(row for one in trials for row in one.rejections),
        asked=Asked(
            questions=sum(one.questions for one in asked),
            answered=sum(one.answered for one in asked),
            tokens_in=sum(one.tokens_in for one in asked),
            tokens_out=sum(one.tokens_out for one in asked),
            seconds=sum(one.seconds for one in asked),
        ),
        processor_s=float(np.mean([one.processor_s for one in trials])),
        wall_s=float(np.mean([one.wall_s for one in trials])),
    )
