"""What the gate has on record of the demonstration: candidates and their verdicts, who approved, swaps, the audit."""

from collections.abc import Sequence

import numpy as np

from gateway.cli.commission_result import Tried, candidate_name
from gateway.cli.demo_analysis import Evidence
from gateway.cli.demo_asked import asked_result
from gateway.cli.demo_chain import Chain
from gateway.cli.demo_line import Setup
from gateway.cli.demo_result import AuditResult, ChainResult, ChangeResult, RuleResult, SwapResult
from gateway.core.audit_record import Who
from gateway.core.controller import config_hash
from gateway.core.decisions import ProposalShown
from gateway.core.interactions import Interaction
from gateway.core.proposal import GainsChange
from gateway.core.signals import FloatArray
from gateway.core.verdict import RuleFinding
from gateway.supervisor.audit_file import AuditFile
from gateway.supervisor.audit_verify import verify
from gateway.supervisor.historian import FILE_NAME
from gateway.supervisor.history import History
from sim_plant.recording import Recording

AROUND_S = 1.0  #: a swap: half before it, half after it
FAR_S = 4e9  #: beyond any wall clock


def chain_result(setup: Setup, chain: Chain, evidence: Evidence, interactions: Sequence[Interaction]) -> ChainResult:
    """After every process has ended. `interactions`: with the agents."""
    found = chain.commissioned
    assert found is not None  # the chain was carried out
    approved, deployments = _decided(setup)
    shown = {one.proposal_hash: one for one in chain.shown}
    limits, steps = setup.line.limits, _steps(evidence.recording)
    return ChainResult(
        reached=found.reached,
        text=found.text,
        changes=[
            _change(one, shown.get(one.proposal), approved.get(one.proposal), chain.approved_over.get(one.proposal, ""))
            for one in found.tried
        ],
        asked=asked_result(interactions, chain.shown),
        deployments=deployments,
        swaps=_swaps(setup, evidence, steps),
        step_allowed_nm=limits.torque_rate_nm_per_s * setup.line.control.period_s,
        step_elsewhere_nm=max(float(sizes.max(initial=0.0)) for _, sizes in steps),
        left_out=chain.left_out,
        audit=audit_result(setup),
    )


def audit_result(setup: Setup) -> AuditResult:
    """As `r2rgate audit verify` finds it."""
    found = verify(setup.data)
    return AuditResult(records=found.records, head=found.head, sound=found.sound, problems=found.problems)


def _change(tried: Tried, shown: ProposalShown | None, approved: Who | None, over: str) -> ChangeResult:
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
        closest=_closest(findings),
        measured="" if tried.shown is None else tried.shown.text,
        approved_by="" if approved is None else approved.name,
        certificate="" if approved is None or approved.certificate is None else approved.certificate,
        approved_over=over,
        speed_m_per_s=tried.speed_m_per_s,
    )


def _closest(findings: Sequence[RuleFinding]) -> RuleResult | None:
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


def _decided(setup: Setup) -> tuple[dict[str, Who], int]:
    """By proposal who approved it, and how often anything was deployed."""
    with AuditFile(setup.data) as file:
        records = [row.record() for row in file.rows()]
    approved = {str(one.what["proposal"]): one.who for one in records if one.kind == "approved"}
    return approved, sum(one.kind == "deployed" for one in records)


def _steps(recording: Recording) -> list[tuple[FloatArray, FloatArray]]:
    """By drive: when it was told another torque than before (k,), on CLOCK_MONOTONIC, and by how much (k,)."""
    commands: dict[int, list[tuple[float, float]]] = {roller: [] for roller in range(1, recording.spans + 1)}
    for event in recording.of_kind("command"):
        commands[event["roller"]].append((event["monotonic_s"], event["target_torque_nm"]))
    told = [np.array(one).reshape(-1, 2) for one in commands.values()]
    return [(one[1:, 0], np.abs(np.diff(one[:, 1]))) for one in told]


def _swaps(setup: Setup, evidence: Evidence, steps: Sequence[tuple[FloatArray, FloatArray]]) -> list[SwapResult]:
    start_s = float(evidence.history["time_s"][0])
    with History(setup.data / FILE_NAME) as file:
        deployed = [event for event in file.events(0.0, FAR_S) if event.kind == "deployed"]
    return [
        SwapResult(
            configuration=str(event.data["hash"]),
            at_s=event.time_s - start_s,
            largest_step_nm=_largest(steps, event.time_s),
            before_nm=_largest(steps, event.time_s - AROUND_S),
        )
        for event in deployed
    ]


def _largest(steps: Sequence[tuple[FloatArray, FloatArray]], at_s: float) -> float:
    """Within half of `AROUND_S` of `at_s`."""
    return max(float(sizes[np.abs(time_s - at_s) <= 0.5 * AROUND_S].max(initial=0.0)) for time_s, sizes in steps)
