"""The line of the demonstration: the simulated one, its file, and the processes."""

import fcntl
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import NamedTuple

from gateway.cli.children import IN_ORDER, Children, free_tcp_ports, free_udp_port
from gateway.cli.demo_failed import DemoFailed, FolderInUse
from gateway.cli.lifetime import uninterrupted
from gateway.cli.line_commands import known_maps
from gateway.core.controller import Controller, canonical
from gateway.core.line import Agents, Line, Operator
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.mailbox.paths import GATEWAY_DATA

SPANS = 6
SIM_PRIORITY = 40  #: below the loop's: devices of a real line do not wait for this computer
OWN_FILES = ("line.toml", "plant.toml", "controller.json", "result.json", "report.html", "recording", "data", "logs")

#: What the demonstration's line file says otherwise than the template, and why.
STATED: tuple[tuple[str, str, str], ...] = (
    (
        "friction_nms_per_rad = { value = 10.0, tolerance = 0.75 }",
        "friction_nms_per_rad = { value = 10.0, tolerance = 0.6 }",
        "the paper's models are wrong by up to half; were it more, drives of 60 Nm might not hold 0.1 m/s",
    ),
    (
        "# first_speed_max_m_per_s = 0.02",
        "first_speed_max_m_per_s = 0.1",
        "the cases of the paper run at up to 0.1 m/s: the first configuration is asked, and judged, for that speed",
    ),
    ("# first_step_max_n = 4.0", "first_step_max_n = 24.0", "and for their step; on a line of yours leave both"),
    ("# probation_s = 30.0", "probation_s = 10.0", "shorter than on a line that produces: three changes in minutes"),
)


class Ports(NamedTuple):
    """Of this machine, none of which anybody else uses."""

    can: int
    modbus: int
    opc_ua: int  #: of the operator's process
    page: int


@dataclass(frozen=True)
class LanguageModelAsked:
    """Whom the agents ask; without it the rules answer."""

    url: str
    model: str


@dataclass(frozen=True)
class Setup:
    """What a run is made of, and where it writes."""

    out: Path
    line: Line
    config: Controller  #: with which the loop is started
    seed: int

    @property
    def data(self) -> Path:
        """Of the line, a folder for each process."""
        return self.out / "data"

    @property
    def gateway_data(self) -> Path:
        """History, audit, stores, the agents' log."""
        return self.data / GATEWAY_DATA


@contextmanager
def alone_in(out: Path) -> Iterator[None]:
    """So that no other demonstration clears the folder away from under this one. Raises FolderInUse."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / ".lock").open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise FolderInUse(
                f"another demonstration uses {out}: end that one, or name another folder with --out"
            ) from None
        yield


def clear(out: Path) -> None:
    """Remove what an earlier demonstration left; nothing else of the folder is touched."""
    for name in OWN_FILES:
        path = out / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    (out / "logs").mkdir()


def begin(
    children: Children, out: Path, law: str, seed: int, asked: LanguageModelAsked | None = None
) -> tuple[Setup, float]:
    """Start all but the agents. The line's file describes what the simulated line offers on the wire."""
    from gateway.control.design import design_lqi, design_pid, task_of

    with as_file(files("sim_plant") / "plants" / "s_real.toml") as plant:
        shutil.copyfile(plant, out / "plant.toml")
    ready = children.start_sim(
        out / "plant.toml", "--record", out / "recording", "--seed", str(seed),
        "--can-port", str(free_udp_port()), "--modbus-port", "0", "--priority", str(SIM_PRIORITY),
    )  # fmt: skip
    text = line_text(Ports(ready["can_port"], ready["modbus_port"], *free_tcp_ports(2)), asked)
    (out / "line.toml").write_text(text, encoding="utf-8")
    line = load_line(text, "line.toml", known_maps())
    config = {"lqi": design_lqi, "pid": design_pid}[law](task_of(line))
    (out / "controller.json").write_bytes(canonical(config) + b"\n")
    setup = Setup(out, line, config, seed)
    folders = ("--run-dir", children.run_folder, "--data-dir", setup.data)
    children.start("gateway", out / "line.toml", *folders)
    children.start("loop", out / "line.toml", "--controller", out / "controller.json", *folders)
    return setup, ready["monotonic_start_s"]


def begin_agents(children: Children, setup: Setup) -> None:
    """Their process, once the gateway's bus is open."""
    folders = ("--run-dir", children.run_folder, "--data-dir", setup.data)
    children.start("agents", setup.out / "line.toml", *folders)


def begin_operator(children: Children, setup: Setup) -> None:
    """What people reach, once there are certificates and users."""
    folders = ("--run-dir", children.run_folder, "--data-dir", setup.data)
    children.start("operator", setup.out / "line.toml", *folders)


def line_text(ports: Ports, asked: LanguageModelAsked | None = None) -> str:
    """The template's line on these ports, with what is stated. Raises DemoFailed where the template has changed."""
    text, usual = line_template(SPANS, "line.toml"), Operator()
    wires = (
        ("port = 43113", f"port = {ports.can}"),
        ("port = 5020", f"port = {ports.modbus}"),
        (f'# opc_ua = "{usual.opc_ua}"', f'opc_ua = "opc.tcp://127.0.0.1:{ports.opc_ua}"'),
        (f'# page = "{usual.page}"', f'page = "http://127.0.0.1:{ports.page}"'),
    )
    stated = ((default, f"# {why}:\n{said}") for default, said, why in STATED)
    for default, said in (*wires, *stated, *_agents(asked)):
        if default not in text:
            raise DemoFailed(f"the line template does not say {default!r}")
        text = text.replace(default, said)
    return text


def _agents(asked: LanguageModelAsked | None) -> list[tuple[str, str]]:
    """What the template says, and what is said in its place."""
    if asked is None:
        return []
    default = Agents()
    return [
        ('llm = "off" ', 'llm = "ollama" '),
        (f"# url = {json.dumps(default.url)}", f"url = {json.dumps(asked.url)}"),
        (f"# model = {json.dumps(default.model)}", f"model = {json.dumps(asked.model)}"),
    ]


def end_in_order(children: Children) -> None:
    """Raises DemoFailed where one ends badly."""
    with uninterrupted():
        for name in IN_ORDER:
            code = children.end(name)
            if code != 0:
                raise DemoFailed(f"{name} ended with exit code {code}: see {children.log(name)}")
