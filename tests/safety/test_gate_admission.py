"""Rules on who proposes what and when, on the state of the line, and on what a controller is made for."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.control.design import MpcWeights, design_lqi, design_mpc, task_of
from gateway.core.controller import config_hash
from gateway.core.line_model import model_hash
from gateway.core.proposal import proposal_hash
from safety.case import Case
from safety.findings import told
from safety.rules import authority, cool_down, fits_line, freshness, line_state
from tests.safety.case_support import EXPIRES, NOW, case_of, gains, proposal, refused, with_state


def test_authority(of, context, redesigned):
    def of_author(author, **gate):
        return refused(authority.check(case_of(gains(redesigned, context, author=author), context, of, **gate)))

    assert of_author("agents") == []
    assert "did you mean agents?" in of_author("agent")[0]
    assert "is closed" in of_author("agents", autonomy="closed")[0]
    assert len(of_author("nobody", autonomy="closed")) == 2


def test_authority_tells_who_may_propose_and_whom_somebody_may_have_meant(of, context, redesigned):
    def found(author, **gate):
        return authority.check(case_of(gains(redesigned, context, author=author), context, of, **gate))

    assert found("agents") == [told("authority", True, "agents may propose")]
    allowed = "allowed: gate.authors, which are rules, agents, engineer"
    closed = "gate.autonomy of the line's file is closed: nothing is changed on this line"
    assert found("agent") == [told("authority", False, f"author is agent; {allowed}; did you mean agents?")]
    assert found("zzz", autonomy="closed") == [
        told("authority", False, f"author is zzz; {allowed}"), told("authority", False, closed)
    ]  # fmt: skip


STALE = {
    "site": ({"site": "elsewhere"}, {}, "it is for elsewhere/line-1; allowed: this line, demo/line-1"),
    "base": (
        {"base": "0" * 64}, {},
        "it changes the configuration 000000000000; in service is {in_service}: propose anew from there",
    ),
    "model": ({"model": "0" * 64}, {}, "it was made by the model 000000000000; allowed: the model {accepted}"),
    "the file": ({"model": None}, {}, "it was made by the line's file; allowed: the model {accepted}"),
    "no model": (
        {"model": "0" * 64}, {"model": None},
        "it was made by the model 000000000000; allowed: the line's file: no model is accepted",
    ),
    "expired": (
        {}, {"now": EXPIRES},
        "it has expired: expires is 2026-08-03T15:05:00+00:00, now is 2026-08-03T15:05:00+00:00",
    ),
    "future": (
        {}, {"now": "2026-08-03T14:04:59+00:00"},
        "it comes from the future: created is 2026-08-03T14:05:00+00:00, now is 2026-08-03T14:04:59+00:00: look at the "
        "clocks",
    ),
    "for ever": (
        {"expires": "2026-08-04T14:05:01+00:00"}, {},
        "it would stand for 86401 s; allowed: gate.expiry_max_s, 86400 s",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", STALE)
def test_freshness(of, context, redesigned, name):
    given, surroundings, words = STALE[name]
    now = context.model_copy(update=surroundings)
    text = words.format(in_service=config_hash(context.in_service)[:12], accepted=model_hash(of.model)[:12])
    assert freshness.check(case_of(gains(redesigned, context, **given), now, of)) == [told("freshness", False, text)]


def test_what_is_just_fresh_passes_and_what_was_decided_does_not(of, context, redesigned):
    given = gains(redesigned, context, created=NOW, expires="2026-08-04T14:06:00+00:00")
    fresh = "it is about what is in service, and stands until 2026-08-04T14:06:00+00:00"
    assert freshness.check(case_of(given, context, of)) == [told("freshness", True, fresh)]
    decided = context.model_copy(update={"decided": [proposal_hash(given)]})
    again = Case(of.line, decided, given, proposal_hash(given), [of.recording], 1)
    assert refused(freshness.check(again)) == ["it has been decided already; allowed: a new proposal"]
    moved = {"kind": "model", "model": of.model.model_dump()}
    assert refused(freshness.check(case_of(proposal(moved, context, model=None), context, of))) == []


@pytest.mark.parametrize(("since_s", "passes"), [(None, True), (30.0, True), (29.9, False)])
def test_cool_down(of, context, redesigned, since_s, passes):
    now = with_state(context, since_change_s=since_s)
    assert (refused(cool_down.check(case_of(gains(redesigned, context), now, of))) == []) is passes


def test_cool_down_tells_when_it_was(of, context, redesigned):
    def found(since_s):
        now = with_state(context, since_change_s=since_s)
        (one,) = cool_down.check(case_of(gains(redesigned, context), now, of))
        return one.text, one.value, one.limit, one.unit

    assert found(None)[0] == "the line has not been changed yet"
    text = "the last change was 12.5 s ago; allowed: gate.cool_down_s, 30 s, and more"
    assert found(12.5) == (text, 12.5, 30.0, "s")


def test_state_of_the_line(of, context, redesigned):
    def found(check, **state):
        return refused(check(case_of(gains(redesigned, context), with_state(context, **state), of)))

    for state in ("RUN", "READY", "SILENT", "HOLD"):
        assert found(line_state.check_gains, state=state) == []
    stopped = "the line is in STOP; allowed: RUN, HOLD, READY, SILENT: arm it first"
    assert found(line_state.check_gains, state="STOP") == [stopped]
    assert "the line is in HOLD; allowed: RUN" in found(line_state.check_experiment, state="HOLD")[0]
    assert found(line_state.check_experiment) == [] == found(line_state.check_model, state="STOP", moving=True)
    everything = {
        "moving": True,
        "experiment": True,
        "on_probation": True,
        "doubts": ["cell 3", "cell 4"],
        "tension_n": [30.0],
    }
    probation = "a change is on probation: wait until it is kept or rolled back"
    assert found(line_state.check_gains, **everything) == [
        "what is measured is in doubt: cell 3; cell 4",
        probation,
        "an experiment is under way: wait for its end",
        "set-points or speed are on their way: wait until they stand",
        "state.tension_n has 1 entries; allowed: 6, one per span",
    ]
    assert line_state.check_gains(case_of(gains(redesigned, context), context, of)) == [
        told("state of the line", True, "set-points and speed stand, and what is measured is believed")
    ]
    assert found(line_state.check_model, on_probation=True) == [probation]
    assert line_state.check_model(case_of(gains(redesigned, context), context, of)) == [
        told("state of the line", True, "no change is on probation")
    ]


def test_set_points_of_another_number_than_spans_are_no_place_to_judge_from(of, context, redesigned):
    case = case_of(gains(redesigned, context), with_state(context, tension_n=[30.0]), of)
    with pytest.raises(ValueError, match="state.tension_n has 1 entries"):
        _ = case.tension_n


def test_a_proposal_is_of_one_kind(case, of, context):
    with pytest.raises(TypeError, match="has no experiment"):
        _ = case.experiment
    with pytest.raises(TypeError, match="has no model"):
        _ = case.model
    moved = case_of(proposal({"kind": "model", "model": of.model.model_dump()}, context), context, of)
    with pytest.raises(TypeError, match="has no controller"):
        _ = moved.controller


def test_a_controller_of_another_line(of, context, redesigned):
    def found(config, surroundings=context):
        return refused(fits_line.check(case_of(gains(config, context), surroundings, of)))

    assert found(redesigned) == []
    assert found(redesigned.model_copy(update={"latency_s": 0.02})) == []
    assert "latency of 0.0201 s" in found(redesigned.model_copy(update={"latency_s": 0.0201}))[0]
    assert found(redesigned, context.model_copy(update={"latency_s": 0.0201}))
    assert "period is 0.02 s" in found(redesigned.model_copy(update={"period_s": 0.02}))[0]
    assert "takes spans [1]" in found(redesigned.model_copy(update={"draw_spans": [1]}))[0]
    small = replace(task_of(of.line), model=replace(task_of(of.line).model, **first_spans(of.line, 2)),
                    tension_n=np.array([30.0, 30.0]))  # fmt: skip
    assert "is for 2 spans" in found(design_lqi(small))[0]


@pytest.mark.parametrize(("name", "told"), [("inertia_kg_m2", "J/R of section 3"), ("length_m", "L/EA of section 3")])
def test_a_feed_forward_far_too_large_would_drive_the_web_on_ramps_as_no_course_shows(
    name, told, of, context, redesigned
):
    def found(factor):
        own = redesigned.feedforward
        values = [value * (factor if i == 2 else 1.0) for i, value in enumerate(getattr(own, name))]
        changed = redesigned.model_copy(update={"feedforward": own.model_copy(update={name: values})})
        return refused(fits_line.check(case_of(gains(changed, context), context, of)))

    assert found(1.5) == found(0.1) == []
    (text,) = found(3.0)
    assert told in text


def first_spans(line, n):
    model = task_of(line).model
    return {name: getattr(model, name)[:n] for name in
            ("length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad")}  # fmt: skip


def test_a_predictive_controller_plans_with_the_limits_of_the_line(of, context):
    mpc = design_mpc(of.task(), MpcWeights())

    def found(**planned):
        return fits_line.check(case_of(gains(mpc.model_copy(update=planned), context), context, of))

    fits = [told("fits the line", True, "the controller is one for 6 spans at this period and latency")]
    limits = {"torque_nm": 60.0, "torque_rate_nm_per_s": 1000.0, "tension_max_n": 60.0}
    assert found() == fits == found(**limits)
    assert found(**{name: most * (1.0 + 1e-9) for name, most in limits.items()}) == fits, "rounding"
    assert refused(found(torque_nm=61.0, torque_rate_nm_per_s=1e5, tension_max_n=60.1)) == [
        "the controller plans with torque_nm 61 Nm; allowed: up to the line's 60 Nm",
        "the controller plans with torque_rate_nm_per_s 100000 Nm/s; allowed: up to the line's 1000 Nm/s",
        "the controller plans with tension_max_n 60.1 N; allowed: up to the line's 60 N",
    ]
