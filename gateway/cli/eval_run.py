"""A task carried out under a policy, in stepped time and through a whole gate: once, and what came of it."""

import asyncio
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gateway.cli.commission import commission
from gateway.cli.commission_result import Commissioned
from gateway.cli.commission_stepped import SteppedGate
from gateway.cli.eval_result import Asked, TaskResult, Trial
from gateway.cli.eval_stages import rejections
from gateway.cli.eval_tasks import MOST_DEPLOYMENTS, TOP_M_PER_S, Task
from gateway.cli.eval_truth import Worth, designed_on_truth, worth
from gateway.cli.stepped import SteppedLoop
from gateway.commissioning.decisions import RULES, Decided, Decider
from gateway.commissioning.ladder import BY_RULES
from gateway.commissioning.past import Step
from gateway.core.controller import Controller, config_hash
from gateway.core.interactions import Interaction
from gateway.core.questions import Question

MOST_LETTERS = 600  #: of why something failed

Tell = Callable[[str], None]
Decides = Callable[[SteppedGate, asyncio.AbstractEventLoop], Decider]  #: who decides over a gate, in whose loop


class TrialFailed(Exception):
    """The chain did not come to an end; the text says why. `unsafe_events`: at the simulated drives until then."""

    def __init__(self, why: str, unsafe_events: int) -> None:
        super().__init__(why)
        self.unsafe_events = unsafe_events


@dataclass
class Noted:
    """`Decider`: as `decider`, with what was asked and decided."""

    decider: Decider
    asked: list[tuple[Question, Decided]] = field(default_factory=list[tuple[Question, Decided]])

    def decide(self, question: Question) -> Decided:
        decided = self.decider.decide(question)
        self.asked.append((question, decided))
        return decided


@dataclass(frozen=True)
class Carried:
    """A task carried out."""

    found: Commissioned
    in_service: Controller
    asked: list[tuple[Question, Decided]]
    unsafe_events: int
    line_s: float
    processor_s: float
    wall_s: float


class Carrying:
    """One task under policy after policy. What one configuration is worth is measured once."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self._worth: dict[str, Worth] = {}
        self._begin = self.worth(task.begin)
        self._law, on_truth = designed_on_truth(task)
        self._truth = self.worth(on_truth)

    def worth(self, config: Controller) -> Worth:
        hash_ = config_hash(config)
        if hash_ not in self._worth:
            self._worth[hash_] = worth(self.task, config)
        return self._worth[hash_]

    def carried_out(self, decides: Decides, tell: Tell = lambda text: None, last_word: bool = True) -> Carried:
        """From the line's file to where the chain ends, or `MOST_DEPLOYMENTS` redesigns are in service.

        `last_word`: the rules have it, as in production, with one more; a search is measured without.

        Raises TrialFailed, whatever goes wrong on the way.
        """
        task, began_s, processor_s = self.task, time.monotonic(), time.process_time()
        loop = SteppedLoop(task.line, task.begin, task.plant, task.seed)
        recipe = task.line.recipes[0]
        loop.begin_in_production(np.array(recipe.tension_n), recipe.speed_m_per_s)

        async def run(folder: Path) -> tuple[Commissioned, Controller, Noted]:
            async with SteppedGate(loop, folder, task.seed) as side:
                decider = Noted(decides(side, asyncio.get_running_loop()))
                found = await commission(
                    task.line, side, tell, wanted_m_per_s=TOP_M_PER_S, most_redesigns=MOST_DEPLOYMENTS,
                    decider=decider, last_word=last_word,
                )  # fmt: skip
                return found, (await side.now()).in_service, decider

        try:
            with tempfile.TemporaryDirectory() as folder:
                found, in_service, decider = asyncio.run(run(Path(folder)))
        except Exception as error:  # who decides is under test, and may raise anything
            raise TrialFailed(told(error), loop.truth.recorder.unsafe_total) from error
        return Carried(
            found, in_service, decider.asked, loop.truth.recorder.unsafe_total, loop.now_s,
            time.process_time() - processor_s, time.monotonic() - began_s,
        )  # fmt: skip

    def trial(self, policy: str, carried: Carried, interactions: list[Interaction]) -> Trial:
        """What is written down of it. `interactions`: with a language model; none where there was none."""
        found, end = carried.found, self.worth(carried.in_service)

        return Trial(
            policy=policy,
            reached=found.reached,
            converged=found.converged,
            end=found.text,
            iterations=len(found.tried),
            experiments=sum(one.kind == "experiment" and one.stage == "done" for one in found.tried),
            deployments=sum(one.step == Step.REDESIGN and one.stage == "kept" for one in found.tried),
            overruled=sum(
                one.step == Step.REDESIGN and one.rung >= BY_RULES and one.stage == "kept" for one in found.tried
            ),
            rejections=rejections(found.tried, interactions),
            asked=_asked(carried.asked, interactions),
            controller=config_hash(carried.in_service),
            rmse_n=end.rmse_n,
            to_truth=_over(end, self._truth),
            to_begin=_over(end, self._begin),
            stopped=end.stopped,
            unsafe_accepted=carried.unsafe_events + end.unsafe_events,
            line_s=carried.line_s,
            processor_s=carried.processor_s,
            wall_s=carried.wall_s,
        )

    def result(self, trials: list[Trial]) -> TaskResult:
        return TaskResult(
            number=self.task.number, seed=self.task.seed, plant=self.task.plant.name, begin_n=self._begin.rmse_n,
            truth_law=self._law, truth_n=self._truth.rmse_n, trials=trials,
        )  # fmt: skip


def failed_trial(policy: str, why: str, interactions: Sequence[Interaction] = (), unsafe_events: int = 0) -> Trial:
    """Of a chain that did not come to its end: nothing is reached, and there is nothing to measure."""
    return Trial(
        policy=policy, failed=True, reached=False, converged=False, end=f"failed: {why}", iterations=0, experiments=0,
        deployments=0, rejections=rejections([], interactions), asked=_asked([], interactions), controller="",
        rmse_n={}, to_truth={}, to_begin={}, stopped=[], unsafe_accepted=unsafe_events, line_s=0.0, processor_s=0.0,
        wall_s=0.0,
    )  # fmt: skip


def told(error: BaseException) -> str:
    """In one line, with its kind."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:MOST_LETTERS]


def _asked(asked: Sequence[tuple[Question, Decided]], interactions: Sequence[Interaction]) -> Asked:
    return Asked(
        questions=len(asked),
        answered=sum(decided.by != RULES for _, decided in asked),
        tokens_in=sum(one.tokens_in for one in interactions),
        tokens_out=sum(one.tokens_out for one in interactions),
        seconds=sum(one.seconds for one in interactions),
    )


def _over(one: Worth, other: Worth) -> dict[str, float]:
    return {case: one.rmse_n[case] / other.rmse_n[case] for case in one.rmse_n if case in other.rmse_n}
