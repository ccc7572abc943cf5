"""What the page is told: what counts as abnormal, how much of a limit is used, and that a tick is small."""

import asyncio
import json

import pytest

from gateway.core.deployment import WiringStatus
from gateway.core.experiment import Experiment
from gateway.core.finding import finding
from gateway.core.proposal import ExperimentChange
from gateway.core.signals import DriveState, Quality
from gateway.core.status import EventStatus, GatewayStatus
from gateway.core.verdict import RuleFinding
from gateway.operator.page.tick import DRIVES_THAT_FAIL, IN_MOTION, OFF_SHARE, abnormal, line_told, tick_of
from gateway.operator.page.told import TWO_SIDED, proposal_told, used
from gateway.supervisor import alarm_conditions
from gateway.wording.catalogue import sentence
from safety.rules import model_residuals, validity
from tests.operator.fake_line import ASKED, alarm
from tests.unit.page_support import page
from tests.unit.supervisor_support import line_of


def status_of(**span: object) -> GatewayStatus:
    with open("docs/examples/status.json") as file:
        found = json.load(file)
    found["spans"][0] |= span
    return GatewayStatus.model_validate(found)


@pytest.mark.parametrize(
    "span, expected",
    [
        ({}, ("", "")),
        ({"tension_n": 24.0}, ("", "")),
        ({"tension_n": 24.01}, ("attention", "span.off")),
        ({"tension_n": 15.99}, ("attention", "span.off")),
        ({"tension_n": 60.0, "setpoint_n": 55.0}, ("", "")),
        ({"tension_n": 60.1, "setpoint_n": 55.0}, ("alarm", "span.outside")),
        ({"tension_n": 1.9, "setpoint_n": 2.0}, ("alarm", "span.outside")),
        ({"tension_n": 0.9, "setpoint_n": 1.0}, ("", "")),
        ({"tension_n": 24.01, "control": "draw"}, ("", "")),
        ({"quality": "STALE"}, ("alarm", "quality.STALE")),
        ({"tension_n": None, "error_n": None, "quality": "MISSING"}, ("alarm", "quality.MISSING")),
        ({"tension_n": None, "error_n": None, "quality": "MISSING", "control": "draw"}, ("", "quality.MISSING")),
        ({"tension_n": None, "error_n": None, "quality": "BAD"}, ("alarm", "quality.MISSING")),
        ({"quality": "BAD", "control": "draw"}, ("attention", "quality.BAD")),
        ({"drive": "FAULT", "quality": "STALE", "tension_n": 1.0}, ("alarm", "drive.FAULT")),
        ({"drive": "READY"}, ("", "")),
    ],
)
def test_what_is_abnormal_of_a_span(span: dict[str, object], expected: tuple[str, str]):
    status = status_of(**span)
    assert abnormal(status.spans[0], status.limits, moving=True) == expected


def test_at_rest_a_tension_may_be_anything_but_a_failed_drive_is_told():
    status = status_of(tension_n=0.0)
    assert abnormal(status.spans[0], status.limits, moving=False) == ("", "")
    status = status_of(tension_n=0.0, drive="FAULT")
    assert abnormal(status.spans[0], status.limits, moving=False)[0] == "alarm"


@pytest.mark.parametrize("drive", ["STO", "READY"])
@pytest.mark.parametrize(
    "span, expected",
    [
        ({"quality": "STALE"}, ("attention", "quality.STALE")),
        ({"quality": "BAD"}, ("attention", "quality.BAD")),
        ({"tension_n": None, "error_n": None, "quality": "MISSING"}, ("attention", "quality.MISSING")),
        ({"tension_n": None, "error_n": None, "quality": "STALE"}, ("attention", "quality.MISSING")),
    ],
)
def test_at_rest_a_value_that_is_not_good_is_never_normal(span: dict[str, object], expected: object, drive: str):
    status = status_of(drive=drive, **span)
    assert abnormal(status.spans[0], status.limits, moving=False) == expected


def test_what_is_off_is_off_as_the_alarm_has_it():
    assert (OFF_SHARE, IN_MOTION) == (alarm_conditions.OFF_SHARE, set(alarm_conditions.MOVING))


def test_what_fails_are_names_of_drive_states():
    assert {state.name for state in DriveState} >= DRIVES_THAT_FAIL
    assert {quality.name for quality in Quality} == {"GOOD", "STALE", "BAD", "MISSING"}


@pytest.mark.parametrize(
    "value, limit, margin, expected",
    [
        (30.0, 60.0, 30.0, 0.5),  # at most
        (4.0, 2.0, 2.0, 0.5),  # at least
        (0.0, 0.002, 0.002, 0.0),
        (70.0, 60.0, -10.0, 1.0),
        (1.0, 2.0, -1.0, 1.0),  # at least, and not reached
        (0.0, 0.0, 0.0, None),
        (None, 2.0, 1.0, None),
        (1.0, None, None, None),
        (-1.0, 0.5, -1.5, 1.0),  # decay that is growth
        (0.39, -10.0, 10.39, None),  # at least something negative: no bar, rather than one of no length
    ],
)
def test_how_much_of_a_limit_is_used(value: float | None, limit: float | None, margin: float | None, expected: object):
    finding = RuleFinding(rule="r", passed=True, text="t", value=value, limit=limit, margin=margin)
    assert used(finding) == expected


@pytest.mark.parametrize("rule, unit, expected", [("model validity", "", None), ("model: residuals", "", None),
                                                  ("model validity", "m/s", 0.8), ("decay", "", 0.8)])  # fmt: skip
def test_of_two_limits_none_is_used_up(rule: str, unit: str, expected: float | None):
    finding = RuleFinding(rule=rule, passed=True, text="t", value=1.0, limit=0.8, margin=0.2, unit=unit)
    assert used(finding) == expected


def test_rules_of_two_limits_are_called_what_the_gate_calls_them():
    assert {validity.RULE, model_residuals.RULE} == TWO_SIDED


def test_a_change_that_takes_two_people_says_so_and_who_was_the_first():
    async def story() -> None:
        async with page() as there:
            there.gateway.approvals = 2
            await there.log_in("engineer")
            for approved_by in (None, "engineer"):
                told = (await there.browser.get(f"/api/proposals/{there.gateway.hash}")).json()
                assert (told["approvals"], told["approved_by"], told["stage"]) == (2, approved_by, "waiting")
                await there.say("decide", proposal=there.gateway.hash, shown=told["shown"], approve=True)

    asyncio.run(story())


def test_an_experiment_says_how_long_it_moves_set_points():
    with open("docs/examples/experiment.json") as file:
        experiment = Experiment.model_validate(json.load(file))

    async def story() -> None:
        async with page() as there:
            shown = await there.side.shown(there.gateway.hash)
            assert proposal_told(shown)["lasts_s"] is None
            change = ExperimentChange(experiment=experiment)
            tried = shown.model_copy(update={"proposal": shown.proposal.model_copy(update={"change": change})})
            assert proposal_told(tried)["lasts_s"] == experiment.duration_s > 0.0

    asyncio.run(story())


def test_a_tick_of_the_longest_line_is_small():
    async def story() -> None:
        async with page(spans=60) as there:
            assert there.side.status is not None
            tick = tick_of(there.side.status, there.side.proposals, 1)
            assert len(tick["spans"]) == 60 and tick["waiting"] == [there.gateway.hash]
            assert len(json.dumps(tick)) < 8000

    asyncio.run(story())


def test_before_the_first_list_of_proposals_none_waits():
    assert tick_of(status_of(), None, 0)["waiting"] == []


def test_what_is_to_be_done_before_a_start_is_told_in_every_language():
    unproved = WiringStatus(unproved=[finding("wiring-unproved")])
    tick = tick_of(status_of().model_copy(update={"wiring": unproved}), None, 0)
    (told,) = tick["before_more"]
    german = told["said"]["de"]
    assert "r2rgate prove" in told["text"] and "r2rgate prove" in german and german != told["text"]
    assert tick["proved_wall_s"] is None
    proved = status_of().model_copy(update={"wiring": WiringStatus(proved_wall_s=1.8e9)})
    assert tick_of(proved, None, 0) | {"before_more": []} == tick_of(proved, None, 0)
    assert tick_of(proved, None, 0)["proved_wall_s"] == 1.8e9 and not tick_of(proved, None, 0)["wiring_not_read"]
    not_read = tick_of(status_of().model_copy(update={"wiring": WiringStatus(not_read=True)}), None, 0)
    assert not_read["wiring_not_read"] and not_read["proved_wall_s"] is None


def test_set_points_are_offered_as_far_as_the_loop_takes_them():
    line = line_of(6)
    spans = [*line.spans[:5], line.spans[5].model_copy(update={"tension_min_n": 10.0, "tension_max_n": 20.0})]
    told, limits = line_told(line.model_copy(update={"spans": spans})), line.limits
    widest = [limits.tension_min_n + limits.tension_margin_n, limits.tension_max_n - limits.tension_margin_n]
    assert told["setpoint_n"] == [*[widest] * 5, [10.0 + limits.tension_margin_n, 20.0 - limits.tension_margin_n]]


def test_what_a_proposal_rests_on_is_told():
    async def story() -> None:
        async with page() as there:
            await there.log_in("viewer")
            told = (await there.browser.get(f"/api/asked/{there.gateway.hash}")).json()
            assert [one["interaction"] for one in told["asked"]] == [ASKED.interaction]
            assert [one["title"] for one in told["notes"]] == [one.title for one in there.gateway.notes]
            there.gateway.no_log = "the log cannot be read"
            none = await there.browser.get(f"/api/asked/{there.gateway.hash}")
            assert none.status_code == 409 and none.json()["text"] == there.gateway.no_log

    asyncio.run(story())


def test_courses_come_once_they_are_drawn():
    async def story() -> None:
        async with page() as there:
            await there.log_in("viewer")
            assert (await there.browser.get(f"/api/courses/{there.gateway.hash}")).json()["drawing"]
            told = (await there.browser.get(f"/api/courses/{there.gateway.hash}")).json()
            assert not told["drawing"] and len(told["courses"][0]["setpoint_n"]) == there.line.n
            assert (await there.browser.get("/api/courses/abcdef")).status_code == 400
            there.gateway.no_courses = "there are no courses of it"
            none = await there.browser.get(f"/api/courses/{there.gateway.hash}")
            assert none.status_code == 409 and none.json()["text"] == there.gateway.no_courses
            await there.gateway_mailbox.close()  # whoever asks again gets them once it is back
            assert (await there.browser.get(f"/api/courses/{there.gateway.hash}")).status_code == 503

    asyncio.run(story())


def test_events_and_alarms_that_are_data_are_told_in_every_language():
    found = finding("part-failed", part="the lease", error="ValueError: 1.5")
    english, german = sentence(found), sentence(found, "de")

    def said(text, findings):
        event = EventStatus(wall_s=1.0, kind="state", text=text, findings=findings)
        stopped = alarm("line-stopped").model_copy(update={"text": text, "findings": findings})
        tick = tick_of(status_of().model_copy(update={"events": [event], "alarms": [stopped]}), None, 0)
        told, also = (one["said"] for one in (*tick["events"], *tick["alarms"]))
        assert told == also
        return told

    assert said(english, [found]) == {"de": german}
    assert said(f"RUNNING to SLOWING: {english}", [found]) == {"de": f"RUNNING to SLOWING: {german}"}
    assert said(f"tension 1 is 0.5 N; {english}", [found]) == {"de": f"tension 1 is 0.5 N; {german}"}
    assert said(f"{english} [bus: lost]", [found]) == {"de": f"{german} [bus: lost]"}
    assert said(english, []) == {}
