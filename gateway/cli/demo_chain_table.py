"""The whole demonstration on the terminal: a table that fits 80 columns, and a few plain lines."""

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from gateway.cli.demo_asked_page import in_short
from gateway.cli.demo_result import PAPER_RMSE_N, ChainResult, DemoResult, paper_improvement_pct
from gateway.cli.demo_table import print_common
from gateway.core.scenario import PAPER


def print_chain(result: DemoResult, console: Console) -> None:
    assert result.chain is not None
    console.print(_beside_the_paper(result))
    for text in (*_of_the_cases(result), *_of_the_gate(result.chain)):
        console.print(text, markup=False, soft_wrap=True)
    print_common(result, console)


def _beside_the_paper(result: DemoResult) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column("", no_wrap=True)
    for case in PAPER:
        for name in (f"{case.name}\nRMSE N", "\nchange", "paper\nRMSE N", "\nchange"):
            table.add_column(name, justify="right", no_wrap=True)
    for k, one in enumerate(result.configurations):
        cells = [one.name]
        for case in PAPER:
            own, paper = result.rmse_n(k, case.name), PAPER_RMSE_N.get(one.name, {}).get(case.name)
            cells += [
                "not run" if own is None else f"{own:.3f}",
                _change(result.improvement_pct(k, case.name)),
                "" if paper is None else f"{paper:.3f}",
                _change(paper_improvement_pct(one.name, case.name)),
            ]
        table.add_row(*cells)
    on_truth = [cell for case in PAPER for cell in (f"{result.truth_rmse_n[case.name]:.3f}", "", "", "")]
    table.add_row("on truth", *on_truth)
    return table


def _change(improvement_pct: float | None) -> str:
    return "" if improvement_pct is None else f"{-improvement_pct:+.1f}%"


def _of_the_cases(result: DemoResult) -> list[str]:
    ratios = [(case.ratio_to_stepped, case.limit_ratio) for one in result.configurations for case in one.cases]
    worst, limit = max(ratios)
    return [
        "on truth: an MPC designed on the true line, in stepped time. Compare the changes, not the numbers: the report "
        "says why.",
        f"over the wires in real time against stepped time: {min(ratios)[0]:.3f} to {worst:.3f}; at most {limit:g}: "
        f"{'met' if worst <= limit else 'MISSED'}",
    ]


def _of_the_gate(chain: ChainResult) -> list[str]:
    approved = [one.approved_by for one in chain.changes if one.approved_by]
    by = ", ".join(sorted(set(approved))) or "nobody"
    told = [
        f"the chain {'reached its aim' if chain.reached else 'ended before its aim'}: {chain.text}",
        f"{len(chain.changes)} candidates, {len(approved)} accepted by the gate and approved by {by}; "
        f"{chain.deployments} deployments",
        in_short(chain.asked),
    ]
    if chain.swaps:
        swap = max(chain.swaps, key=lambda one: one.largest_step_nm)
        told.append(
            f"largest step of a torque around a swap: {swap.largest_step_nm:.1f} Nm; in the second before it "
            f"{swap.before_nm:.1f} Nm; allowed in a period: {chain.step_allowed_nm:g} Nm"
        )
    told += [f"not run: {one}" for one in chain.left_out]
    audit = chain.audit
    sound = "sound" if audit.sound else f"NOT SOUND: {'; '.join(audit.problems)}"
    return [*told, f"audit: {sound}, {audit.records} records, head {audit.head}"]
