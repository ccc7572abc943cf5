"""A proposal and what became of it, in short: who, why, by how many rules, and the rule that decided."""

from collections.abc import Sequence

from gateway.cli.commission_result import Tried, candidate_name
from gateway.cli.demo_result import ChangeResult, RuleResult
from gateway.core.audit_record import Who
from gateway.core.controller import config_hash
from gateway.core.decisions import ProposalShown
from gateway.core.proposal import GainsChange
from gateway.core.verdict import RuleFinding


def change_of(tried: Tried, shown: ProposalShown | None, approved: Who | None = None, over: str = "") -> ChangeResult:
    """`approved`: by whom, as the audit has it; None: nobody. `over`: what they had read, where that is known."""
    findings = [] if shown is None or shown.verdict is None else shown.verdict.findings
    change = None if shown is None else shown.proposal.change
    return ChangeResult(
        step=tried.step or tried.kind,
        name=candidate_name(tried.rung),
        proposal=tried.proposal,
        configuration=config_hash(change.controller) if isinstance(change, GainsChange) else "",
        author="" if shown is None else shown.proposal.author,
        reason="" if shown is None else shown.proposal.reason,
        stage=tried.stage,
        why=tried.why,
        rules=len(findings),
        against=[f"{one.rule}: {one.text}" for one in findings if not one.passed],
        closest=closest_of(findings),
        measured="" if tried.shown is None else tried.shown.text,
        approved_by="" if approved is None else approved.name,
        certificate="" if approved is None or approved.certificate is None else approved.certificate,
        approved_over=over,
        speed_m_per_s=tried.speed_m_per_s,
    )


def closest_of(findings: Sequence[RuleFinding]) -> RuleResult | None:
    """The first rule that failed; of rules that all passed the one whose margin is the smallest share of its limit."""
    failed = [one for one in findings if not one.passed]
    narrow = sorted((one for one in findings if one.margin is not None and one.limit), key=_share)
    found = next(iter(failed or narrow), None)
    if found is None:
        return None
    return RuleResult(
        rule=found.rule, passed=found.passed, value=found.value, limit=found.limit, margin=found.margin,
        unit=found.unit,
    )  # fmt: skip


def _share(one: RuleFinding) -> float:
    assert one.margin is not None and one.limit
    return one.margin / abs(one.limit)
