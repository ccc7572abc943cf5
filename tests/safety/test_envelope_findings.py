"""What the envelope finds, by code and number, and how its counts run from period to period."""

import numpy as np
import pytest

from gateway.core.signals import DriveState, Quality
from safety.actions import Action, found
from safety.envelope import EnvelopeState, check_inputs, check_timing, check_torque
from tests.safety.envelope_support import EVERYTHING, LIMITS, TORQUE_FREE, findings_after, healthy, story

HOLD, STOP, BRAKE, OFF = Action.HOLD_OUTPUTS, Action.STOP, Action.BRAKE, Action.TORQUE_OFF


def line(**what):
    """A healthy line but for `what`: of a channel {index: value, or None for no sample}, of the PLC its fields."""
    inputs = healthy()
    for name, values in what.items():
        if name == "drives":
            for i, state in values.items():
                inputs.drive_state[i] = state
        elif name == "plc":
            for key, value in values.items():
                setattr(inputs.plc, key, value)
        else:
            channel = getattr(inputs, name)
            for i, value in values.items():
                channel.miss(i) if value is None else channel.put(i, value, 1.0)
    return inputs


def rejected(**what):
    """The same, with samples that came with these values and must not be used."""
    inputs = line(**what)
    for name, values in what.items():
        for i in values:
            getattr(inputs, name).reject(i)
    return inputs


BAND = {"low_n": 2.0, "high_n": 60.0}
SAID = [
    (1, line(tension={0: None}), found("signals-missing", HOLD, signals="T1", missed=1, periods=3)),
    (1, line(tension={0: None, 1: None}), found("signals-missing", HOLD, signals="T1, T2", missed=1, periods=3)),
    (3, line(speed={0: None, 2: None}, unwind_speed={0: None}),
     found("signals-missing", STOP, signals="v1, v3, v0", missed=3, periods=3)),
    (2, line(speed={0: None, 1: None, 2: None}), found("signals-missing", HOLD, signals="v1-v3", missed=2, periods=3)),
    (3, line(plc={"quality": Quality.STALE}), found("line-plc-silent", STOP, periods=3)),
    (1, line(plc={"emergency_stop": True, "permissive": False}), found("emergency-stop", OFF)),
    (1, line(plc={"permissive": False}), found("no-permissive", STOP)),
    (10, line(plc={"running": False}), found("transport-stopped", STOP)),
    (1, line(drives={0: DriveState.FAULT, 2: DriveState.STO}),
     found("drive-state", STOP, wanted="ENABLED", drives="1 FAULT, 3 STO")),
    (2, line(tension={0: 60.004}), found("tension-high", STOP, span=1, tension_n=60.004, **BAND)),
    (2, line(tension={1: 1.994}), found("slack", BRAKE, span=2, tension_n=1.994, **BAND)),
    (2, line(tension={1: 0.5}, speed={1: 0.06}), found("web-break", BRAKE, span=2, tension_n=0.5, **BAND)),
    (2, line(speed={1: -0.19}),
     found("roller-speed", OFF, roller=2, speed_m_per_s=-0.19, line_most_m_per_s=0.12)),
    (1, line(unwind_speed={0: 0.1325}), found("overspeed", STOP, speed_m_per_s=0.1325, allowed_m_per_s=0.12)),
]  # fmt: skip


@pytest.mark.parametrize(("periods", "inputs", "said"), SAID, ids=[f"{said.rule} {n}" for n, _, said in SAID])
def test_a_rule_says_what_is_wrong_and_where(periods, inputs, said):
    assert findings_after(periods, inputs) == [said]
    assert periods == 1 or said not in findings_after(periods - 1, inputs)


def findings_after_misses(*missed, supervision=EVERYTHING, state=None):
    """Findings of the last of the periods, in which a signal is missing where `missed` says so."""
    findings, state = [], state or EnvelopeState()
    for miss in missed:
        seen, state = check_inputs(LIMITS, state, line(tension={1: None}) if miss else healthy(), supervision)
        findings = seen.findings
    return findings, state


def test_misses_are_counted_over_twenty_periods_and_no_more():
    often = [1, 1, 0, 1, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0]
    (one,), _ = findings_after_misses(*often, 0, 1)
    assert one.action is HOLD
    (one,), _ = findings_after_misses(*often, 1, 1)
    assert one == found("signals-missing-often", STOP, signals="T2", missed=7, periods=20)
    (one,), _ = findings_after_misses(*often, 0, 1, 1)
    assert one.action is HOLD, "the first of seven is twenty periods ago"


def test_misses_count_from_when_the_law_is_engaged():
    six = [1, 1, 0, 1, 1, 0, 1, 0, 1]
    for before in ([0], [1, 1, 0, 1]):
        _, state = findings_after_misses(*before, supervision=TORQUE_FREE)
        (one,), _ = findings_after_misses(0, *six, state=state)
        assert one.action is HOLD


def test_a_plc_that_answered_again_is_missed_anew_and_so_is_its_transport():
    gone, stopped = line(plc={"quality": Quality.STALE}), line(plc={"running": False})
    assert story(healthy(), gone, gone, healthy(), gone, gone).findings == []
    assert [one.rule for one in story(healthy(), gone, gone, gone).findings] == ["line-plc-silent"]
    assert story(healthy(), *[stopped] * 9, healthy(), *[stopped] * 9).findings == []
    assert [one.rule for one in story(healthy(), *[stopped] * 10).findings] == ["transport-stopped"]


def test_what_is_out_of_the_band_is_counted_span_by_span():
    one, other = line(tension={0: 61.0}), line(tension={1: 61.0})
    assert story(one, other, one, other).findings == []
    (high,) = story(one, other, other).findings
    assert (high.rule, high.parameters["span"]) == ("tension-high", 2)


def test_a_sample_that_did_not_come_neither_counts_nor_excuses():
    tight, still_tight = line(tension={0: 61.0}), rejected(tension={0: 61.0})
    for unusable in (still_tight, rejected(tension={0: 30.0})):
        assert story(tight, unusable, unusable, supervision=TORQUE_FREE).findings == []
        (high,) = story(tight, unusable, tight, supervision=TORQUE_FREE).findings
        assert high.rule == "tension-high"


def test_a_state_of_a_shorter_line_is_refused():
    with pytest.raises(ValueError, match="zip"):
        check_inputs(LIMITS, EnvelopeState(outside=[1]), line(tension={0: 61.0}), EVERYTHING)


@pytest.mark.parametrize("span", [0, 1, 2])
@pytest.mark.parametrize(("before", "parting"), [(0.05, 0.0015), (-0.05, 0.0015), (0.02, 0.001), (0.0, 0.001)])
def test_a_broken_web_is_told_from_the_rollers_at_both_ends_of_the_span(span, before, parting):
    for more, rule in ((1e-6, "web-break"), (-1e-6, "slack")):
        unwinder_and_rollers = [before + 0.03] * 4
        unwinder_and_rollers[span : span + 2] = before, before + parting + more
        unwinder, *rollers = unwinder_and_rollers
        inputs = line(tension={span: 0.0}, speed=dict(enumerate(rollers)), unwind_speed={0: unwinder})
        assert [one.rule for one in findings_after(2, inputs)] == [rule]


def test_rollers_that_part_by_exactly_what_an_encoder_may_show_do_not_part():
    inputs = line(tension={0: 0.0}, speed={0: 0.001}, unwind_speed={0: 0.0})
    assert [one.rule for one in findings_after(2, inputs)] == ["slack"]


def test_an_overrun_says_how_many_periods_went_by():
    late, state = check_timing(LIMITS, EnvelopeState(), 6)
    assert late == [found("overrun", STOP, skipped=6, period_s=0.01, in_a_row=1)]
    for skipped in (1, 2):
        _, state = check_inputs(LIMITS, state, healthy(), EVERYTHING)  # between one period's overrun and the next
        late, state = check_timing(LIMITS, state, skipped)
    assert late == [found("overrun", STOP, skipped=2, period_s=0.01, in_a_row=3)]


def test_rollers_without_a_finite_torque_are_named():
    assert check_torque(np.array([np.nan, 1.0, np.inf])) == [found("torque-not-finite", OFF, rollers="1, 3")]
