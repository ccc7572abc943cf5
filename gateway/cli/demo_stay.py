"""The demonstration's line runs on, for people to play with: where they come in, what there is to try, the end."""

import json
import shutil
import sys
import time
from pathlib import Path
from shlex import quote

from rich.console import Console

from gateway.cli.children import Children
from gateway.cli.demo_line import Setup, end_in_order
from gateway.core.people import ROLES
from sim_plant.process import SUMMARY_FILE

LOOK_S = 0.5


def stay_on(children: Children, setup: Setup, password: str, waiting: str, console: Console) -> None:
    """Until Ctrl-C; then to rest. Raises ChildFailed and DemoFailed where a process ends by itself, or badly."""
    for text in told(setup, password, waiting, str(children.run_folder)):
        console.print(text, markup=False, soft_wrap=True)
    try:
        while True:
            children.check()
            time.sleep(LOOK_S)
    except KeyboardInterrupt:
        console.print("bringing the line to rest")
    end_in_order(children)
    summary = json.loads((setup.out / "recording" / SUMMARY_FILE).read_text())
    console.print(
        f"every process has ended; unsafe events at the drives, from beginning to end: {summary['unsafe_total']}"
    )


def told(setup: Setup, password: str, waiting: str, run_folder: str) -> list[str]:
    """Lines for a terminal. `waiting`: hash of the proposal that waits; empty: none does."""
    line, data, recording = (quote(str(setup.out / name)) for name in ("line.toml", "data", "recording"))
    operator = setup.line.operator
    return [
        "",
        "The line runs on. Ctrl-C brings it to rest and ends all. Nobody but this machine reaches it.",
        "What happens is recorded, about 1 GB an hour: end it when you have played enough.",
        "",
        f"page    {operator.page}",
        f"        log in as {' or '.join(ROLES)}; the password of all three, for this run: {password}",
        f"OPC UA  {operator.opc_ua}, signed and encrypted, for the same users",
        f"        your client's certificate: r2rgate pki trust FILE --line {line} --data-dir {data}",
        "",
        "To try, on the page or in a second terminal, as the same user:",
        *_on_path(),
        *_waits(waiting),
        "  after an approval, back to the last good controller:  r2rgate rollback",
        "  another tension of span 3, a grade change:  r2rgate set 3 30   r2rgate recipe velocity",
        f'  something goes wrong:  r2rgate fault inject "load-cell 3 nan for 0.2" --control {recording}',
        "  when the line has stopped:  r2rgate arm   r2rgate start",
        "  what it does:  r2rgate status --watch   r2rgate proposals   r2rgate audit show --data-dir " + data,
        f"Where other lines run here, too, the commands take --run-dir {quote(run_folder)}",
    ]


def _on_path() -> list[str]:
    """What `r2rgate` needs to be found there."""
    if shutil.which("r2rgate") is not None:
        return []
    return [f'  once in it:  export PATH="{Path(sys.executable).parent}:$PATH"']


def _waits(proposal: str) -> list[str]:
    if not proposal:
        return ["  a change of your own:  r2rgate design and r2rgate propose; none waits now"]
    return [f"  a change waits for you:  part Change of the page, or r2rgate approve {proposal[:12]}"]
