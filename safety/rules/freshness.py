"""The proposal is about the line as it is now: its base, its model and its time have not gone by."""

from collections.abc import Iterator
from datetime import datetime

from gateway.core.controller import config_hash
from gateway.core.line_model import model_hash
from gateway.core.verdict import RuleFinding
from safety.case import Case
from safety.findings import told

RULE = "freshness"
SHOWN = 12  #: letters of a hash


def check(case: Case) -> list[RuleFinding]:
    """One finding for each thing that is stale, or one that nothing is."""
    wrong = [*_wrong_line(case), *_wrong_base(case), *_wrong_time(case)]
    if not wrong:
        return [told(RULE, True, f"it is about what is in service, and stands until {case.proposal.expires}")]
    return [told(RULE, False, text) for text in wrong]


def _wrong_line(case: Case) -> Iterator[str]:
    proposal, line = case.proposal, case.line
    if (proposal.site, proposal.line) != (line.site, line.line):
        yield f"it is for {proposal.site}/{proposal.line}; allowed: this line, {line.site}/{line.line}"
    if case.hash in case.context.decided:
        yield "it has been decided already; allowed: a new proposal"


def _wrong_base(case: Case) -> Iterator[str]:
    proposal, context = case.proposal, case.context
    in_service = config_hash(context.in_service)
    if proposal.base != in_service:
        yield (
            f"it changes the configuration {proposal.base[:SHOWN]}; in service is {in_service[:SHOWN]}: propose anew "
            "from there"
        )
    accepted = None if context.model is None else model_hash(context.model)
    # Experiments and models may be made from the line's file alone.
    if proposal.model == accepted or (proposal.model is None and proposal.kind != "gains"):
        return
    made_by = "the line's file" if proposal.model is None else f"the model {proposal.model[:SHOWN]}"
    wanted = "the line's file: no model is accepted" if accepted is None else f"the model {accepted[:SHOWN]}"
    yield f"it was made by {made_by}; allowed: {wanted}"


def _wrong_time(case: Case) -> Iterator[str]:
    proposal, most_s = case.proposal, case.line.gate.expiry_max_s
    now = datetime.fromisoformat(case.context.now)
    created, expires = datetime.fromisoformat(proposal.created), datetime.fromisoformat(proposal.expires)
    if expires <= now:
        yield f"it has expired: expires is {proposal.expires}, now is {case.context.now}"
    if created > now:
        yield f"it comes from the future: created is {proposal.created}, now is {case.context.now}: look at the clocks"
    if not (expires - created).total_seconds() <= most_s:
        yield (
            f"it would stand for {(expires - created).total_seconds():g} s; allowed: gate.expiry_max_s, {most_s:g} s"
        )
