"""Part d of bench-gate by itself: what its tables say of lines that were commissioned, and of those that were not."""

from gateway.cli.commission import Tried
from gateway.control.design import design_lqi, task_on
from tests.bench.figures import Bench
from tests.bench.gate_commissioning import OfLine, bench_commissioning, beside_truth, plant_of
from tests.closed_loop.recorded import demonstration_line
from tests.closed_loop.truths import truth_of


class Told:
    """Workers that have done already what they are asked for."""

    def __init__(self, found):
        self.found = found

    def each(self, function, given, title):
        return [self.found[job] for job in given]


def of_line(number, unruly, reached, tried, ratios):
    return OfLine(number, unruly, reached, "the end", 0.12, 4, tried, (16.0, 44.0), 0, ratios, 180.0, 60.0)


def test_refusals_are_counted_by_rule_and_ratios_are_of_lines_that_have_got_there():
    kept = Tried("gains", "first configuration", 0, "a" * 64, "kept", "")
    refused = Tried("gains", "redesign", 0, "b" * 64, "refused", "far", "corners: error", 4.0, 3.0)
    aborted = Tried("experiment", "experiment", 0, "c" * 64, "done", "a torque was at a limit")
    found = {
        (2, False): of_line(2, False, True, [kept, refused], {"tension": 1.01, "velocity": 0.99}),
        (2, True): of_line(2, True, False, [kept, refused, aborted], {"tension": 9.0}),
    }
    bench = Bench("gate-part", [1], goals_of="gate")
    bench_commissioning(bench, Told(found), [2])  # type: ignore[arg-type]
    figures = {one.name: one.value for one in bench.figures}
    assert figures["commissioned"] == 1 and figures["commissioned_pct"] == 50.0
    assert figures["commissioned_rmse_over_truth_max"] == 1.01
    assert sorted(bench.tables["what was refused on the way"]["rows"]) == [
        ("experiment", "done", 1), ("gains", "corners: error", 2),
    ]  # fmt: skip
    assert [name for name, _ in bench.tables["each refusal"]["rows"]] == ["2", "2 unruly", "2 unruly"]


def test_a_design_on_the_truth_is_worth_itself():
    line, plant = demonstration_line(), plant_of(2, unruly=False)
    on_truth = design_lqi(task_on(line, truth_of(plant, line)))
    assert beside_truth(line, plant, on_truth, 1) == {"tension": 1.0, "velocity": 1.0}
