"""`r2rgate eval`: how well somebody decides, on simulated lines that are to be commissioned."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from gateway.cli.process_commands import REFUSED

if TYPE_CHECKING:
    from gateway.cli.eval_result import EvalResult, TaskResult
    from gateway.core.line import Agents

UNSAFE, FAILED = 1, 3  #: exit codes
OFF = "off"
LIBRARIES = ("r2rgate", "numpy", "scipy", "daqp", "osqp", "numba", "ollama")


def evaluate(
    model: Annotated[str, typer.Option(help="Tag of the language model, such as qwen3:4b; off: the baselines.")] = OFF,
    url: Annotated[str, typer.Option(help="Of its Ollama server.")] = "http://127.0.0.1:11434",
    tasks: Annotated[int, typer.Option(min=1, max=1000, help="How many.")] = 5,
    seed: Annotated[int, typer.Option(min=0, help="Of the series of tasks.")] = 0,
    spans: Annotated[int, typer.Option(min=1, max=6, help="Of each line.")] = 3,
    out: Annotated[Path, typer.Option(help="The result, as JSON; its folder is made.")] = Path("out/eval/eval.json"),
    as_json: Annotated[bool, typer.Option("--json", help="Print the result to standard output, and no table.")] = False,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Tasks at once, without a model; default: one a processor.")
    ] = None,
) -> None:
    """Score a language model on commissioning tasks: simulated lines that are not as their file says.

    Each task is a random line with disturbances and noisy load cells. It is commissioned through the whole gate, in
    stepped time: once with the model deciding, and once each with the rules, a Nelder-Mead search and a random search
    in its place. Said of each: what it tried, what was refused and where, what the configuration in service is worth
    in the end beside the design on the truth, unsafe events, tokens and time. The same seed gives the same tasks.

    With a model tasks run one after another, and all that is said is kept: `r2rgate log --data-dir out/eval`. Ctrl-C
    ends it; the tasks that were finished are in the result. A task that fails is in it as well, with the reason.

    Exit code: 0 done, 1 done and unsafe events were seen at the simulated drives, 2 refused, 3 done but for
    trials that failed, 130 interrupted.

    Example: r2rgate eval --model qwen3:4b --tasks 5

    Example, the baselines alone: r2rgate eval --model off --tasks 5 --seed 7
    """
    from gateway.cli.eval_work import Job, carry_out
    from gateway.cli.waiting import INTERRUPTED, progress
    from gateway.cli.workers import processors

    agents, digest = (None, "") if model == OFF else _answering(model, url)
    _require_folder(out)
    jobs = [Job(number, seed, spans, agents, None if agents is None else out.parent) for number in range(tasks)]
    found: list[TaskResult] = []
    complete = True
    try:
        with progress() as tell:
            carry_out(jobs, min(workers or processors(), tasks) if agents is None else 1, tell, found.append)
    except KeyboardInterrupt:
        complete = False
    found.sort(key=lambda one: one.number)
    result = _result(model, digest, "" if agents is None else url, seed, spans, tasks, complete, found)
    _write(result, out, as_json)
    if not complete:
        typer.echo(f"interrupted: {len(found)} of {tasks} tasks are in {out}", err=True)
        raise typer.Exit(INTERRUPTED)
    failed = [(task.number + 1, trial) for task in found for trial in task.trials if trial.failed]
    for number, trial in failed:
        typer.echo(f"task {number}, {trial.policy}: {trial.end}", err=True)
    if any(one.unsafe_accepted for one in result.figures):
        raise typer.Exit(UNSAFE)
    raise typer.Exit(FAILED if failed else 0)


def _answering(model: str, url: str) -> tuple["Agents", str]:
    """How it is asked, and the digest of its weights; ends the program where it does not answer."""
    import asyncio

    from pydantic import ValidationError

    from agents.language_model.client import LanguageModel
    from agents.language_model.no_answer import NoAnswer
    from gateway.core.line import Agents

    try:
        agents = Agents(llm="ollama", model=model, url=url)
    except ValidationError:
        _refuse(f"--url is {url}, --model {model}; allowed: a URL such as http://127.0.0.1:11434, and a model's tag")

    async def look() -> str:
        async with LanguageModel(agents) as asked:
            return (await asked.look()).digest

    try:
        return agents, asyncio.run(look())
    except NoAnswer as error:
        _refuse(f"{error.text}; without a model: --model {OFF}")


def _result(
    model: str, digest: str, url: str, seed: int, spans: int, tasks: int, complete: bool, found: "list[TaskResult]"
) -> "EvalResult":
    from gateway.cli.eval_figures import figures_of
    from gateway.cli.eval_result import EvalResult
    from gateway.cli.origin import command_line, machine, now_iso, versions_of

    return EvalResult(
        command=command_line(),
        date=now_iso(),
        machine=machine(),
        versions=versions_of(LIBRARIES),
        model=model,
        digest=digest,
        url=url,
        seed=seed,
        spans=spans,
        tasks_asked=tasks,
        complete=complete,
        figures=figures_of(found),
        tasks=found,
    )


def _write(result: "EvalResult", out: Path, as_json: bool) -> None:
    text = result.model_dump_json(indent=2) + "\n"
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        _refuse(f"--out {out} cannot be written: {error.strerror}")
    if as_json:
        typer.echo(text, nl=False)
        return
    from rich.console import Console

    from gateway.cli.eval_table import print_result

    print_result(result, out, Console(highlight=False))


def _require_folder(out: Path) -> None:
    """Told before the work, not after it."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with out.open("a", encoding="utf-8"):
            pass
    except OSError as error:
        _refuse(f"--out {out} cannot be written: {error.strerror}; name a file in a folder that you may write")


def _refuse(text: str) -> NoReturn:
    typer.echo(text, err=True)
    raise typer.Exit(REFUSED)
