"""The judge as a whole: what it accepts, what it refuses and why, and that it says the same again."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.control.design import LqgWeights, design_lqg, design_lqi, design_lqr, task_of
from gateway.core.experiment import Abort, Experiment, Leg
from gateway.core.proposal import canonical as proposal_bytes
from gateway.core.proposal import proposal_hash
from gateway.core.verdict import canonical
from safety import judge as judging
from safety.judge import failed, judge, refusal
from safety.rules.table import RULES, Rule
from tests.safety.case_support import gains, proposal, verdict_of


def against(verdict):
    """Names of the rules that were not passed."""
    return {finding.rule for finding in verdict.findings if not finding.passed}


@pytest.mark.parametrize("design", [design_lqi, design_lqg])
def test_a_design_on_the_identified_model_is_accepted_for_the_speeds_that_data_have_shown(of, context, design):
    verdict = verdict_of(gains(design(of.task()), context), context, of)
    assert verdict.accepted, verdict.reasons
    assert verdict.region.speed_max_m_per_s == pytest.approx(0.051, abs=2e-4)
    assert verdict.region.tension_step_max_n == of.line.limits.tension_step_max_n
    assert {(one.configuration, one.scenario) for one in verdict.figures} == {
        (whose, name) for whose in ("in service", "proposed") for name in ("tension", "velocity", "moves")
    }
    assert {one.rule for one in verdict.reported} - {"draws"} == {
        "paper: C_safe", "paper: P_improved", "paper: S_robust", "paper: approve",
    }  # fmt: skip


def test_the_same_again_gives_the_same_and_another_seed_other_numbers(of, context, redesigned):
    given = gains(redesigned, context)
    first, again, other = (canonical(verdict_of(given, context, of, seed)) for seed in (3, 3, 4))
    assert first == again
    assert first != other


def test_a_line_without_a_model_takes_its_first_configuration_for_low_speed_and_small_steps(of):
    context = of.context(model=None, data=[])
    verdict = verdict_of(gains(design_lqi(task_of(of.line)), context), context, of)
    assert verdict.accepted, verdict.reasons
    gate = of.line.gate
    assert verdict.region.speed_max_m_per_s == gate.first_speed_max_m_per_s
    assert verdict.region.tension_step_max_n == gate.first_step_max_n
    assert not verdict.reported and not verdict.figures


def turned_round(config):
    return config.model_copy(update={"gain_state": (-np.array(config.gain_state)).tolist()})


def one_entry(config, name, row, column, factor):
    matrix = np.array(getattr(config, name))
    matrix[row, column] *= factor
    return config.model_copy(update={name: matrix.tolist()})


SPOILED = {
    "sign": turned_round,
    "all in other units": lambda c: c.model_copy(update={"gain_state": (1e3 * np.array(c.gain_state)).tolist()}),
    "without end": lambda c: c.model_copy(update={"gain_state": (1e300 * np.array(c.gain_state)).tolist()}),
    "a speed's gain": lambda c: one_entry(c, "gain_state", 2, 8, 10.0),
    "a speed's sign": lambda c: one_entry(c, "gain_state", 0, 6, -1.0),
    "an integral's": lambda c: one_entry(c, "gain_integral", 3, 3, -1.0),
    "a torque in flight": lambda c: one_entry(c, "gain_input", 1, 1, -20.0),
    "feed-forward": lambda c: c.model_copy(
        update={"feedforward": c.feedforward.model_copy(update={"friction_nms_per_rad": [1500.0] * 6})}
    ),
}


@pytest.mark.parametrize("name", SPOILED)
def test_spoiled_gains_are_refused_by_what_they_would_do(of, context, redesigned, name):
    verdict = verdict_of(gains(SPOILED[name](redesigned), context), context, of)
    assert not verdict.accepted
    assert verdict.region is None
    simulated = ("decay", "delay margin", "corners", "improvement")
    assert any(rule.startswith(simulated) for rule in against(verdict)), against(verdict)
    assert not any("failed" in reason for reason in verdict.reasons), verdict.reasons


def test_gains_that_stand_no_delay_and_make_the_torque_chatter_are_refused_for_that(of, context):
    hasty = design_lqg(of.task(), LqgWeights(torque_per_nm2=1e-4, disturbance_nm_per_sqrt_s=20.0))
    assert {"delay margin", "corners: chatter"} <= against(verdict_of(gains(hasty, context), context, of))


def test_what_promises_too_much_is_refused(of, context, redesigned):
    promised = [{"scenario": "tension", "rmse_n": 1.0}, {"scenario": "lunch"}]
    verdict = verdict_of(gains(redesigned, context, predicted=promised), context, of)
    assert against(verdict) == {"promises", "promises: tracking error"}
    assert any("lunch is no course of the gate" in reason for reason in verdict.reasons)


def test_the_speed_at_which_the_line_runs_must_have_been_seen(of, context, redesigned):
    faster = context.model_copy(update={"state": context.state.model_copy(update={"speed_m_per_s": 0.1})})
    verdict = verdict_of(gains(redesigned, faster), faster, of)
    assert against(verdict) == {"model validity"}
    assert "run an experiment at 0.1 m/s" in verdict.reasons[0]


def test_without_recent_data_the_refusal_asks_for_an_experiment(of, redesigned):
    context = of.context(data=[])
    verdict = verdict_of(gains(redesigned, context), context, of)
    assert {"model validity", "alignment"} <= against(verdict)
    assert any("run an experiment" in reason for reason in verdict.reasons)


def test_a_model_that_does_not_hold_any_more_judges_nothing(of):
    wrong = of.model.parameters.model_copy(update={"friction_nms_per_rad": [16.5] * 6})
    context = of.context(model=of.model.model_copy(update={"parameters": wrong}))
    verdict = verdict_of(gains(design_lqi(of.task()), context), context, of)
    assert "model validity" in against(verdict)


def test_data_that_are_not_those_of_the_context_are_judged_by_nobody(of, context, redesigned):
    payload = proposal_bytes(gains(redesigned, context))
    none = judge(payload, context, of.line, [], 1)
    assert against(none) == {"data"} and "0 recordings were given" in none.reasons[0]
    other = replace(of.recording, torque_nm=of.recording.torque_nm + 1e-6)
    assert "is not the recording" in judge(payload, context, of.line, [other], 1).reasons[0]
    named = [one.model_copy(update={"digest": "0123456789abcdef" * 4}) for one in context.data]
    verdict = judge(payload, context.model_copy(update={"data": named}), of.line, [other], 1)
    assert verdict.reasons == [
        f"{named[0].path} is not the recording that the context names: its digest is {other.digest()[:12]}; allowed: "
        "0123456789ab"
    ]
    assert (verdict.proposal, verdict.kind) == (proposal_hash(gains(redesigned, context)), "gains")


def test_a_rule_that_fails_and_one_that_finds_nothing_are_refusals(of, context, redesigned, monkeypatch):
    def broken(case):
        raise ZeroDivisionError("by nothing")

    rules = (Rule("broken", broken), Rule("silent", lambda case: []))
    monkeypatch.setitem(RULES, "gains", rules)
    monkeypatch.setattr(judging, "FIGURES", {"gains": broken})
    verdict = verdict_of(gains(redesigned, context), context, of)
    assert verdict.reasons == [
        "rule broken failed: ZeroDivisionError: by nothing",
        "rule silent found nothing, which is no yes",
    ]


def test_a_parser_that_fails_is_a_refusal(of, context, monkeypatch):
    def broken(payload, most):
        raise RuntimeError("out of words")

    monkeypatch.setattr(judging, "parse_proposal", broken)
    verdict = judge(b"{}", context, of.line, [of.recording], 1)
    assert verdict.reasons == ["rule format failed: RuntimeError: out of words"]
    assert refusal(b"{}", context, of.line, 1, "time", "too late").proposal is None


def test_what_could_not_be_judged_is_refused_by_name(of, context, redesigned):
    given = proposal_bytes(gains(redesigned, context))
    late = refusal(given, context, of.line, 7, "time", "none came")
    assert (late.accepted, late.kind, late.seed, late.reasons) == (False, "gains", 7, ["none came"])
    stumbled = failed(given, context, of.line, 7, KeyError("x"))
    assert stumbled.reasons == ["rule judge failed: KeyError: 'x'"]


def test_of_what_is_larger_than_the_line_takes_nothing_is_read(of, context, redesigned):
    given = proposal_bytes(gains(redesigned, context))

    def read(most_bytes):
        gate = of.line.gate.model_copy(update={"proposal_max_bytes": most_bytes})
        late = refusal(given, context, of.line.model_copy(update={"gate": gate}), 7, "time", "none came")
        assert late.reasons == ["none came"]
        return late.kind

    assert read(len(given)) == "gains" and read(len(given) - 1) is None


def experiment(**changes):
    fields = {
        "format": 1, "amplitude_n": [1.0] * 6, "dwell_s": 0.1, "legs": [Leg(duration_s=2.0, speed_m_per_s=0.06)],
        "abort": Abort(deviation_n=10.0),
    }  # fmt: skip
    return {"kind": "experiment", "experiment": Experiment(**{**fields, **changes}).model_dump()}


def test_an_experiment_needs_no_model_and_little_room(of):
    context = of.context(model=None, data=[])
    verdict = verdict_of(proposal(experiment(), context), context, of)
    assert verdict.accepted, verdict.reasons


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"amplitude_n": [12.0] * 6, "abort": Abort(deviation_n=18.0)}, "experiment: deviation"),
        ({"abort": Abort(deviation_n=19.0)}, "experiment: abort"),
        ({"amplitude_n": [0.0] * 5 + [40.0], "abort": Abort(deviation_n=50.0)}, "experiment: limits"),
        ({"legs": [Leg(duration_s=2.0, speed_m_per_s=0.2)]}, "experiment: limits"),
    ],
)
def test_an_experiment_that_would_go_too_far_is_refused(of, changes, rule):
    context = of.context(model=None, data=[])
    verdict = verdict_of(proposal(experiment(**changes), context), context, of)
    assert rule in against(verdict), verdict.reasons


def test_an_experiment_is_judged_on_the_accepted_model_where_data_bear_it_out(of, context):
    verdict = verdict_of(proposal(experiment(), context), context, of)
    assert verdict.accepted, verdict.reasons
    assert any("corners of the accepted model" in one.text for one in verdict.findings)


def model_change(model):
    return {"kind": "model", "model": model.model_dump()}


def test_a_model_is_accepted_by_its_data_and_by_newer_ones(of):
    context = of.context(model=None)
    verdict = verdict_of(proposal(model_change(of.model), context), context, of)
    assert verdict.accepted, verdict.reasons
    older = of.model.model_copy(
        update={"created": "2026-08-03T13:00:00+00:00", "data": of.model.data.model_copy(update={"digest": "5a" * 32})}
    )
    assert verdict_of(proposal(model_change(older), context), context, of).accepted


def of_parameters(model, **changes):
    return model.model_copy(update={"parameters": model.parameters.model_copy(update=changes)})


def inertias(model):
    return model.parameters.inertia_kg_m2


def of_noise(model, **factors):
    noise = {name: getattr(model.noise, name) * factor for name, factor in factors.items()}
    return model.model_copy(update={"noise": model.noise.model_copy(update=noise)})


def of_posterior(model, factor):
    covariance = (factor * np.array(model.posterior.covariance)).tolist()
    return model.model_copy(update={"posterior": model.posterior.model_copy(update={"covariance": covariance})})


POISONED = {
    "stiffer": (lambda m: of_parameters(m, stiffness_n=1.05 * m.parameters.stiffness_n), "model: shift"),
    "one roller": (
        lambda m: of_parameters(m, inertia_kg_m2=[1.1 * j if i == 0 else j for i, j in enumerate(inertias(m))]),
        "model: residuals",
    ),
    "out of the prior": (lambda m: of_parameters(m, radius_m=[0.08] * 6), "model: bounds"),
    "noisy": (lambda m: of_noise(m, tension_n=2.0, speed_m_per_s=2.0), "model: noise"),
    "quiet": (lambda m: of_noise(m, acceleration_m_per_s1_5=0.5), "model: noise"),
    "sure": (lambda m: of_posterior(m, 0.01), "model: sureness"),
    "intervals": (lambda m: of_posterior(m, 100.0), "model: sureness"),
    "lag": (lambda m: of_parameters(m, torque_lag_s=0.006), "model: alignment"),
    "other data": (
        lambda m: m.model_copy(update={"data": m.data.model_copy(update={"digest": "5a" * 32})}),
        "model: data",
    ),
    "too fast": (
        lambda m: m.model_copy(update={"region": m.region.model_copy(update={"speed_to_m_per_s": 0.12})}),
        "model: data",
    ),
    "no noise": (lambda m: m.model_copy(update={"noise": None}), "model: residuals"),
}  # fmt: skip


@pytest.mark.parametrize("name", POISONED)
def test_a_poisoned_model_is_refused(of, name):
    change, rule = POISONED[name]
    context = of.context(model=None)
    verdict = verdict_of(proposal(model_change(change(of.model)), context), context, of)
    assert rule in against(verdict), verdict.reasons


def test_a_worse_model_does_not_replace_a_better_one(of, context):
    wrong = of_parameters(of.model, friction_nms_per_rad=[1.02 * f for f in of.model.parameters.friction_nms_per_rad])
    verdict = verdict_of(proposal(model_change(wrong), context), context, of)
    assert "model: held-out prediction" in against(verdict)


def test_a_law_without_integral_action_that_leaves_the_web_off_is_refused(of, context):
    weak = design_lqr(of.task())
    off = weak.feedforward.model_copy(update={"friction_nms_per_rad": [1.0] * 6})
    verdict = verdict_of(gains(weak.model_copy(update={"feedforward": off}), context), context, of)
    assert "corners: error" in against(verdict)


def test_a_line_with_a_draw_span_takes_its_first_configuration(of):
    spans = [span.model_copy(update={"control": "draw"}) if i == 2 else span for i, span in enumerate(of.line.spans)]
    drawn = replace(of, line=of.line.model_copy(update={"spans": spans}))
    context = drawn.context(model=None, data=[])
    verdict = verdict_of(gains(context.in_service, context), context, drawn)
    assert verdict.accepted, verdict.reasons
