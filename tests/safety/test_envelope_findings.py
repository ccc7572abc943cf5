"""What the envelope says, word for word, and how its counts run from period to period."""

import numpy as np
import pytest

from gateway.core.signals import DriveState, Quality
from safety.actions import Action, Finding
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


CHECK = "check the device, its cable and its supply"
SAID = [
    (1, line(tension={0: None}), ("signals", HOLD, f"no usable sample of tension 1 in 1 periods of 3: {CHECK}")),
    (1, line(tension={0: None, 1: None}),
     ("signals", HOLD, f"no usable sample of tension 1 and 2 in 1 periods of 3: {CHECK}")),
    (3, line(speed={0: None, 2: None}, unwind_speed={0: None}),
     ("signals", STOP, f"no usable sample of speed 1 and 3, unwinder speed in 3 periods of 3: {CHECK}")),
    (2, line(speed={0: None, 1: None, 2: None}),
     ("signals", HOLD, f"no usable sample of speed 1 to 3 in 2 periods of 3: {CHECK}")),
    (3, line(plc={"quality": Quality.STALE}), ("line PLC", STOP, "the line PLC has not answered for 3 periods")),
    (1, line(plc={"emergency_stop": True, "permissive": False}),
     ("emergency stop", OFF, "the emergency stop circuit is open")),
    (1, line(plc={"permissive": False}), ("permissive", STOP, "the line PLC has withdrawn its permissive")),
    (10, line(plc={"running": False}),
     ("transport", STOP, "the line PLC has stopped the transport: read its fault")),
    (1, line(drives={0: DriveState.FAULT, 2: DriveState.STO}),
     ("drives", STOP, "drives that are not ENABLED: 1 FAULT, 3 STO: read their fault")),
    (2, line(tension={0: 60.004}), ("tension band", STOP, "tension 1 is 60.00 N, allowed is 2 to 60 N")),
    (2, line(tension={1: 1.994}), ("slack", BRAKE, "tension 2 is 1.99 N, allowed is 2 to 60 N")),
    (2, line(tension={1: 0.5}, speed={1: 0.06}),
     ("web break", BRAKE, "tension 2 is 0.50 N, allowed is 2 to 60 N, and roller 2 runs away from the one before: the "
                        "web has broken")),
    (2, line(speed={1: -0.19}),
     ("roller speed", OFF, "roller 2 runs at -0.190 m/s, the line's greatest speed is 0.12 m/s: is the web threaded "
                           "and whole?")),
    (1, line(unwind_speed={0: 0.1325}),
     ("overspeed", STOP, "the unwinder runs at 0.1325 m/s, allowed is 0.12 m/s")),
]  # fmt: skip


@pytest.mark.parametrize(("periods", "inputs", "said"), SAID, ids=[f"{said[0]} {n}" for n, _, said in SAID])
def test_a_rule_says_what_is_wrong_where_and_what_to_do(periods, inputs, said):
    assert findings_after(periods, inputs) == [Finding(*said)]
    assert periods == 1 or Finding(*said) not in findings_after(periods - 1, inputs)


def findings_after_misses(*missed, supervision=EVERYTHING, state=None):
    """Findings of the last of the periods, in which a signal is missing where `missed` says so."""
    found, state = [], state or EnvelopeState()
    for miss in missed:
        seen, state = check_inputs(LIMITS, state, line(tension={1: None}) if miss else healthy(), supervision)
        found = seen.findings
    return found, state


def test_misses_are_counted_over_twenty_periods_and_no_more():
    often = [1, 1, 0, 1, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0]
    (found,), _ = findings_after_misses(*often, 0, 1)
    assert found.action is HOLD
    (found,), _ = findings_after_misses(*often, 1, 1)
    assert (found.action, found.text) == (
        STOP, f"no usable sample of tension 2 in 7 of the last 20 periods: {CHECK}"
    )  # fmt: skip
    (found,), _ = findings_after_misses(*often, 0, 1, 1)
    assert found.action is HOLD, "the first of seven is twenty periods ago"


def test_misses_count_from_when_the_law_is_engaged():
    six = [1, 1, 0, 1, 1, 0, 1, 0, 1]
    for before in ([0], [1, 1, 0, 1]):
        _, state = findings_after_misses(*before, supervision=TORQUE_FREE)
        (found,), _ = findings_after_misses(0, *six, state=state)
        assert found.action is HOLD


def test_a_plc_that_answered_again_is_missed_anew_and_so_is_its_transport():
    gone, stopped = line(plc={"quality": Quality.STALE}), line(plc={"running": False})
    assert story(healthy(), gone, gone, healthy(), gone, gone).findings == []
    assert [one.rule for one in story(healthy(), gone, gone, gone).findings] == ["line PLC"]
    assert story(healthy(), *[stopped] * 9, healthy(), *[stopped] * 9).findings == []
    assert [one.rule for one in story(healthy(), *[stopped] * 10).findings] == ["transport"]


def test_what_is_out_of_the_band_is_counted_span_by_span():
    one, other = line(tension={0: 61.0}), line(tension={1: 61.0})
    assert story(one, other, one, other).findings == []
    assert [found.text for found in story(one, other, other).findings] == ["tension 2 is 61.00 N, allowed is 2 to 60 N"]


def test_a_sample_that_did_not_come_neither_counts_nor_excuses():
    tight, still_tight = line(tension={0: 61.0}), rejected(tension={0: 61.0})
    for unusable in (still_tight, rejected(tension={0: 30.0})):
        assert story(tight, unusable, unusable, supervision=TORQUE_FREE).findings == []
        (found,) = story(tight, unusable, tight, supervision=TORQUE_FREE).findings
        assert found.rule == "tension band"


def test_a_state_of_a_shorter_line_is_refused():
    with pytest.raises(ValueError, match="zip"):
        check_inputs(LIMITS, EnvelopeState(outside=[1]), line(tension={0: 61.0}), EVERYTHING)


@pytest.mark.parametrize("span", [0, 1, 2])
@pytest.mark.parametrize(("before", "parting"), [(0.05, 0.0015), (-0.05, 0.0015), (0.02, 0.001), (0.0, 0.001)])
def test_a_broken_web_is_told_from_the_rollers_at_both_ends_of_the_span(span, before, parting):
    for more, rule in ((1e-6, "web break"), (-1e-6, "slack")):
        unwinder_and_rollers = [before + 0.03] * 4
        unwinder_and_rollers[span : span + 2] = before, before + parting + more
        unwinder, *rollers = unwinder_and_rollers
        inputs = line(tension={span: 0.0}, speed=dict(enumerate(rollers)), unwind_speed={0: unwinder})
        assert [found.rule for found in findings_after(2, inputs)] == [rule]


def test_rollers_that_part_by_exactly_what_an_encoder_may_show_do_not_part():
    inputs = line(tension={0: 0.0}, speed={0: 0.001}, unwind_speed={0: 0.0})
    assert [found.rule for found in findings_after(2, inputs)] == ["slack"]


def test_an_overrun_says_how_many_periods_went_by_and_what_helps():
    found, state = check_timing(LIMITS, EnvelopeState(), 6)
    helps = "take load off this computer or give the loop real-time priority"
    assert found == [
        Finding("overrun", STOP, f"missed 6 periods of 10 ms at once, 1 times in a row: {helps}")
    ]  # fmt: skip
    for skipped in (1, 2):
        _, state = check_inputs(LIMITS, state, healthy(), EVERYTHING)  # between one period's overrun and the next
        found, state = check_timing(LIMITS, state, skipped)
    assert [one.text for one in found] == [f"missed 2 periods of 10 ms at once, 3 times in a row: {helps}"]


def test_rollers_without_a_finite_torque_are_named():
    (found,) = check_torque(np.array([np.nan, 1.0, np.inf]))
    assert found == Finding("finite torque", OFF, "the control law gave no finite torque for roller 1, 3")
