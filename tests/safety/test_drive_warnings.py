"""What drives say of themselves and that stops nothing is told once."""

from gateway.core.signals import DriveCondition, Inputs
from safety.actions import Action
from safety.drive_warnings import AGAIN_S, LASTING_S, WarningState, find_warnings, warning_limits
from tests.closed_loop.conftest import demo_line

LINE = demo_line(2)
LIMITS = warning_limits(LINE)
LASTING, AGAIN = (round(time_s / LINE.control.period_s) for time_s in (LASTING_S, AGAIN_S))
TEMPERATURE = 0x08 << 16 | 0x4210


class Told:
    def __init__(self) -> None:
        self.state, self.inputs = WarningState(2), Inputs(2)

    def says(self, condition: DriveCondition, warning: int = 0, periods: int = 1) -> list[str]:
        """Codes of what is told while the second drive says this."""
        codes: list[str] = []
        self.inputs.drive_condition[1], self.inputs.drive_warning[1] = condition, warning
        for _ in range(periods):
            findings = find_warnings(LIMITS, self.state, self.inputs)
            assert all(finding.action is Action.NONE for finding in findings)
            assert all(finding.parameters and finding.parameters["drive"] == "drive-2" for finding in findings)
            codes += [finding.rule for finding in findings]
        return codes


def test_a_warning_is_told_once_with_its_code_and_register() -> None:
    told = Told()
    assert told.says(DriveCondition.NONE, periods=5) == []
    told.inputs.drive_warning[1] = TEMPERATURE
    (finding,) = find_warnings(LIMITS, told.state, told.inputs)
    assert finding.rule == "drive-warns"
    assert finding.parameters == {"drive": "drive-2", "error_code": 0x4210, "register": 0x08}
    assert "4210h" in finding.text and "08h" in finding.text
    assert told.says(DriveCondition.WARNS, TEMPERATURE, periods=LASTING + 5) == [], "the bit has its code"


def test_another_warning_is_told_and_the_same_not_before_some_time() -> None:
    told = Told()
    assert told.says(DriveCondition.NONE, TEMPERATURE) == ["drive-warns"]
    assert told.says(DriveCondition.NONE, 0x3110) == ["drive-warns"]
    assert told.says(DriveCondition.NONE, TEMPERATURE) == [], "it comes and goes"
    told.says(DriveCondition.NONE, 0, periods=AGAIN)
    assert told.says(DriveCondition.NONE, TEMPERATURE) == ["drive-warns"]
    assert len(told.state.told) == 1, "what is over is not remembered for ever"


def test_a_warning_without_a_code_is_told_after_some_time() -> None:
    told = Told()
    assert told.says(DriveCondition.WARNS, periods=LASTING - 1) == []
    assert told.says(DriveCondition.WARNS, periods=LASTING) == ["drive-warns-without-code"]
    told.says(DriveCondition.NONE)
    assert told.says(DriveCondition.WARNS, periods=LASTING) == []


def test_a_limit_that_acts_for_some_time_is_told() -> None:
    told = Told()
    assert told.says(DriveCondition.LIMITED, periods=LASTING - 1) == []
    assert told.says(DriveCondition.NONE) == []
    assert told.says(DriveCondition.LIMITED, periods=2 * LASTING) == ["drive-limits"]


def test_a_person_who_arms_is_told_again() -> None:
    told = Told()
    assert told.says(DriveCondition.NONE, TEMPERATURE) == ["drive-warns"]
    told.state.begin_anew()
    assert told.says(DriveCondition.NONE, TEMPERATURE) == ["drive-warns"]
    told.says(DriveCondition.NONE)
    told.state.begin_anew()
    assert told.says(DriveCondition.NONE) == []
