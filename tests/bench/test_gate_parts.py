"""Parts of bench-gate by themselves: proposals, mutations, our own reading of bytes, which half a line is of."""

import json
from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest

from gateway.control.design import design_lqg, design_lqi, design_pid, task_of
from gateway.core.controller import Controller, ControllerRefused
from gateway.core.controller_laws import LqiConfig
from gateway.core.line_model import model_of
from gateway.core.proposal import ProposalRefused, parse_proposal
from gateway.core.recording import Recording
from tests.bench import gate, gate_mutations, gate_schema
from tests.bench.gate_adversary import STEPS, chain
from tests.bench.gate_contexts import GateLine, context_of, payload_of
from tests.bench.gate_plants import is_for_tuning
from tests.bench.gate_proposals import CLASSES, proposals
from tests.bench.gate_runs import LineBench, Tried
from tests.closed_loop.recorded import demonstration_line, real_plant
from tests.independent.gate_judge import model_error
from tests.independent.truth import plain_truth, truth_of
from tests.unit.model_support import fields

LINE = demonstration_line()
TASK = task_of(LINE)
LQI = design_lqi(TASK)


def a_recording() -> Recording:
    nothing, each = np.zeros(3), np.zeros((3, 6))
    return Recording(nothing, each, each, each, each, each, nothing, np.ones(3, dtype=bool), 0.01, "none")


@pytest.fixture(scope="module")
def line() -> GateLine:
    plant = real_plant()
    return GateLine(
        1, plant, truth_of(plant), LINE, a_recording(), model_of(fields(6)), TASK, design_pid(TASK), LQI, LQI, LQI
    )  # fmt: skip


def test_shares_of_the_classes_are_a_whole() -> None:
    assert sum(share for share, _ in CLASSES.values()) == pytest.approx(1.0)


def test_every_class_makes_proposals_that_can_be_parsed(line: GateLine) -> None:
    found = proposals(line, 60, 1)
    assert {one.class_name for one in found} == set(CLASSES)
    context = context_of(line, line.initial, line.initial)
    for one in found:
        proposal = parse_proposal(payload_of(one.change, context, LINE))
        assert proposal.n == LINE.n
        assert proposal.kind == one.change.kind


def test_the_same_seed_makes_the_same_proposals(line: GateLine) -> None:
    first, second, other = (proposals(line, 8, seed) for seed in (1, 1, 2))
    assert first == second
    assert first != other


@pytest.mark.parametrize("config", [LQI, design_lqg(TASK), design_pid(TASK)], ids=["lqi", "lqg", "pid"])
def test_a_mutation_changes_what_it_says_and_nothing_else(config: Controller) -> None:
    generator = np.random.default_rng(0)
    for change in (gate_mutations.corrupted, gate_mutations.sign_flipped, gate_mutations.unit_confused):
        before, after = gate_mutations.document_of(config), None
        while after is None:
            with suppress(ControllerRefused):
                after = gate_mutations.document_of(change(config, generator))
        assert {key for key in before if before[key] != after[key]} <= {
            "feedforward", "predictor", *(key for key in before if key.startswith("gain")),
        }  # fmt: skip
    noisy = gate_mutations.noisy(config, 0.1, generator)
    for old, new in zip(*(gate_mutations.matrices(gate_mutations.document_of(one), gains_only=True)
                          for one in (config, noisy)), strict=True):  # fmt: skip
        before, after = np.array(old[0][old[1]]), np.array(new[0][new[1]])
        assert np.abs(after - before).max() <= 0.1 * np.abs(before).max() + 1e-12


def test_feedback_is_scaled_whole() -> None:
    scaled = gate_mutations.scaled_all(LQI, -2.0)
    assert isinstance(scaled, LqiConfig) and isinstance(LQI, LqiConfig)
    assert np.array(scaled.gain_state) == pytest.approx(-2.0 * np.array(LQI.gain_state))
    assert np.array(scaled.gain_integral) == pytest.approx(-2.0 * np.array(LQI.gain_integral))
    assert scaled.feedforward == LQI.feedforward


def test_our_own_reading_takes_valid_proposals_and_no_others() -> None:
    for payload in gate_schema.valid_proposals():
        document = json.loads(payload)
        assert gate_schema.why_none(payload, document) == ""
        assert gate_schema.why_none(payload[:-1], document)
        assert gate_schema.why_none(payload + b"{}", document)
        assert "twice" in gate_schema.why_none(payload.replace(b'{"author"', b'{"author":"x","author"', 1), document)
        assert gate_schema.why_none(payload.replace(b'"format":1', b'"format":true', 1), document)
        assert gate_schema.why_none(payload.replace(b'"format":1', b'"format":NaN', 1), document)
        assert gate_schema.why_none(payload.replace(b'"format":1', b'"format":1,"x":1', 1), document)
        assert gate_schema.why_none(payload.replace(b'"line":"line-1",', b"", 1), document)


def test_mutated_bytes_are_taken_only_where_they_are_a_proposal() -> None:
    found = gate_schema.mutated(3, 1500)
    assert found.tried == found.refused + found.right + len(found.wrong) + len(found.failed)
    assert found.wrong == []
    assert found.failed == []
    assert found.right > 0 and found.refused > 1000


def test_halves_have_no_line_in_common() -> None:
    tuning, test = gate.numbers(10, "tuning"), gate.numbers(11, "test")
    assert not set(tuning) & set(test)
    assert 0 in test, "S_real is scored"
    assert all(is_for_tuning(number) for number in tuning)


def test_how_wrong_a_model_is() -> None:
    truth = plain_truth(real_plant())
    assert model_error(model_of(fields(6)), truth) == pytest.approx(0.0, abs=1e-12)
    assert model_error(model_of(fields(6)), truth.scaled(inertia_kg_m2=1.25)) == pytest.approx(0.25)


def a_verdict(*, accepted: bool, unsafe: str = "", good: bool = False, against: tuple[str, ...] = ()) -> Tried:
    findings = [("corners: chatter", accepted, 1.0, 2.0)]
    return Tried(1, "wrong model", "plain", "gains", "lqi", accepted, list(against), findings, [], unsafe, good, "",
                 0.1, 0.1)  # fmt: skip


def test_tables_count_what_was_accepted_by_class_and_stopped_by_rule() -> None:
    tried = [
        a_verdict(accepted=False, unsafe="swings", against=("decay",)),
        a_verdict(accepted=False, unsafe="swings", against=("corners", "decay")),
        a_verdict(accepted=False, good=True, against=("corners",)),
        a_verdict(accepted=True, good=True),
    ]
    rows = {row[0]: row for row in gate.by_class(tried)["rows"]}
    assert rows["wrong model"] == ("wrong model", 4, "0/2", "1/2", "0/0")
    by_rule = {row[0]: row[1:5] for row in gate.by_rule(tried)["rows"]}
    assert by_rule == {"decay": (2, 1, 0, 0), "corners": (1, 0, 1, 1)}


def test_a_proposal_nested_without_end_is_refused_not_stumbled_over() -> None:
    with pytest.raises(ProposalRefused, match="64 deep"):
        parse_proposal(b'{"x":' + b"[" * 500 + b"]" * 500 + b"}")


def test_a_wrong_choice_deep_inside_a_proposal_is_refused_in_words() -> None:
    experiment = gate_schema.valid_proposals()[-1]
    with pytest.raises(ProposalRefused, match="shape"):
        parse_proposal(experiment.replace(b'"shape":"binary"', b'"shape":"binry"'))


def test_an_adversary_whom_nobody_stops_makes_a_line_unsafe(line: GateLine, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = LineBench(line)
    monkeypatch.setattr(bench, "judged", lambda *_: SimpleNamespace(accepted=True))
    found = chain(bench, 0)
    assert found.unsafe
    assert found.badness[0] < 1.0 <= found.badness[-1]
    monkeypatch.setattr(bench, "judged", lambda *_: SimpleNamespace(accepted=False))
    stopped = chain(bench, 0)
    assert stopped.unsafe == ""
    assert stopped.steps == [0] * STEPS
