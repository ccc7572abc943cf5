"""What stands on the page while a line changes under it, in Chromium before a gateway that is none."""

from collections.abc import Iterator

import pytest

from gateway.core.messages import SetSpeed, SetTension
from gateway.operator.page import sessions
from tests.operator.fake_line import PASSWORD, FakeGateway, alarm
from tests.operator.real_line import until
from tests.system.made_up_page import made_up_page
from tests.system.page_line import AtPage

pytestmark = pytest.mark.timeout(180)

SPANS = 3
YES = "dialog[open] button.main"
SPAN = "[data-focus=course-span]"


@pytest.fixture
def gateway(browser: AtPage) -> Iterator[FakeGateway]:
    """With an operator at its page."""
    with made_up_page(SPANS) as (address, found):
        browser.open(address)
        browser.log_in("operator", PASSWORD)
        yield found
        browser("troubles")


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AtPage]:
    with AtPage(tmp_path_factory.mktemp("browser") / "browser.log") as found:
        yield found


def test_of_alarms_that_come_together_the_highest_is_read_out_first_and_none_is_left_out(
    gateway: FakeGateway, browser: AtPage
) -> None:
    gateway.alarms = [alarm("tension-off"), alarm("device-absent")]
    browser("see", "#now-alarms", "2")
    high, medium = gateway.alarms[1], gateway.alarms[0]
    assert (high.priority, medium.priority) == ("high", "medium")
    assert browser("content", "#alert").casefold() == f"high: {high.means}. medium: {medium.means}.".casefold()
    gateway.alarms = [high]
    browser("see", "#now-alarms", "1")
    assert high.means in browser("content", "#alert")
    gateway.alarms = []
    browser("see", "#now-alarms", "none")
    assert browser("content", "#alert") == ""


def test_a_page_that_hears_nothing_new_shows_what_grows_older(gateway: FakeGateway, browser: AtPage) -> None:
    """By the figure that `make bench-operator` has of it."""
    assert browser("ages", 1)[-1] >= 0.0
    frozen = gateway.status()
    gateway.status = lambda: frozen
    ages_s = browser("ages", 3)
    assert len(ages_s) >= 25 and ages_s[-1] - ages_s[0] >= 1.5
    assert ages_s[20:] == sorted(ages_s[20:])


def test_an_idle_page_still_stops_and_holds_and_says_what_wants_a_log_in(
    gateway: FakeGateway, browser: AtPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sessions, "IDLE_S", 0.0)
    browser("see", "#idle", "wants a log-in")
    for command in ("stop", "hold"):
        browser("click", f"#{command}")
        browser("see", "#reply", "Done")
        until(lambda: gateway.said[-1].said.command, lambda said, command=command: said == command)
    assert browser("count", "#login, #stop, #hold") == 3 and browser("count", "#views a") == 0


def test_a_new_record_leaves_the_focus_where_it_is_in_the_history(gateway: FakeGateway, browser: AtPage) -> None:
    browser.part("history")
    browser("see", "#view-history tbody")
    browser("tab_to", f"Open {gateway.hash[:12]}")
    gateway.records.append("a record that has just come")
    browser("see", "#view-history", "a record that has just come")
    assert browser("focused") == f"Open {gateway.hash[:12]}"
    gateway.stage = "kept"  # the proposals themselves are others
    browser("see", "#view-history tbody tr:first-child", "Kept")
    assert browser("focused") == f"Open {gateway.hash[:12]}"


def test_courses_come_although_the_way_to_them_was_cut_for_a_while(gateway: FakeGateway, browser: AtPage) -> None:
    browser("cut", "**/api/courses/*", 2)
    browser.part("change")
    browser("see", ".course canvas")


def test_why_there_are_no_courses_is_said_and_they_come_when_there_are(gateway: FakeGateway, browser: AtPage) -> None:
    gateway.no_courses = "the gate is shut"
    browser.part("change")
    browser("see", "#courses", "the gate is shut")
    gateway.no_courses, gateway.stage = "", "probation"
    browser("see", "#change-body", "On probation")
    browser("see", ".course canvas")


def test_the_notes_that_a_proposal_rests_on_are_there_by_their_titles_and_what_is_opened_stays_open(
    gateway: FakeGateway, browser: AtPage
) -> None:
    browser("cut", "**/api/asked/*", 2)
    browser.part("change")
    browser("see", "#asked", "Which of the tuned controllers is proposed.")
    titles = browser("texts", "#asked summary")
    assert titles == [
        "Integral action and constant disturbances (control theory)",
        "Friction of idler bearings (roll-to-roll practice)",
    ]
    browser("click", "#asked summary:has-text('Friction')")
    browser("see", "#asked blockquote", "Old grease")
    assert "line/friction says otherwise" in browser("see", "#asked details[open]", "It cannot.")
    assert not browser("violations")
    gateway.stage = "probation"
    browser("see", "#change-body", "On probation")
    browser("see", "#asked blockquote", "Old grease")


def test_why_nothing_is_told_of_the_notes_is_said(gateway: FakeGateway, browser: AtPage) -> None:
    gateway.no_log = "the log cannot be read"
    browser.part("change")
    browser("see", "#asked", "the log cannot be read")


def test_the_span_that_was_chosen_stays_chosen_and_has_the_focus(gateway: FakeGateway, browser: AtPage) -> None:
    browser.part("change")
    browser("see", SPAN)
    browser("choose", SPAN, str(SPANS))
    browser("focus", SPAN)
    gateway.stage = "probation"
    browser("see", "#change-body", "On probation")
    assert browser("value", SPAN) == str(SPANS - 1)  # counted from 0
    assert browser("focused").startswith("Span")
    assert browser("count", f".course[aria-label*='span {SPANS}.']") == 2


def test_what_is_written_while_an_answer_is_on_its_way_stays(gateway: FakeGateway, browser: AtPage) -> None:
    field, button = (f"#operate form:has-text('Tension') {one}" for one in ("input", "button"))
    gateway.answers.clear()
    try:
        browser("fill", field, "21")
        browser("click", button)
        browser("fill", field, "22")
    finally:
        gateway.answers.set()
    browser("see", "#reply", "Done")
    browser("ages", 1)  # the page has looked at what else is new, and goes on
    assert browser("value", field) == "22"
    browser("click", button)
    until(lambda: [one.said.tension_n for one in gateway.said if isinstance(one.said, SetTension)], [21.0, 22.0].__eq__)
    browser("see", "#reply", "Done")


def test_any_higher_speed_is_asked_for_once_more_and_a_lower_one_is_not(gateway: FakeGateway, browser: AtPage) -> None:
    """The line runs at 0.01 m/s."""
    field, button = (f"#operate form:has-text('Speed') {one}" for one in ("input", "button"))

    def said() -> list[float]:
        return [one.said.speed_m_per_s for one in gateway.said if isinstance(one.said, SetSpeed)]

    browser("fill", field, "0.011")
    browser("click", button)
    browser("see", YES)
    assert said() == []
    browser("click", YES)
    until(said, [0.011].__eq__)
    browser("see", "#reply", "Done")
    browser("fill", field, "0.009")
    browser("click", button)
    until(said, [0.011, 0.009].__eq__)
