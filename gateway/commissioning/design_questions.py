"""What phase 1 asks before any candidate is known: which model, which architecture, which weights. And at its end: C*.

The weights are asked for first, so that nobody fits them to a candidate that they have in mind.
"""

from collections.abc import Mapping, Sequence
from typing import Literal

from gateway.commissioning.architectures import ARCHITECTURES
from gateway.commissioning.assessment import COUPLED, Assessment
from gateway.commissioning.selection import CLOSE, Candidate, performance_of, ranked
from gateway.control.design import DesignRefused, DesignTask, margins
from gateway.core.line import Line, Priorities
from gateway.core.questions import Figure, Knob, Option, Question, figure

LINEARISED, NONLINEAR = "linearised", "nonlinear"
SHARES = (0.1, 0.5, 1.0)  #: of the line's greatest speed, at which a design that follows the speed is linearised
PRIORITIES = "priorities"
LEAST, MOST = 0.5, 2.0  #: times a weight of the line's file
FIRST = "lqi"  #: the rules' architecture: the default of docs/control.md
MOST_LETTERS = 600

_WEIGHTS = {
    "rmse_per_n": "tracking error counts for more",
    "settling_per_s": "settling time counts for more",
    "overshoot_per_pct": "overshoot counts for more",
    "effort_per_n2m2s": "torque, and so energy and wear, counts for more",
    "robustness_per_n": "what a model that is wrong within its tolerances does counts for more",
    "compute_per_s": "computing time counts for more",
}


def model_question(line: Line, found: Assessment, names: Sequence[str], speeds_m_per_s: Sequence[float]) -> Question:
    """Whether one linear model does for the designs. `speeds_m_per_s`: over which gains are wanted to follow; none."""
    one = Option(
        id=LINEARISED,
        title="one design, on the model linearised at the operating point, serves all speeds; it is tried on the full, "
        "nonlinear model",
    )
    several = Option(
        id=NONLINEAR,
        title="the model changes too much with the speed: it is linearised at several, and gains follow the speed; "
        "without mpc, whose programme belongs to one model; it is tried on the full, nonlinear model",
    )
    if speeds_m_per_s:
        options, why = [several], "gains that follow the speed are asked for"
    elif found.gains_move is None or not can_follow(names):
        options, why = [one], "there is no design that follows the speed here"
    else:
        small = (
            "small: a linear design is good" if found.linearised else "not small: what simulation says is what counts"
        )
        options = [one, several]
        why = f"the nonlinear terms are {100.0 * found.strain:.2g} % of E A, {small}; gains that follow the speed are "
        why += "advised, for a person to ask for" if found.schedule else "not called for"
    return _question(
        line, "design.model", "on which model controllers are designed", found.sentences, options, options[0].id, why,
        figures=_assessed(found),
    )  # fmt: skip


def can_follow(names: Sequence[str]) -> list[str]:
    """Those of the architectures whose gains can follow the speed."""
    return [name for name in names if name != "mpc"]


def schedule_of(line: Line) -> tuple[float, ...]:
    """Speeds in m/s at which a design that follows the speed is made."""
    return tuple(share * line.limits.speed_max_m_per_s for share in SHARES)


def architecture_question(
    line: Line, found: Assessment, task: DesignTask, names: Sequence[str], speeds_m_per_s: Sequence[float] = ()
) -> Question:
    """Which architecture the line calls for: the others are tuned all the same, with fewer questions."""
    return _question(
        line, "design.architecture",
        "which architecture the line calls for: most is asked about its tuning; the others are tuned and compared, too",
        found.sentences,
        [_architecture(name, found, task, speeds_m_per_s) for name in names],
        FIRST if FIRST in names else names[0],
        "it leaves no offset, and needs no model of the noise" if FIRST in names else "it is named first",
        figures=_assessed(found),
    )  # fmt: skip


def weights_question(line: Line, found: Assessment) -> Question:
    """By how much the weights of the score are turned, to see what would be chosen then."""
    given = line.priorities.model_dump()
    return _question(
        line, "design.weights",
        "whether the weights of the score S should be others than the line's file has; S under both is told where the "
        "controller is chosen",
        found.sentences,
        [Option(id=PRIORITIES, title="the weights of the line's file, times the factors")],
        PRIORITIES,
        "an engineer has written them into the line's file",
        figures=[figure(f"weight {name}", value) for name, value in given.items()],
        knobs=[Knob(name=name, meaning=meaning, least=LEAST, most=MOST) for name, meaning in _WEIGHTS.items()],
    )  # fmt: skip


def weighed(priorities: Priorities, factors: Mapping[str, float]) -> Priorities:
    """With weights times `factors`, by name."""
    given = priorities.model_dump()
    return priorities.model_copy(update={name: given[name] * factor for name, factor in factors.items()})


def selection_question(line: Line, candidates: Sequence[Candidate], said: Sequence[str]) -> Question:
    """Which of `candidates` that can be chosen, one at least, is C*. `said`: of those that cannot, and of scores."""
    order = [one for one in ranked(candidates) if one.can_be_chosen]
    return _question(
        line, "design.selection", "which controller is chosen for the line",
        [*said, f"scores that differ by less than {CLOSE:.0%} are as good as equal on a line"],
        [_candidate(one) for one in order],
        order[0].architecture,
        "its score S, by the weights of the line's file, is the least",
    )  # fmt: skip


def _candidate(one: Candidate) -> Option:
    assert one.trial is not None and one.compute_s is not None  # it has a score
    found = performance_of(one.trial, one.compute_s)
    assert found is not None
    other = [] if one.score_otherwise is None else [figure("S by the weights that were proposed", one.score_otherwise)]
    return Option(
        id=one.architecture, title=one.title,
        figures=[
            figure("score S by the line's weights", one.score),
            *other,
            figure("root of the mean square of the tension's deviation", found.rmse_n, "N"),
            figure("settling time", found.settling_s, "s"),
            figure("overshoot", found.overshoot_pct, "%"),
            figure("effort", found.effort_n2m2s, "(Nm)2s"),
            figure("robustness: how far any of the lines is from the model's course", found.robustness_n, "N"),
            figure("computing time of a step", 1e3 * found.compute_s, "ms"),
            figure("more delay that it stands", 1e3 * one.trial.delay_margin_s, "ms"),
            figure("change of torque from period to period by noise", one.trial.chatter_nm, "Nm"),
        ],
    )  # fmt: skip


def _architecture(name: str, found: Assessment, task: DesignTask, speeds_m_per_s: Sequence[float]) -> Option:
    architecture = ARCHITECTURES[name]
    said = "; ".join([architecture.title, *_for_and_against(name, found)])
    try:
        looked = margins(architecture.design(task, architecture.first(task), speeds_m_per_s), task)
    except DesignRefused as refused:
        return Option(id=name, title=f"{said}; its first guess is refused: {refused}"[:MOST_LETTERS])
    if looked.spectral_radius >= 1.0:
        return Option(id=name, title=f"{said}; its first guess is unstable"[:MOST_LETTERS])
    return Option(
        id=name, title=said[:MOST_LETTERS],
        figures=[
            figure("more delay that the first guess stands", 1e3 * looked.delay_margin_s, "ms"),
            figure("its slowest mode", 1.0 / looked.decay_per_s if looked.decay_per_s > 0.0 else None, "s"),
            figure("its change of torque from period to period by noise", looked.chatter_nm, "Nm"),
            figure("what noise leaves of its tension deviation", looked.noise_floor_n, "N"),
        ],
    )  # fmt: skip


def _for_and_against(name: str, found: Assessment) -> list[str]:
    """What the assessment says."""
    match name:
        case "pid":
            meet = (
                "and fight each other where spans are coupled as here"
                if found.coupling > COUPLED
                else "which is no matter here"
            )
            return [f"for it: few numbers that a person can read; against it: loops are tuned one by one, {meet}"]
        case "lqr":
            return ["for it: the simplest; against it: an offset stays wherever the model is wrong"]
        case "lqi":
            return ["for it: no offset, and no model of the noise is needed; against it: integrals wind up at a limit"]
        case "lqg":
            return ["for it: quick on disturbances, little moved by noise; against it: it is as good as the noise that "
                    "is believed"]  # fmt: skip
        case _:
            use = f"the first recipe at full speed takes {found.torque_use:.0%} of the torque"
            return [f"for it: it knows of limits beforehand, and {use}; against it: a step takes its time"]


def _assessed(found: Assessment) -> list[Figure]:
    return [
        figure("time constant of the fastest mode", found.fastest_s, "s"),
        figure("time constant of the slowest mode", found.slowest_s, "s"),
        figure("dead time", 1e3 * found.dead_time_s, "ms"),
        figure("what a torque does to a neighbour's tension, of what it does to its own", found.coupling),
        figure("greatest tension over E A: the size of the nonlinear terms", found.strain),
        figure("change of an LQI's gains over the speeds, relative", found.gains_move),
        figure("torque to hold the first recipe at full speed, of the limit", found.torque_use),
    ]


def _question(
    line: Line, decision: Literal["design.model", "design.architecture", "design.weights", "design.selection"],
    task: str, said: Sequence[str], options: list[Option], usual: str, why: str,
    *, figures: Sequence[Figure] = (), knobs: Sequence[Knob] = (),
) -> Question:  # fmt: skip
    limits = line.limits
    facts = [
        f"the line has {line.n} spans; tensions may be {limits.tension_min_n:g} to {limits.tension_max_n:g} N, "
        f"torques up to {limits.torque_nm:g} Nm, the speed up to {limits.speed_max_m_per_s:g} m/s",
        *said,
    ]
    return Question(
        format=1, site=line.site, line=line.line, decision=decision, task=task,
        facts=[one[:MOST_LETTERS] for one in facts], figures=list(figures), options=options, usual=usual, why=why,
        knobs=list(knobs),
    )  # fmt: skip
