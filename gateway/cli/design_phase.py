"""Phase 1 of a line, composed: what is asked first, algorithm 1 for each architecture, the comparison, the choice."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gateway.cli.asked_in_time import InTime
from gateway.cli.design_tuning import Finished, Tuning, step_time_s, tuned_in_workers
from gateway.commissioning.architectures import ARCHITECTURES
from gateway.commissioning.assessment import Assessment, assess
from gateway.commissioning.beforehand import Beforehand
from gateway.commissioning.belief import words_on
from gateway.commissioning.decisions import RULES, Decided, Decider, Rules
from gateway.commissioning.design_questions import (
    NONLINEAR,
    architecture_question,
    can_follow,
    model_question,
    schedule_of,
    selection_question,
    weighed,
    weights_question,
)
from gateway.commissioning.ground import Ground, ground_of
from gateway.commissioning.records import Attempt, DecisionRecord, decision_record
from gateway.commissioning.selection import Candidate, candidate, explanation, ranked
from gateway.core.controller import config_hash
from gateway.core.line import Line, Priorities
from gateway.core.line_model import LineModel, model_hash
from gateway.core.line_problem import quoted
from gateway.core.questions import Choice, Question, factors_that_turn, usual_choice
from gateway.core.scenario import Scenario

BOX_PLANTS = 8  #: within the tolerances, beside the nominal model, for every final figure
#: Attempts that somebody is asked about: of the architecture that they have named, and of each other. A model on a
#: line's own computer takes half a minute for each.
MOST_ASKED, LESS_ASKED = 8, 2
ANSWER_S = 900.0  #: for any question, where the caller knows no better

RULES_DECIDE = Rules()


@dataclass(frozen=True)
class Design:
    """The outcome of phase 1."""

    assessment: Assessment
    ground: Ground
    finished: list[Finished]
    candidates: list[Candidate]  #: ranked
    explanation: list[str]
    decisions: list[DecisionRecord]  #: in their order; those of the tuning stand with its attempts
    priorities_otherwise: Priorities | None  #: weights that somebody has proposed; None: nobody has
    chosen: Finished | None  #: C*; None: nothing can be offered


def run_design(
    line: Line,
    scenarios: Sequence[Scenario],
    names: Sequence[str],
    iterations: int,
    seed: int,
    on_attempt: Callable[[str, Attempt], None],
    speeds_m_per_s: Sequence[float] = (),
    model: LineModel | None = None,
    decider: Decider = RULES_DECIDE,
    answer_s: float = ANSWER_S,
    on_decision: Callable[[DecisionRecord], None] = lambda decision: None,
    gate: Beforehand | None = None,
) -> Design:
    """Tune, compare, choose, on the line's nominal model or on `model`. Raises DesignRefused where none can begin.

    `decider` is asked wherever there is something to choose; it has `answer_s` for each question, and where it fails
    the rules decide. `gate`: by which candidates are judged beforehand.
    """
    ground = ground_of(line, scenarios, BOX_PLANTS, seed, speeds_m_per_s, model)
    assessment = assess(line, ground.task)
    asking = _Asking(InTime(decider, answer_s), on_decision)
    if asking.of(model_question(line, assessment, names, speeds_m_per_s)).option == NONLINEAR and not speeds_m_per_s:
        names, speeds_m_per_s = can_follow(names), schedule_of(line)
        ground = ground_of(line, scenarios, BOX_PLANTS, seed, speeds_m_per_s, model)
    first = asking.of(architecture_question(line, assessment, ground.task, names, speeds_m_per_s)).option
    factors = factors_that_turn(asking.of(weights_question(line, assessment)))
    otherwise = weighed(line.priorities, factors) if factors else None
    if model is not None:
        said = words_on(model, f"model {model_hash(model)[:12]}", scenarios)
        assessment = assessment.model_copy(update={"sentences": [*said, *assessment.sentences]})
    questions = {name: MOST_ASKED if name == first else LESS_ASKED for name in names}
    how = Tuning(line.site, line.line, iterations, questions, gate)
    finished = tuned_in_workers(ground, how, asking.decider, on_attempt)
    candidates = ranked([_candidate(one, ground, line, otherwise) for one in finished])
    chosen = _chosen(line, candidates, asking)
    return Design(
        assessment, ground, finished, candidates, _explained(candidates, chosen, asking.decisions), asking.decisions,
        otherwise, next((one for one in finished if one.architecture == chosen), None),
    )  # fmt: skip


class _Asking:
    """Asks where there is a choice, and keeps what was decided."""

    def __init__(self, decider: Decider, on_decision: Callable[[DecisionRecord], None]) -> None:
        self.decider = decider
        self.decisions: list[DecisionRecord] = []
        self._on_decision = on_decision

    def of(self, question: Question) -> Choice:
        only = len(question.options) == 1 and not question.knobs
        decided = Decided(usual_choice(question), RULES) if only else self.decider.decide(question)
        self.decisions.append(decision_record(question, decided))
        self._on_decision(self.decisions[-1])
        return decided.choice


def _chosen(line: Line, candidates: Sequence[Candidate], asking: _Asking) -> str:
    """The architecture of C*; "" where nothing can be offered."""
    if not candidates[0].can_be_chosen:
        return ""
    return asking.of(selection_question(line, candidates, explanation(candidates))).option


def _explained(candidates: Sequence[Candidate], chosen: str, decisions: Sequence[DecisionRecord]) -> list[str]:
    if not chosen or decisions[-1].by == RULES:
        return explanation(candidates)
    last = decisions[-1]
    return [*explanation(candidates, chosen, last.by), f"{last.by} says: {quoted(last.reason)}"]


def _candidate(one: Finished, ground: Ground, line: Line, otherwise: Priorities | None) -> Candidate:
    architecture = ARCHITECTURES[one.architecture]
    return candidate(
        architecture.name,
        architecture.title,
        one.values,
        config_hash(one.config) if one.config else "",
        one.trial,
        step_time_s(one.config, ground) if one.config else None,
        one.refused,
        line.priorities,
        otherwise,
        one.gate,
    )
