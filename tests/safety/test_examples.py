"""The published context, proposal and verdict belong together: `r2rgate judge` makes the one from the others.

`python -m tests.safety.test_examples` writes them anew.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gateway.cli.recordings import read_recording
from gateway.cli.recordings_csv import write_csv
from gateway.control.design import design_lqg, design_lqi, task_of, task_on
from gateway.core.judge_context import canonical as context_bytes
from gateway.core.judge_context import parse_context
from gateway.core.line_file import load_line
from gateway.core.line_model import noise_of, theta_of
from gateway.core.proposal import canonical as proposal_bytes
from gateway.core.recording import Recording
from gateway.core.verdict import Verdict, canonical
from safety.judge import judge
from tests.closed_loop.recorded import real_plant, recorded
from tests.safety.case_support import Setting, gains, modelled

EXAMPLES = Path("docs/examples")
DATA = "judge-context.csv"
SEED = 1


@pytest.fixture(scope="module")
def line():
    return load_line((EXAMPLES / "line.toml").read_text(), "line.toml")


def verdict(line):
    context = parse_context((EXAMPLES / "judge-context.json").read_bytes())
    recordings = [read_recording(EXAMPLES / one.path) for one in context.data]
    return judge((EXAMPLES / "proposal.json").read_bytes().strip(), context, line, recordings, SEED)


def test_the_published_verdict_is_what_the_judge_says_of_the_published_proposal(line):
    published = Verdict.model_validate_json((EXAMPLES / "verdict.json").read_bytes())
    found = verdict(line)
    assert published.accepted and found.accepted, found.reasons
    names = [finding.rule for finding in published.findings + published.reported]
    assert [finding.rule for finding in found.findings + found.reported] == names
    assert (found.proposal, found.payload, found.context) == (published.proposal, published.payload, published.context)
    assert found.line == published.line and found.region == published.region
    for old, new in zip(published.findings, found.findings, strict=True):
        assert new.value == (None if old.value is None else pytest.approx(old.value, rel=1e-2, abs=1e-4)), old.rule


def rounded(recording: Recording) -> Recording:
    """With no more digits than the sensors have."""
    digits = {
        "tension_n": 3, "tension_setpoint_n": 3, "speed_m_per_s": 6, "torque_nm": 3, "torque_actual_nm": 3,
        "unwind_speed_m_per_s": 6, "time_s": 4,
    }  # fmt: skip
    return replace(recording, **{name: np.round(getattr(recording, name), d) for name, d in digits.items()})


def write() -> None:
    line = load_line((EXAMPLES / "line.toml").read_text(), "line.toml")
    recording = rounded(recorded(real_plant(), 5, 2.6, line=line))
    with (EXAMPLES / DATA).open("w") as file:
        write_csv(recording, file)
    model = modelled(replace(recording, source="experiment of 14:00"), line)
    setting = Setting(line, recording, model)
    context = setting.context(in_service=design_lqi(task_of(line)))
    context = context.model_copy(update={"data": [context.data[0].model_copy(update={"path": DATA})]})
    given = gains(
        design_lqg(task_on(line, theta_of(model), noise_of(model))), context,
        reason="Redesigned on the model of this afternoon: the line's web is softer and its bearings are stiffer.",
        evidence=[{"what": "normalised innovation squared of the model, held out", "value": 1.02}],
        predicted=[{"scenario": "tension", "rmse_n": 27.5}], author="agents",
    )  # fmt: skip
    (EXAMPLES / "judge-context.json").write_bytes(
        json.dumps(json.loads(context_bytes(context)), indent=1).encode() + b"\n"
    )
    (EXAMPLES / "proposal.json").write_bytes(proposal_bytes(given) + b"\n")
    found = verdict(line)
    print("\n".join(found.reasons) or "accepted")
    (EXAMPLES / "verdict.json").write_bytes(canonical(found) + b"\n")


if __name__ == "__main__":
    write()
