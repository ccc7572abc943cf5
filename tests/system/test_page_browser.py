"""The page in Chromium, before a real gateway and a simulated line: as an operator uses it, and as it has to be."""

from collections.abc import Iterator
from typing import Any

import pytest

from tests.closed_loop.wire import at_rest
from tests.operator.names import PASSWORD
from tests.system.page_line import LANGUAGES, PARTS, AtPage, PageLine

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(300)]

WINDOWS = {1280: 900, 820: 1180, 390: 844}  #: a desk, a tablet, a telephone: width and height
MOST_BYTES = 500_000
NOT_BORNE = ("serious", "critical")
APPROVE, REJECT, YES = "[data-focus=approve]", "[data-focus=reject]", "dialog[open] button.main"


@pytest.fixture(scope="module")
def line(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PageLine]:
    with PageLine(tmp_path_factory.mktemp("page")) as found:
        found.run()
        found.operate()
        yield found


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AtPage]:
    with AtPage(tmp_path_factory.mktemp("browser") / "browser.log") as found:
        yield found


@pytest.fixture
def at(line: PageLine, browser: AtPage) -> Iterator[AtPage]:
    """Whatever a test does there, the browser complains of nothing, and has asked nothing of any other place."""
    line.run_again()
    browser.open(line.page)
    yield browser
    assert browser("troubles") == []
    assert [url for url in browser("asked") if not url.startswith(f"{line.page}/")] == []


def test_an_operator_sees_the_line_approves_a_change_and_takes_it_back(line: PageLine, at: AtPage):
    before, proposal = line.in_service(), line.waiting()
    at.log_in("operator")
    at("see", "#picture .tension")
    seen = at("texts", "#picture .tension")
    assert len(seen) == line.line.n
    line.look_on(lambda: at("texts", "#picture .tension"), lambda now: now != seen)
    at("click", "#prompt a")
    assert proposal[:12] in at("see", "#change-body h2")
    assert "the web is softer than it was" in at("see", "blockquote")
    margins = at("texts", ".margins li")
    assert len(margins) >= 5 and all("passed" in one and "not passed" not in one for one in margins)
    assert any("margin" in one and "limit" in one for one in margins)
    at("see", ".course canvas")  # before and after, over time
    at("click", APPROVE)
    assert "on probation" in at("see", "dialog[open] .lines")
    assert line.in_service() == before  # the first of two steps
    at("fill", "#ask-comment", "looks well")
    at("click", YES)
    assert "Done" in at("see", "#reply")
    at("see", "#change-body", "On probation")
    assert line.in_service() != before
    at.part("line")
    at("see", "#markers", "D ")
    at("click", "#operate button:has-text('last good')")
    at("fill", "#ask-comment", "it hums")
    at("click", YES)
    at("see", "#reply", "Done")
    line.look_on(line.in_service, lambda now: now == before)
    at("see", "#markers", "R ")
    at.part("history")
    at("see", "#view-history tbody tr:first-child", "Rolled back")
    told = line.audit("show", "--id", proposal[:12])
    assert "operator (operator, page)" in told and "looks well" in told


def test_a_set_point_that_is_said_is_seen(line: PageLine, at: AtPage):
    at.log_in("operator")
    to_n = line.line.recipes[0].tension_n[0] + 1.0
    at("fill", "#operate form:has-text('Tension') input", str(to_n))
    at("click", "#operate form:has-text('Tension') button")
    at("see", "#reply", "Done")
    at("see", "#picture .setpoint", f"{to_n:.1f}")
    at("fill", "#operate form:has-text('Tension') input", str(to_n - 1.0))
    at("click", "#operate form:has-text('Tension') button")
    at("see", "#picture .setpoint", f"{to_n - 1.0:.1f}")


def test_a_wrong_password_is_refused_and_the_right_one_is_not(at: AtPage):
    at.try_log_in("operator", "three old rollerz")
    assert at("see", "#login-refused", "wrong") == "name or password is wrong"
    at.log_in("operator")


def test_a_viewer_sees_everything_and_has_no_button(line: PageLine, at: AtPage):
    line.waiting()
    at.log_in("viewer")
    at("see", "#operate", "log in as an operator")
    for part in PARTS:
        at.part(part)
        if part == "change":
            at("see", ".decide", "log in as an operator")
            assert at("count", ".margins li") >= 5
        assert at("count", f"#stop, #view-{part} button") == 0


def test_everything_goes_by_keyboard_alone(line: PageLine, at: AtPage):
    proposal = line.waiting()
    line.look_on(lambda: at("focused"), lambda now: now == "Name")
    at("write", "operator")
    at("press", "Tab")
    at("write", PASSWORD)
    at("press", "Enter")
    at("see", "#picture svg")
    at("tab_to", "Change")
    at("press", "Enter")
    at("see", APPROVE)
    at("tab_to", "Approve")
    at("press", "Enter")
    at("see", "dialog[open]")
    assert at("focused") == "No, go back"  # whoever presses once too often has said no
    at("press", "Escape")
    at("tab_to", "Reject")
    at("press", " ")
    at("see", "dialog[open]")
    at("tab_to", "Yes, reject")
    at("press", "Enter")
    at("see", "#change-body", "Rejected")
    assert line.shown(proposal).stage == "rejected"


def test_german_is_spoken_and_another_language_is_kept(line: PageLine, at: AtPage):
    line.waiting()
    at.open(line.page, "de")
    at.log_in("viewer")
    assert [one.split()[0] for one in at("texts", "#views a")] == ["Anlage", "Änderung", "Verlauf", "Zustand"]
    assert all("," in one for one in at("texts", "#picture .tension"))
    at.part("change")
    margins = "\n".join(at("texts", ".margins li"))
    assert "der Zug fällt auf" in margins and "allowed" not in margins
    at("choose", "#language", "en")
    at("see", "#views a", "Condition")
    at("see", "#change-body", "What would change")
    assert "tension falls to" in "\n".join(at("texts", ".margins li"))


@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize("width", WINDOWS)
def test_nothing_stands_in_anybodys_way(line: PageLine, at: AtPage, language: str, width: int):
    """What axe finds of each part and window, and that nothing is wider than the screen."""
    line.waiting()
    at.open(line.page, language, width=width, height=WINDOWS[width])
    at("see", "#login")
    found = _found(at, "login")
    at.log_in("engineer")
    at("see", "#prompt")
    for part in PARTS:
        at.part(part)
        at("see", f"#view-{part} h2")
        found += _found(at, part)
    at.part("change")
    for button in (APPROVE, REJECT):
        at("click", button)
        at("see", "dialog[open]")
        found += _found(at, button)
        at("press", "Escape")
    assert found == []


def test_all_that_comes_until_the_line_is_seen_weighs_little(at: AtPage):
    """And that it comes from one place: see `at`. How soon is a benchmark's."""
    at.log_in("operator")
    assert 0 < at("bytes") <= MOST_BYTES


def test_a_stop_that_nobody_heard_says_so_and_one_that_was_heard_stops(line: PageLine, at: AtPage):
    at.log_in("operator")
    at("forget_session")
    at("click", "#stop")
    assert "Stop was NOT sent" in at("see", "#reply")
    assert (status := line.status()) is not None and status.loop.state == "RUN"
    at.log_in("operator")
    at("click", "#stop")
    at("see", "#reply", "Done")
    line.wait(at_rest)
    at("see", "#now-state", "stopped")
    line.arm_and_start()


def _found(at: AtPage, where: str) -> list[Any]:
    bad = [{"where": where, **one} for one in at("violations") if one["impact"] in NOT_BORNE]
    return [*bad, *({"where": where, "too wide": one} for one in at("too_wide"))]
