"""What an evaluation has shown, as data: `eval.json`. Schema in docs/schemas/eval.schema.json."""

from typing import Literal

from gateway.core.line import NonNegative, Strict

Policy = Literal["rules", "model", "nelder-mead", "random"]

#: Where something was refused, in the order in which it can be:
#: "unanswered"   the model gave no answer; `by`: late, broken ... (docs/agents.md); "no call": it could not be asked
#: "malformed"    an answer that is no JSON object
#: "not-offered"  an answer that names what the question does not offer, or is beyond its bounds
#: "unmade"       what was chosen cannot be made; `by`: the step of the chain
#: "refused"      by the gate; `by`: the first rule that failed
#: "aborted"      an experiment that did not come to its end; `by`: the step
#: "rolled-back"  on probation; `by`: the step
#: "other"        expired, rejected, not taken by the loop; `by`: the stage
Stage = Literal["unanswered", "malformed", "not-offered", "unmade", "refused", "aborted", "rolled-back", "other"]


class Rejections(Strict):
    stage: Stage
    by: str = ""
    times: int


class Asked(Strict):
    """What was asked of whoever was tried, and what it cost."""

    questions: int
    answered: int  #: not by the rules in its place
    tokens_in: int = 0
    tokens_out: int = 0
    seconds: NonNegative = 0.0  #: for answers


class Trial(Strict):
    """One task, carried out once under one policy."""

    policy: str  #: `Policy`; in a benchmark also the name of who is in the place of a model
    failed: bool = False  #: the chain did not come to an end; `end` says why
    reached: bool  #: an adapted configuration is in service
    converged: bool  #: the last measurement shows the criteria met, and nothing significant left to gain
    end: str  #: of the chain, in words
    iterations: int  #: candidates that were proposed, or could not be made
    experiments: int  #: that were run
    deployments: int  #: of redesigns that were kept
    overruled: int = 0  #: of those, in the end by the rules' own in the place of what was chosen
    rejections: list[Rejections]
    asked: Asked
    controller: str  #: hash of what is in service in the end
    rmse_n: dict[str, float]  #: by case, of that; a case that the line was stopped in has none
    to_truth: dict[str, float]  #: the same over that of the design on the truth
    to_begin: dict[str, float]  #: the same over that of what was in service at the begin
    stopped: list[str]  #: cases in which the gateway stopped the line, with the reason
    unsafe_accepted: int  #: unsafe events at the simulated drives, of the commissioning and the cases together
    line_s: NonNegative  #: that the line ran while it was commissioned
    processor_s: NonNegative
    wall_s: NonNegative


class TaskResult(Strict):
    number: int
    seed: int
    plant: str
    begin_n: dict[str, float]  #: RMSE by case of what is in service at the begin
    truth_law: str  #: of the redesign that the rules would make, were the truth their model
    truth_n: dict[str, float]  #: its RMSE by case
    trials: list[Trial]


class PolicyFigures(Strict):
    """Of all trials of a policy. Ratios are over all tasks and cases; null: there is none."""

    policy: str
    trials: int
    reached: int
    converged: int
    iterations: float  #: mean
    deployments: float  #: mean
    overruled: int = 0  #: redesigns that the rules have put in the place of what was chosen, in the end
    to_truth_p50: float | None
    to_truth_p95: float | None
    to_truth_worst: float | None
    to_begin_worst: float | None
    unsafe_accepted: int
    stopped: int  #: cases
    rejections: list[Rejections]
    asked: Asked
    processor_s: float  #: mean
    wall_s: float  #: mean


class EvalResult(Strict):
    format: Literal[1] = 1
    command: str
    date: str  #: ISO 8601
    machine: str
    versions: dict[str, str]
    model: str  #: its tag; "off": none
    digest: str  #: of its weights, where it has answered
    url: str  #: empty: none was asked
    seed: int
    spans: int
    tasks_asked: int
    complete: bool  #: false: interrupted; what was finished is here
    figures: list[PolicyFigures]
    tasks: list[TaskResult]
