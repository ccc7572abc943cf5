"""Part d of bench-gate by itself: what its tables say of lines that were commissioned, and of those that were not."""

from gateway.cli.commission_result import Tried
from gateway.commissioning.candidates import Law
from gateway.control.design import design_lqi, task_on
from tests.bench.figures import Bench
from tests.bench.gate_commissioning import Chain, OfLine, bench_commissioning, plant_of
from tests.bench.gate_tiers import Worth, worth
from tests.bench.workers import Workers
from tests.closed_loop.recorded import demonstration_line
from tests.closed_loop.truths import truth_of


class Told(Workers):
    """Workers that have done already what they are asked for."""

    def __init__(self, found):
        self.found = found

    def each(self, function, given, title):
        return [self.found[job] for job in given]


def chain(reached, tried, line_s=180.0):
    return Chain(reached, reached, "the end", 0.12, 4, 9, tried, (16.0, 44.0), 0, line_s)


def of_line(number, unruly, reached, tried, ratio, regraded=None):
    by_case = {"tension": ratio, "velocity": 0.99}
    what = Worth(by_case, {} if unruly else by_case, by_case, by_case, (), 0)
    return OfLine(number, unruly, chain(reached, tried), "LQI", what, regraded, 60.0)


def test_refusals_are_counted_by_rule_and_lines_by_what_they_are():
    kept = Tried("gains", "first configuration", 0, "a" * 64, "kept", "")
    refused = Tried("gains", "redesign", 0, "b" * 64, "refused", "far", "corners: error", 4.0, 3.0)
    aborted = Tried("experiment", "experiment", 0, "c" * 64, "done", "a torque was at a limit")
    found = {
        (0, False, True): of_line(0, False, True, [kept], 1.02, chain(True, [], 70.0)),
        (0, True, False): of_line(0, True, True, [kept], 9.0),
        (2, False, False): of_line(2, False, True, [kept, refused], 1.01),
        (2, True, False): of_line(2, True, False, [kept, refused, aborted], 1.03),
    }
    bench = Bench("gate-part", [1], goals_of="gate")
    bench_commissioning(bench, Told(found), [0, 2])
    figures = {one.name: one.value for one in bench.figures}
    assert figures["commissioned"] == 3 and figures["commissioned_pct"] == 75.0
    assert figures["s_real_a_to_oracle_tension"] == 1.02 and figures["s_real_b_n_tension"] == 1.02
    assert figures["a_to_oracle_tension_p95"] == 1.01  # the oracle does not know what an unruly line does
    assert figures["b_to_truth_tension_p50"] == 1.02 and figures["regraded_line_p50_s"] == 70.0
    assert sorted(bench.tables["what was refused on the way"]["rows"]) == [
        ("experiment", "done", 1), ("gains", "corners: error", 2),
    ]  # fmt: skip
    assert [name for name, _ in bench.tables["each refusal"]["rows"]] == ["2", "2 unruly", "2 unruly"]
    assert bench.goals_of == "gate"


def test_a_design_on_the_truth_is_worth_itself_and_no_more_than_the_oracle():
    line, plant = demonstration_line(), plant_of(2, unruly=False)
    on_truth = design_lqi(task_on(line, truth_of(plant, line)))
    found = worth(line, plant, on_truth, Law("lqi"), 1, plain=True)
    assert found.b_to_truth == {"tension": 1.0, "velocity": 1.0} and not found.stopped and not found.unsafe_events
    assert all(1.0 < ratio < 1.25 for ratio in found.a_to_oracle.values())
