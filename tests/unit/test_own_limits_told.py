"""Where a roller or a span has limits of its own, whoever looks is told those."""

from rich.console import Console

from gateway.cli.status_view import render
from gateway.commissioning.simulated_loop import QUIET, loop_of
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_limits import tension_band_n, torque_limit_key, torque_limits_nm
from gateway.core.line_template import line_template
from gateway.operator.page.tick import abnormal
from gateway.supervisor.alarm_conditions import Conditions
from gateway.supervisor.status import span_statuses
from tests.unit.alarm_support import RECORDING, span, status

NARROW = {"tension_min_n": 20.0, "tension_max_n": 35.0}  #: of a line of 5 to 60 N
HIGH = span(2, tension_n=36.0, error_n=6.0, **NARROW)  #: within the line's band, outside its own


def with_own() -> Line:
    text = line_template(3).replace('name = "roller-2"\n', 'name = "roller-2"\ntorque_nm = 20.0\n')
    return load_line(
        text.replace('name = "span-2"\n', 'name = "span-2"\ntension_min_n = 15.0\ntension_max_n = 40.0\n'), "line.toml"
    )


def test_the_status_has_what_a_span_and_a_roller_have_of_their_own() -> None:
    first, second, _ = span_statuses(with_own(), None, running=True)
    assert (first.tension_min_n, first.tension_max_n, first.torque_limit_nm) == (None, None, None)
    assert (second.tension_min_n, second.tension_max_n, second.torque_limit_nm) == (15.0, 40.0, 20.0)
    assert tension_band_n(with_own(), 2) == (15.0, 40.0)


def test_a_tension_outside_its_spans_own_band_is_an_alarm() -> None:
    (told,) = (text for name, text in Conditions().look(status(spans=[span(1), HIGH]), RECORDING).items()
               if name == "tension-out-of-band")  # fmt: skip
    assert "allowed: 20 to 35 N" in told
    within = span(2, tension_n=36.0, error_n=6.0)
    assert "tension-out-of-band" not in Conditions().look(status(spans=[span(1), within]), RECORDING)


def test_the_page_and_the_terminal_show_it_as_outside() -> None:
    assert abnormal(HIGH, status().limits, moving=True) == ("alarm", "span.outside")
    console = Console(width=120, file=None, record=True)
    with console.capture() as shown:
        console.print(render(status(spans=[span(1), HIGH]), 120))
    (row,) = (line for line in shown.get().splitlines() if line.startswith("2 zone-2"))
    assert ">" in row


def test_the_torque_that_is_nearest_to_its_own_limit_is_named() -> None:
    spans = [span(1, torque_nm=15.0), span(2, torque_nm=4.9, torque_limit_nm=5.0)]
    told = Conditions().look(status({"saturated": True}, spans=spans), RECORDING)
    assert told["torque-at-limit"] == "roller-2 at 4.9 Nm; allowed: 5 Nm"


def test_the_key_is_named_that_sets_it() -> None:
    assert [torque_limit_key(with_own(), roller) for roller in (1, 2, 3)] == [
        "limits.torque_nm", "rollers[2].torque_nm", "limits.torque_nm",
    ]  # fmt: skip


def test_commissioning_simulates_each_drive_with_its_own_torque() -> None:
    line = with_own()
    assert loop_of(line, QUIET).torque_nm.tolist() == torque_limits_nm(line).tolist() == [60.0, 20.0, 60.0]
