"""The rows of the fault bench, some injections each; `make bench-faults` does the same many times."""

import pytest

from tests.bench.faults import JUDGED, task
from tests.bench.faults_rows import ROWS, Wanted
from tests.bench.faults_virtual import injections

#: What is seen later than the catalogue asks for, and when at the latest: frozen samples are told by their repeats, a
#: drive that does not hear is stopped by its own watchdog.
LATER_S = {"frozen": 0.1, "receiver-dead": 0.13}
BY_ID = {row.id: row for row in ROWS}
#: Injections of each row: its variants come in turn.
NUMBERS = {
    "frame-once": [0, 6, 12, 18], "frame-thrice": [1, 8, 19], "nmt": [0, 3], "stale-pdo": [0, 1],
    "torque-unlike": [0, 1, 2, 3, 4, 5], "drive-warning": [0, 1],
    "overrun-many": [2, 4], "overrun-few": [0, 4], "frame-twice": [0, 1, 2], "frame-corrupt": [0, 1, 2],
}  # fmt: skip
SLACK_PERIODS = 2  #: beyond a row's bound: the bench, which has no such slack, tells of each


@pytest.mark.parametrize("row_id", [row.id for row in ROWS if row.id not in LATER_S])
def test_a_fault_gets_the_reaction_that_the_catalogue_asks_for_and_nothing_unsafe_is_done(row_id):
    row = BY_ID[row_id]
    for injection in injections(row, NUMBERS.get(row_id, [0])):
        assert not injection.unsafe, injection
        if row.wanted is Wanted.SAFE:
            continue
        assert injection.reaction == row.wanted.value, injection
        if row.bound_s:
            assert injection.detected_s is not None, injection
            assert injection.detected_s <= row.bound_s + SLACK_PERIODS * 0.01, injection


@pytest.mark.parametrize("row_id", list(LATER_S))
def test_what_takes_longer_to_see_stops_the_line_all_the_same(row_id):
    for injection in injections(BY_ID[row_id], [0, 1, 2, 3]):
        assert injection.reaction == "stop" and not injection.unsafe, injection
        assert injection.detected_s is not None and injection.detected_s <= LATER_S[row_id], injection


@pytest.mark.parametrize("row_id", ["sdo-abort", "no-watchdog", "wall-clock"])
def test_what_is_not_about_a_running_line_comes_out_as_wanted(row_id):
    for injection in task(row_id, [0]):
        assert injection.reaction == JUDGED[row_id].wanted and not injection.unsafe, injection


@pytest.mark.parametrize("wiring", ["canopen", "modbus"])
def test_three_lost_answers_stop_a_line_of_another_wiring(wiring):
    for injection in task(f"frame-thrice@{wiring}", [0, 12]):
        assert injection.reaction == "stop" and not injection.unsafe, injection
        assert injection.detected_s is not None and injection.detected_s <= 0.05, injection


def test_an_injection_comes_out_the_same_every_time():
    first, second = (injections(BY_ID["heartbeat"], [3]) for _ in range(2))
    assert [(i.reaction, i.detected_s, i.torque_off_s) for i in first] == [
        (i.reaction, i.detected_s, i.torque_off_s) for i in second
    ]
