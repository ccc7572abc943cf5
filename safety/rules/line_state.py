"""The line is in a state in which it may be changed, or moved for an experiment."""

from collections.abc import Iterator

from gateway.core.verdict import RuleFinding
from safety.case import Case
from safety.findings import told

RULE = "state of the line"


def check_gains(case: Case) -> list[RuleFinding]:
    """A controller is exchanged while nothing moves and everything is believed."""
    state = case.context.state.state
    wrong = [] if state != "STOP" else ["the line is in STOP; allowed: RUN, HOLD, READY, SILENT: arm it first"]
    return _told([*wrong, *_doubtful(case), *_standing(case)])


def check_experiment(case: Case) -> list[RuleFinding]:
    """An experiment needs a line that runs."""
    state = case.context.state.state
    wrong = [] if state == "RUN" else [f"the line is in {state}; allowed: RUN, at the set-points from which it begins"]
    return _told([*wrong, *_doubtful(case), *_standing(case)])


def check_model(case: Case) -> list[RuleFinding]:
    """A model moves nothing, but a change under watch is watched by the model of before."""
    if case.context.state.on_probation:
        return [told(RULE, False, "a change is on probation: wait until it is kept or rolled back")]
    return [told(RULE, True, "no change is on probation")]


def _doubtful(case: Case) -> Iterator[str]:
    state = case.context.state
    if state.doubts:
        yield f"what is measured is in doubt: {'; '.join(state.doubts)}"
    if state.on_probation:
        yield "a change is on probation: wait until it is kept or rolled back"


def _standing(case: Case) -> Iterator[str]:
    state = case.context.state
    if state.experiment:
        yield "an experiment is under way: wait for its end"
    if state.moving:
        yield "set-points or speed are on their way: wait until they stand"
    if len(state.tension_n) != case.line.n:
        yield f"state.tension_n has {len(state.tension_n)} entries; allowed: {case.line.n}, one per span"


def _told(wrong: list[str]) -> list[RuleFinding]:
    return [told(RULE, False, text) for text in wrong] or [
        told(RULE, True, "set-points and speed stand, and what is measured is believed")
    ]
