"""The demonstration: a simulated line, the gateway and the loop in their own processes, everything in real time.

Whole: from the line's file to adapted configurations, each change through the gate, both cases on each configuration.
Quick: both cases on the configuration with which the loop is started.
"""

import asyncio
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from gateway.cli.children import ChildFailed, Children
from gateway.cli.demo_cases import (
    Window,
    again_after_stops,
    begin_with_repeats,
    prove_with_repeats,
    run_with_repeats,
    settle_with_repeats,
)
from gateway.cli.demo_failed import DemoFailed, FolderInUse
from gateway.cli.demo_line import (
    LanguageModelAsked,
    Setup,
    alone_in,
    begin,
    begin_agents,
    begin_operator,
    clear,
    end_in_order,
)
from gateway.cli.demo_operator import Operator
from gateway.cli.demo_panel import Panel
from gateway.cli.demo_progress import Progress
from gateway.cli.demo_stay import stay_on
from gateway.cli.line_commands import REFUSED
from gateway.core.messages import Stop
from gateway.core.scenario import PAPER
from gateway.mailbox.paths import run_base
from gateway.mailbox.port import Unreachable

if TYPE_CHECKING:
    from gateway.cli.demo_chain import Chain
    from gateway.cli.demo_people import LetIn
    from gateway.cli.demo_stepped import SteppedAside

READY_TIME_S = 20.0
OPENING = """From a line's file to adapted configurations, each change through the gate, on a simulated line that runs.
Some seven minutes; the first time on a computer some more, to compile. Ctrl-C brings the line to rest and ends all."""
OPENING_QUICK = """Both cases on one configuration, without the gate: some three minutes.
Ctrl-C brings the line to rest and ends all."""
NOT_REACHED = "the chain has ended before its aim: {}. The report says which rule refused what, and by how much"


@dataclass(frozen=True)
class Told:
    """What there is to tell of the line while it ran."""

    windows: list[Window]  #: when each case ran
    chain: "Chain | None"
    stops: list[str]  #: why the line stopped by itself in between
    let_in: "LetIn | None"
    waiting: str = ""  #: hash of a proposal that is left for a person


def run_demo(
    out: Path, seed: int, quick: str | None, asked: LanguageModelAsked | None = None, stay: bool = False
) -> int:
    """Run it and write everything into `out`. `quick`: the law of the one configuration that is run.

    `asked`: the language model whom the agents ask; None: the rules answer. `stay`: then the line runs on until Ctrl-C,
    for people to play with.

    Returns the exit code: 0, 1 when something failed, 2 where another one uses the folder, 130 on Ctrl-C before the
    result.
    """
    console = Console(highlight=False)
    started_s = time.monotonic()
    out = out.resolve()  # what is told of it is good in every terminal
    console.print(OPENING if quick is None else OPENING_QUICK, markup=False, soft_wrap=True)
    try:
        with alone_in(out), _children(out, stay) as children:
            setup, world_start_s = begin(children, out, quick or "lqi", seed, asked)
            with _stepped_aside(setup) as stepped:
                told = asyncio.run(_story(children, setup, stepped, console, quick is None, stay))
                if not stay:
                    end_in_order(children)
                console.print("measuring: the same cases in stepped time, then the report")
                code = _conclude(setup, stepped, told, world_start_s, started_s, console)
            if stay:
                assert told.let_in is not None
                stay_on(children, setup, told.let_in.password, told.waiting, console)
            return code
    except FolderInUse as error:
        console.print(str(error), markup=False, soft_wrap=True)
        return REFUSED
    except (ChildFailed, DemoFailed, Unreachable) as error:
        console.print(f"the demonstration failed: {error}", style="red", markup=False)
        console.print(
            f"what each process said is in {out / 'logs'}; run it again: nothing is left running", markup=False
        )
        return 1
    except KeyboardInterrupt:
        console.print("stopped: the line was brought to rest and every process has ended")
        return 130


def _children(out: Path, stay: bool) -> Children:
    """In a folder without an earlier demonstration. A line that stays is found by `r2rgate status` and the others."""
    clear(out)
    if stay:
        run_base().mkdir(mode=0o700, parents=True, exist_ok=True)
    return Children(out / "logs", run_base() if stay else None)


def _stepped_aside(setup: Setup) -> "SteppedAside":
    from gateway.cli.demo_stepped import SteppedAside

    return SteppedAside(setup)


def _conclude(
    setup: Setup,
    stepped: "SteppedAside",
    told: Told,
    world_start_s: float,
    started_s: float,
    console: Console,
) -> int:
    """Figures, `result.json`, `report.html`, tables. Returns the exit code."""
    from gateway.cli.demo_analysis import measure, read_evidence

    windows, chain, stops = told.windows, told.chain, told.stops
    if not windows:
        text = "" if chain is None or chain.commissioned is None else chain.commissioned.text
        raise DemoFailed(f"no configuration came to run the cases: {text}")
    evidence = read_evidence(setup, windows, world_start_s)
    if chain is None:
        from gateway.cli.demo_report import page
        from gateway.cli.demo_table import print_cases

        result = measure(setup, windows, stops, evidence, started_s, lambda _: "as started", None, stepped)
        text = page(setup, result, windows, evidence)
        print_cases(result, console)
    else:
        from gateway.cli.demo_asked import read_interactions
        from gateway.cli.demo_chain import name_of
        from gateway.cli.demo_chain_page import page
        from gateway.cli.demo_chain_table import print_chain
        from gateway.cli.demo_gate import chain_result

        interactions = read_interactions(setup)
        carried = chain_result(setup, chain, evidence, interactions)
        result = measure(setup, windows, stops, evidence, started_s, name_of, carried, stepped)
        text = page(setup, result, windows, evidence, interactions)
        print_chain(result, console)
    (setup.out / "result.json").write_text(result.model_dump_json(indent=2) + "\n", encoding="utf-8")
    (setup.out / "report.html").write_text(text, encoding="utf-8")
    for what, name in (("result", "result.json"), ("report", "report.html")):
        console.print(f"{what}: {setup.out / name}", markup=False, soft_wrap=True)
    if result.chain is not None and not result.chain.reached:
        console.print(NOT_REACHED.format(result.chain.text), style="red", markup=False, soft_wrap=True)
        return 1
    return 0


async def _story(
    children: Children, setup: Setup, stepped: "SteppedAside", console: Console, whole: bool, stay: bool
) -> Told:
    """From SILENT to rest; to a line that runs on, where it shall `stay`."""
    with Progress(console) as progress:
        operator = Operator(children, progress)
        try:
            progress.step("starting the processes")
            for config in (setup.config, stepped.on_truth())[whole:]:
                stepped.ask(config)
            let_in = await _with_operator(children, setup, stay) if whole or stay else None
            await operator.wait(lambda status: status.loop.running, READY_TIME_S, "the loop")
            if whole and let_in is not None:
                await _with_agents(children, setup, operator)
                operator.panel = await Panel.begin(let_in.script, children.log("client"))
            await prove_with_repeats(operator)
            await begin_with_repeats(operator)
            if whole:
                windows, chain = await _whole(operator, setup, stepped)
            else:
                period_s = setup.line.control.period_s
                windows = [await run_with_repeats(operator, setup.config, case, period_s) for case in PAPER]
                chain = None
            if stay:
                return Told(windows, chain, operator.stops, let_in, await _left_waiting(operator, setup, chain))
            progress.step("stopping")
            await operator.order(Stop())
            await operator.wait_at_rest()
            return Told(windows, chain, operator.stops, let_in)
        except BaseException:
            # Now rather than after a thread that still designs: until it ends, this event loop does not.
            children.end("loop")
            raise
        finally:
            await operator.close()


async def _with_operator(children: Children, setup: Setup, people: bool) -> "LetIn":
    """Its process, with certificates and users; keys are made while others start."""
    from gateway.cli.demo_people import let_in

    setup.data.mkdir(exist_ok=True)
    found = await asyncio.to_thread(let_in, setup.line, setup.data, people)
    begin_operator(children, setup)
    return found


async def _left_waiting(operator: Operator, setup: Setup, chain: "Chain | None") -> str:
    from gateway.cli.demo_waiting import leave_one_waiting

    shown = [] if chain is None else chain.shown
    try:
        return await again_after_stops(operator, lambda: leave_one_waiting(operator, setup, shown), "once more")
    except DemoFailed as failed:  # what was measured is there all the same
        operator.progress.step(f"  none is left waiting: {failed}")
        return ""


async def _with_agents(children: Children, setup: Setup, operator: Operator) -> None:
    """Until they answer on the bus."""
    await operator.wait(lambda status: status.agents_bus.open, READY_TIME_S, "the bus of the agents")
    begin_agents(children, setup)
    await operator.wait(lambda status: bool(status.agents_bus.agents), READY_TIME_S, "the agents' process")


async def _whole(operator: Operator, setup: Setup, stepped: "SteppedAside") -> "tuple[list[Window], Chain]":
    from gateway.cli.demo_chain import carry_out

    recipe = setup.line.recipes[0]
    operator.progress.step(
        "settling: the loop controls the line by what it was started with, an LQI on the line's file"
    )
    await settle_with_repeats(operator, recipe.tension_n, recipe.speed_m_per_s)
    chain = await carry_out(operator, setup, stepped)
    return chain.windows, chain
