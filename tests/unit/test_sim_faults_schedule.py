"""Faults in time: pure, so that a test reads as a story."""

from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_plant.faults.parse import FaultRefused, parse_fault
from sim_plant.faults.schedule import MOST_FAULTS, FaultSchedule


def told(schedule: FaultSchedule, now_s: float) -> list[tuple[str, bool, float]]:
    return [(c.entry.injection.fault.name, c.begins, pytest.approx(c.time_s)) for c in schedule.step(now_s)]


def test_a_fault_comes_and_goes_at_its_times():
    schedule = FaultSchedule()
    schedule.add(parse_fault("load-cell 3 nan at 12.5 for 0.2"), 0.0)
    assert schedule.due_s == 12.5
    assert told(schedule, 12.499) == []
    assert told(schedule, 12.5) == [("nan", True, 12.5)]
    assert schedule.due_s == pytest.approx(12.7)
    assert [entry.number for entry in schedule.acting] == [1]
    assert told(schedule, 20.0) == [("nan", False, 12.7)]
    assert schedule.due_s == inf and not schedule.acting


def test_what_ends_goes_before_what_begins_at_the_same_time():
    schedule = FaultSchedule()
    schedule.add(parse_fault("plc mute at 2 for 1"), 0.0)
    schedule.add(parse_fault("plc mute at 1 for 1"), 0.0)
    assert told(schedule, 5.0) == [
        ("mute", True, 1.0),
        ("mute", False, 2.0),
        ("mute", True, 2.0),
        ("mute", False, 3.0),
    ]


def test_the_same_fault_is_not_there_twice_at_one_time():
    schedule = FaultSchedule()
    schedule.add(parse_fault("drive 1 sto at 5"), 0.0)
    with pytest.raises(FaultRefused, match=r"fault 1 \(drive 1 sto at 5\) is in the way"):
        schedule.add(parse_fault("drive 1 sto at 9 for 1"), 0.0)
    with pytest.raises(FaultRefused, match=r"fault 1 \(drive 1 sto at 5\) is in the way"):
        schedule.add(parse_fault("drive 1 sto at 4"), 0.0)
    schedule.add(parse_fault("drive 1 sto at 4 for 1"), 0.0)
    schedule.add(parse_fault("drive 2 sto at 5"), 0.0)
    for _ in range(3):  # what happens once may happen again
        schedule.add(parse_fault("drive 1 restart at 5"), 0.0)


def test_two_faults_that_change_one_reading_exclude_each_other():
    schedule = FaultSchedule()
    schedule.add(parse_fault("load-cell 3 stuck at 5 for 1"), 0.0)
    with pytest.raises(FaultRefused, match="in the way"):
        schedule.add(parse_fault("load-cell 3 nan at 5.5 for 1"), 0.0)
    schedule.add(parse_fault("load-cell 3 nan at 6 for 1"), 0.0)
    schedule.add(parse_fault("load-cell 2 nan at 5 for 1"), 0.0)
    schedule.add(parse_fault("load-cell 3 mute at 5 for 1"), 0.0)


def test_a_time_that_has_passed_is_refused():
    schedule = FaultSchedule()
    with pytest.raises(FaultRefused, match="time is 3.000 s already"):
        schedule.add(parse_fault("drive 1 sto at 2"), 3.0)
    schedule.add(parse_fault("drive 1 sto at 3"), 3.0)
    assert told(schedule, 3.0) == [("sto", True, 3.0)]


def test_what_is_cleared_ends_and_what_waits_never_comes():
    schedule = FaultSchedule()
    acting = schedule.add(parse_fault("drive 1 sto"), 1.0)
    waiting = schedule.add(parse_fault("drive 2 sto at 9"), 1.0)
    schedule.add(parse_fault("drive 3 sto at 9"), 1.0)
    schedule.step(1.0)
    assert [(c.entry, c.begins) for c in schedule.take(acting.number, 2.0)] == [(acting, False)]
    assert schedule.take(waiting.number, 2.0) == []
    with pytest.raises(FaultRefused, match="there is no fault 1; waiting or acting: 3"):
        schedule.take(acting.number, 2.0)
    assert schedule.take(None, 2.0) == [] and schedule.due_s == inf
    with pytest.raises(FaultRefused, match="waiting or acting: none"):
        schedule.take(3, 2.0)


def test_there_is_a_bound():
    schedule = FaultSchedule()
    for k in range(MOST_FAULTS):
        schedule.add(parse_fault(f"drive 1 drive-fault at {k}"), 0.0)
    with pytest.raises(FaultRefused, match="already"):
        schedule.add(parse_fault("drive 1 drive-fault at 5000"), 0.0)


@given(
    st.lists(st.tuples(st.integers(1, 5), st.integers(0, 50), st.integers(1, 50) | st.none()), max_size=20),
    st.lists(st.integers(0, 120), max_size=20),
)
def test_every_fault_begins_once_ends_once_and_in_order(faults, looks):
    schedule = FaultSchedule()
    added = 0
    for drive, at, lasts in faults:
        text = f"drive {drive} sto at {at / 10}" + (f" for {lasts / 10}" if lasts else "")
        try:
            schedule.add(parse_fault(text), 0.0)
            added += 1
        except FaultRefused:
            pass
    changes = [change for look in sorted(looks) for change in schedule.step(look / 10)]
    changes += schedule.step(1e3)
    changes += schedule.take(None, 1e3)
    times = [change.time_s for change in changes]
    assert times == sorted(times)
    for number in range(1, added + 1):
        assert [c.begins for c in changes if c.entry.number == number] == [True, False]
