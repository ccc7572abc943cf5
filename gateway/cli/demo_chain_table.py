"""The whole demonstration on the terminal: a table that fits 80 columns, and a few plain lines."""

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from gateway.cli.demo_result import PAPER_RMSE_N, DemoResult, paper_improvement_pct
from gateway.cli.demo_table import print_common
from gateway.core.scenario import PAPER


def print_chain(result: DemoResult, console: Console) -> None:
    chain = result.chain
    assert chain is not None
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column("", no_wrap=True)
    for case in PAPER:
        for name in (f"{case.name} N", "change", "paper N", "change", "x stepped"):
            table.add_column(name, justify="right")
    for k, one in enumerate(result.configurations):
        cells = [one.name]
        for case in PAPER:
            found = next((each for each in one.cases if each.name == case.name), None)
            paper = PAPER_RMSE_N.get(one.name, {}).get(case.name)
            cells += [
                "not run" if found is None else f"{found.rmse_n:.3f}",
                _change(result.improvement_pct(k, case.name)),
                "" if paper is None else f"{paper:.3f}",
                _change(paper_improvement_pct(one.name, case.name)),
                "" if found is None else f"{found.ratio_to_stepped:.3f}",
            ]
        table.add_row(*cells)
    truth = [f"{result.truth_rmse_n[case.name]:.3f}" for case in PAPER]
    table.add_row("on truth", truth[0], "", "", "", "", truth[1], "", "", "", "")
    console.print(table)
    approved = [one.approved_by for one in chain.changes if one.approved_by]
    by = ", ".join(sorted(set(approved))) or "nobody"
    say = [
        "RMSE over six spans; on truth: an LQI designed on the true line, stepped time. x stepped: over the wires in "
        "real time against stepped time, goal at most 1.15. Compare changes with the paper's, not numbers.",
        f"the chain {'reached its aim' if chain.reached else 'ended before its aim'}: {chain.text}",
        f"{len(chain.changes)} candidates, {len(approved)} accepted by the gate and approved by {by}; "
        f"{chain.deployments} deployments",
    ]
    if chain.swaps:
        worst = max(one.largest_step_nm for one in chain.swaps)
        say.append(
            f"largest step of a torque around a swap: {worst:.1f} Nm; allowed in a period: {chain.step_allowed_nm:g} Nm"
        )
    say += [f"not run: {one}" for one in chain.left_out]
    audit = chain.audit
    sound = "sound" if audit.sound else f"NOT SOUND: {'; '.join(audit.problems)}"
    say.append(f"audit: {sound}, {audit.records} records, head {audit.head}")
    for text in say:
        console.print(text, markup=False, soft_wrap=True)
    print_common(result, console)


def _change(improvement_pct: float | None) -> str:
    return "" if improvement_pct is None else f"{-improvement_pct:+.1f} %"
