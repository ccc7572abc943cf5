"""The gate on a line that runs, with real processes: judged, approved, swapped, kept, rolled back, explained.

The recorder inside the simulated line judges what reached the web, the audit what anybody was told.
"""

import time

import numpy as np
import pytest

from gateway.control.design import design_lqg, task_of
from gateway.core.controller import canonical, config_hash
from gateway.core.decisions import ProposalShown
from gateway.supervisor.on_the_line import LEASE_S
from tests.closed_loop.gate_line import GateLine, largest_step_nm
from tests.closed_loop.wire import settled
from tests.support.recorder import require_safe

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(180)]

NEAR_N = 3.0  #: of its set-point: a tension that no swap has disturbed


@pytest.fixture
def line(tmp_path):
    with GateLine(tmp_path) as line:
        line.run()
        yield line


def world_s(line) -> float:
    return time.monotonic() - line.world_start_s


def test_a_proposal_is_judged_approved_runs_is_kept_and_another_is_taken_back(line):
    first, better = config_hash(line.first), design_lqg(task_of(line.line))
    began_s = world_s(line)
    file = line.folder / "better.json"
    file.write_bytes(canonical(better))
    shown = ProposalShown.model_validate_json(line.command("propose", file, "--reason", "a test", "--json"))
    proposal, verdict = shown.proposal_hash, shown.verdict
    assert verdict.accepted and verdict.region.speed_max_m_per_s == line.line.gate.first_speed_max_m_per_s
    assert line.in_service() == first  # accepted is not approved
    said = line.command("approve", proposal[:12], "--yes", "--comment", "a test")
    assert "on probation" in said and "no model is accepted" in said
    assert line.in_service() == config_hash(better)
    assert f"Gains {proposal[:12]} on probation since" in line.command("status")
    line.until(proposal, "kept")
    said = line.command(
        "configurations", "archive", config_hash(better), "--because", "a test", "--data-dir", line.data
    )
    assert said.startswith("phi_stable")
    assert proposal[:12] in line.command("proposals")
    again = line.approved(line.first)
    assert line.shown(again).why.startswith("not kept yet")
    assert line.roll_back().ok
    assert line.in_service() == config_hash(better)
    assert line.until(again, "rolled-back").why.startswith("asked for by")
    line.wait(settled)
    ended_s = world_s(line)
    recording = line.recording()
    here = (recording.time_s > began_s) & (recording.time_s < ended_s)
    limits = line.line.limits
    assert largest_step_nm(recording, began_s, ended_s) <= limits.torque_rate_nm_per_s * line.line.control.period_s
    tension_n = np.array(line.line.recipes[0].tension_n)
    assert np.abs(recording.tension_n[here] - tension_n).max() < NEAR_N
    require_safe(line.unsafe())
    assert "sound" in line.audit("verify")
    assert config_hash(better) in line.audit("show", "--kind", "archived")
    told = line.audit("show", "--id", proposal[:12])
    kinds = ["proposed", "accepted", "approved", "deploying", "deployed", "keeping", "kept"]
    places = [told.index(f"  {kind}  by ") for kind in kinds]
    assert places == sorted(places)


def test_the_gateway_dies_on_probation_the_loop_goes_back_by_itself_and_the_audit_explains_it(line):
    first, other = config_hash(line.first), design_lqg(task_of(line.line))
    began_s = world_s(line)
    proposal = line.approved(other)
    line.kill("gateway")
    line.children.end("gateway")
    killed_s = time.monotonic()
    line.look_on(line.in_service, lambda runs: runs == first, LEASE_S + 3.0)
    assert time.monotonic() - killed_s < LEASE_S + 2.0
    line.start_gateway()
    line.look_on(line.listed, lambda found: found is not None and found.in_service is not None)
    assert "lease" in line.until(proposal, "rolled-back", 10.0).why
    found = line.listed()
    assert (found.in_service, found.last_known_good, found.epoch) == (first, first, 1)
    line.wait(settled)
    ended_s = world_s(line)
    recording = line.recording()
    limits = line.line.limits
    assert largest_step_nm(recording, began_s, ended_s) <= limits.torque_rate_nm_per_s * line.line.control.period_s
    require_safe(line.unsafe())
    assert "sound" in line.audit("verify")
    told = line.audit("show", "--id", proposal[:12])
    assert "rolled-back" in told and "was not renewed" in told
