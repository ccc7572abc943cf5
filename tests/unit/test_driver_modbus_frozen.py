"""A drive whose answers stand still: found when its torque command moves, and never at standstill."""

from typing import cast

from hypothesis import given
from hypothesis import strategies as st

from drivers.device_map import MAPS, load_map
from drivers.modbus.axis import Axis, AxisSettings
from drivers.modbus.device import Standing
from drivers.modbus.frozen import ANSWERS_ALLOWED, COUNTS_ALLOWED
from drivers.modbus.maps import DriveMap
from gateway.core.signals import DriveRequest, DriveState, Inputs, Outputs, Quality

SETTINGS = AxisSettings(channel=1, rated_torque_nm=80.0, torque_limit_nm=60.0, watchdog_s=0.1, radius_m=0.04)
NM_PER_COUNT = 0.08
ENABLED = 0x1237


class Cycles:
    """An axis that is enabled, and what is asked of it cycle by cycle."""

    def __init__(self) -> None:
        self.axis = Axis("drive-1", 0, cast(DriveMap, load_map(MAPS / "r2r-drive-modbus.toml")), SETTINGS)
        self.inputs = Inputs(1)
        self.standing = Standing(active=True, wrote=True)
        self.cycle(0, 0)

    def cycle(self, commanded: int, shown: int, request: DriveRequest = DriveRequest.ENABLE) -> list[str]:
        """A torque command in counts, and the answer to it: the torque that is shown, at standstill."""
        outputs = Outputs(1)
        outputs.drive_request[:], outputs.torque_nm[:] = request, commanded * NM_PER_COUNT
        self.axis.command(outputs)
        return self.axis.fill(self.inputs, [ENABLED, 0, shown, 0, 0], self.standing, 1.0)


def test_answers_that_stand_still_while_the_command_moves_are_missed_until_one_moves() -> None:
    cycles = Cycles()
    cycles.cycle(100, 100)
    for k in range(ANSWERS_ALLOWED):
        assert cycles.cycle(100 + COUNTS_ALLOWED + 1 + k, 100) == [] and cycles.inputs.speed.good()
    for _ in range(3):
        (trouble,) = cycles.cycle(120, 100)
        assert trouble.startswith("drive-1: answers, but nothing that it says moves")
        assert cycles.inputs.speed.quality[0] == cycles.inputs.torque.quality[0] == Quality.STALE
    cycles.cycle(120, 100, DriveRequest.OFF)
    cycles.standing.wrote = False
    assert cycles.cycle(0, 100, DriveRequest.OFF), "it does not thaw by being left alone"
    assert cycles.cycle(0, 101) == [] and cycles.inputs.speed.good()
    assert cycles.inputs.drive_state[0] == DriveState.ENABLED


@given(st.lists(st.integers(-700, 700), min_size=1, max_size=5), st.integers(1, 2 * ANSWERS_ALLOWED))
def test_a_drive_that_shows_the_torque_of_the_cycle_before_is_never_frozen(commands: list[int], hold: int) -> None:
    cycles, shown = Cycles(), 0
    for commanded in commands:
        for _ in range(hold):
            assert cycles.cycle(commanded, shown) == []
            shown = commanded


@given(st.lists(st.integers(0, COUNTS_ALLOWED), min_size=30, max_size=60))
def test_standstill_under_a_torque_that_hardly_moves_is_no_frozen_drive(commands: list[int]) -> None:
    cycles = Cycles()
    for commanded in [commands[0], *commands]:
        assert cycles.cycle(commanded, 0) == []


def test_a_command_that_was_not_written_proves_nothing() -> None:
    cycles = Cycles()
    cycles.standing.wrote = False
    for k in range(5 * ANSWERS_ALLOWED):
        assert cycles.cycle(10 * k, 0) == []
