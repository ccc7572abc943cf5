"""`r2rgate demo`: the demonstration, on a simulated line that it starts itself."""

from pathlib import Path
from typing import Annotated, Literal, NoReturn

import typer

from gateway.cli.process_commands import REFUSED, writable_folder


def demo(
    out: Annotated[Path, typer.Option(help="Folder for result, report and logs; what was there is replaced.")] = Path(
        "out/demo"
    ),
    seed: Annotated[int, typer.Option(min=0, help="Of the simulated line's noise.")] = 1,
    quick: Annotated[
        bool,
        typer.Option("--quick", help="Only both cases on one configuration, without the gate: some three minutes."),
    ] = False,
    law: Annotated[
        Literal["lqi", "pid"] | None, typer.Option(help="With --quick: the control law; LQI without it.")
    ] = None,
    model: Annotated[
        str | None, typer.Option(help="The agents ask this language model, as Ollama names it; without it the rules.")
    ] = None,
    url: Annotated[str | None, typer.Option(help="With --model: where Ollama answers, if not on this machine.")] = None,
    stay: Annotated[
        bool, typer.Option("--stay", help="Then the line runs on until Ctrl-C, with its page: to play with.")
    ] = False,
) -> None:
    """The demonstration: from a wrong model of a line to adapted configurations, each change through the gate.

    A simulated six-span line, loop, gateway and agents run in processes of their own, in real time. A first
    configuration, an experiment, a model and a redesign, and once more: agents are asked over their bus which, each is
    judged by the gate and approved by a scripted operator over OPC UA; both cases of the paper run on each
    configuration. Some seven minutes; Ctrl-C brings the line to rest and ends all.

    Exit code: 0 done, 1 failed or not adapted, 130 interrupted before the report.

    Example: r2rgate demo --out out/demo

    Example, one configuration: r2rgate demo --quick --law pid

    Example, with a language model: r2rgate demo --model qwen3:4b

    Example, a line to play with after three minutes: r2rgate demo --quick --stay
    """
    from gateway.cli.demo import run_demo
    from gateway.cli.demo_line import LanguageModelAsked
    from gateway.cli.lifetime import end_as_by_ctrl_c
    from gateway.core.line import Agents

    if law is not None and not quick:
        _refuse(f"--law {law} is for --quick; without it the gate decides which law controls the line")
    if url is not None and model is None:
        _refuse(f"--url {url} says where a language model answers; name it with --model")
    if model is not None and quick:
        _refuse(f"--model {model} is for the whole demonstration; with --quick nothing is asked of the agents")
    writable_folder(out, "--out", 0o777)
    asked = None if model is None else LanguageModelAsked(url or Agents().url, model)
    end_as_by_ctrl_c()
    raise typer.Exit(run_demo(out, seed, (law or "lqi") if quick else None, asked, stay))


def _refuse(text: str) -> NoReturn:
    typer.echo(text, err=True)
    raise typer.Exit(REFUSED)
