"""What the gate has on record of the demonstration: candidates and their verdicts, who approved, swaps, the audit."""

from collections.abc import Sequence

import numpy as np

from gateway.cli.asked_result import asked_result
from gateway.cli.change_result import change_of
from gateway.cli.demo_analysis import Evidence
from gateway.cli.demo_chain import Chain
from gateway.cli.demo_line import Setup
from gateway.cli.demo_result import AuditResult, ChainResult, SwapResult
from gateway.cli.line_records import FAR_S, read_records
from gateway.core.interactions import Interaction
from gateway.core.signals import FloatArray
from gateway.supervisor.historian import FILE_NAME
from gateway.supervisor.history import History
from sim_plant.recording import Recording

AROUND_S = 1.0  #: a swap: half before it, half after it


def chain_result(setup: Setup, chain: Chain, evidence: Evidence, interactions: Sequence[Interaction]) -> ChainResult:
    """After every process has ended. `interactions`: with the agents."""
    found = chain.commissioned
    assert found is not None  # the chain was carried out
    records = read_records(setup.gateway_data)
    approved = {one.hash: step.who for one in records.proposals if (step := one.step("approved")) is not None}
    shown = {one.proposal_hash: one for one in chain.shown}
    limits, steps = setup.line.limits, _steps(evidence.recording)
    return ChainResult(
        reached=found.reached,
        text=found.text,
        changes=[
            change_of(
                one, shown.get(one.proposal), approved.get(one.proposal), chain.approved_over.get(one.proposal, "")
            )
            for one in found.tried
        ],
        asked=asked_result(interactions, chain.shown),
        deployments=sum(step.kind == "deployed" for one in records.proposals for step in one.steps),
        swaps=_swaps(setup, evidence, steps),
        step_allowed_nm=limits.torque_rate_nm_per_s * setup.line.control.period_s,
        step_elsewhere_nm=max(float(sizes.max(initial=0.0)) for _, sizes in steps),
        left_out=chain.left_out,
        audit=AuditResult(
            records=records.found.records,
            head=records.found.head,
            sound=records.found.sound,
            problems=records.found.problems,
        ),
    )


def _steps(recording: Recording) -> list[tuple[FloatArray, FloatArray]]:
    """By drive: when it was told another torque than before (k,), on CLOCK_MONOTONIC, and by how much (k,)."""
    commands: dict[int, list[tuple[float, float]]] = {roller: [] for roller in range(1, recording.spans + 1)}
    for event in recording.of_kind("command"):
        commands[event["roller"]].append((event["monotonic_s"], event["target_torque_nm"]))
    told = [np.array(one).reshape(-1, 2) for one in commands.values()]
    return [(one[1:, 0], np.abs(np.diff(one[:, 1]))) for one in told]


def _swaps(setup: Setup, evidence: Evidence, steps: Sequence[tuple[FloatArray, FloatArray]]) -> list[SwapResult]:
    start_s = float(evidence.history["time_s"][0])
    with History(setup.gateway_data / FILE_NAME) as file:
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
