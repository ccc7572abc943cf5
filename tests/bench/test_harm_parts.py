"""Parts of bench-harm: drawn lines, and what is said of a fault that was injected."""

from dataclasses import replace

import pytest

from gateway.core.line import Line
from gateway.core.line_checks import RULES
from gateway.core.line_rules_braking import AT_REST_S
from tests.bench.harm import NO_WEB_S, ROWS, one
from tests.bench.harm_lines import draw_size, drawn
from tests.bench.harm_runs import NEVER_S, Watched, begun, drawable, healthy, rest_bound_s

SMALL = 31_001  #: a line that is drawable, starts and stops


@pytest.mark.parametrize("seed", range(31_000, 31_020))
def test_a_draw_is_a_function_of_its_seed_and_its_file_one_that_can_be_written(seed):
    found = drawn(seed)
    assert found.size == draw_size(seed) and 2 <= found.line.n <= 10
    assert Line.model_validate(found.line.model_dump()) == found.line
    assert found.plant.spans == found.line.n


def test_lines_that_check_refuses_are_left_out():
    assert [drawable(seed) for seed in range(31_000, 31_060)].count(False) in range(1, 30)
    refused = next(seed for seed in range(31_000, 31_060) if not drawable(seed))
    assert one("web-break", refused) is None


def test_lines_that_check_only_advises_on_are_drawn():
    """Whose rollers run on for long after a web break, for one: they are the hard ones."""
    advised = next(seed for seed in range(31_000, 31_060) if drawable(seed) and rest_bound_s(seed) > AT_REST_S)
    found = [finding.severity for rule in RULES for finding in rule.check(drawn(advised).line)]
    assert found and set(found) == {"warning"}


def test_a_missing_web_is_told_within_its_bound_from_when_its_slack_is_used_up():
    outcome = one("no-web", SMALL)
    assert outcome is not None and outcome.code == "no-web" and 0.0 < outcome.found_s <= NO_WEB_S
    assert ROWS["no-web"].is_late(outcome) == (False, False)
    assert ROWS["no-web"].is_late(replace(outcome, found_s=NO_WEB_S + 0.1)) == (True, False)


def test_the_rule_that_found_a_fault_is_told_with_its_time():
    loop = begun(SMALL, 0.4)
    watched = Watched("web-break", SMALL, loop, ["web 1 web-break"])
    assert watched.first() == ("", NEVER_S)
    assert watched.step_until(lambda: bool(watched.first()[0]), 1.0) <= 0.05
    assert watched.first()[0] in ("web-break", "slack")


def test_a_healthy_life_ends_at_rest_with_nothing_found():
    outcome = healthy("healthy", SMALL)
    assert (outcome.code, outcome.unsafe) == ("", {}) and outcome.rest_s < NEVER_S
