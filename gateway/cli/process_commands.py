"""The processes of r2rgate, each in the foreground, and `run`, which starts them together."""

import os
import stat
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from drivers.device_map import load_maps
from gateway.cli.data_before import moves
from gateway.cli.line_commands import read_line_text, roles_of
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_problem import LineRefused, printable
from gateway.files import MOST_BYTES, read_bytes
from gateway.mailbox.paths import (
    AGENTS_DATA,
    CONTROLLER,
    GATEWAY_DATA,
    LOGS,
    LOOP_DATA,
    OPERATOR_DATA,
    SIM_DATA,
    default_run_folder,
    name_of,
)

if TYPE_CHECKING:
    from gateway.core.controller import Controller

#: Exit codes. `run` starts a crashed child again, but not one that was refused or that runs already.
CRASHED, REFUSED, ALREADY_RUNNING = 1, 2, 3

LineFile = Annotated[Path, typer.Argument(help="The line description (r2rgate init writes one).")]
RunFolder = Annotated[Path | None, typer.Option("--run-dir", help="Where the line's sockets shall lie.")]
DataFolder = Annotated[
    Path | None,
    typer.Option("--data-dir", help="Where the line's data are kept: a folder of its own for each process."),
]
ControllerFile = Annotated[
    Path | None, typer.Option("--controller", help="The controller configuration (r2rgate design writes one).")
]


def read_line(file: Path) -> Line:
    """The line of `file`; every problem goes to standard error and ends the command with code 2."""
    maps = load_maps()
    source = printable(str(file))
    try:
        return load_line(read_line_text(file, source), source, roles_of(maps), maps.unusable)
    except LineRefused as refused:
        for problem in refused.problems:
            typer.echo(str(problem), err=True)
    raise typer.Exit(REFUSED)


def data_base() -> Path:
    """Where the lines' folders lie: /var/lib/r2rgate where it may be written, else the user's own state folder."""
    service = Path("/var/lib/r2rgate")
    own = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "r2rgate"
    return service if os.access(service, os.W_OK) else own


def default_data_folder(line: Line) -> Path:
    """site_line in `data_base`."""
    return data_folder_of(line.site, line.line)


def data_folder_of(site: str, line: str) -> Path:
    """site_line in `data_base`. One of an earlier version may be of another line: a person knows."""
    folder, earlier = data_base() / name_of(site, line), data_base() / f"{site}-{line}"
    if earlier.is_dir() and not folder.exists():
        way_out = f"mv {quote(str(earlier))} {quote(str(folder))}"
        _refuse(f"the data of {site}/{line} lie in {folder} from this version on; move what is its own: `{way_out}`")
    return folder


def begin_process(line: Line, run_dir: Path | None, data_dir: Path | None) -> tuple[Path, Path]:
    """Run folder and data folder of a process of the line. All that it makes from now on is its user's alone.

    In the data folder it keeps to its own (`LOOP_DATA` and so on).
    """
    os.umask(0o077)
    run_folder, data = run_dir or default_run_folder(line), data_dir or default_data_folder(line)
    require_a_folder_a_process(data)
    for own in (LOOP_DATA, GATEWAY_DATA, OPERATOR_DATA, AGENTS_DATA, SIM_DATA, LOGS):
        _close_to_others(data / own)
    if data_dir is None:  # one that is named may be of other things, too
        _close_to_others(data)
    return run_folder, data


def require_a_folder_a_process(data: Path, *, gateways_too: bool = True) -> None:
    """Refuses data as they lay before each process had its own folder: what was approved would not be found."""
    if way_out := moves(data, gateways_too=gateways_too):
        _refuse(
            f"each process has its own folder in {data} from this version on; end the line's processes, then move what "
            f"is there: `{way_out}`"
        )


def _close_to_others(folder: Path) -> None:
    """As whoever made it by hand may have left it: whoever may read a database may lock it."""
    with suppress(OSError):  # it is not there yet, or whoever needs it says that it cannot be used
        found = folder.stat()
        if found.st_uid == os.geteuid() and found.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
            folder.chmod(0o700)


def loop(
    file: LineFile,
    controller: ControllerFile = None,
    run_dir: RunFolder = None,
    data_dir: DataFolder = None,
    simulated: Annotated[
        bool,
        typer.Option(
            "--simulated", help="The line is simulated, nobody can be hurt: `r2rgate experiment run` is accepted."
        ),
    ] = False,
) -> None:
    """The control loop: SILENT until armed. SIGTERM and Ctrl-C stop the line first.

    Example: r2rgate loop line.toml --controller controller.json
    """
    from drivers.registry import LinksRefused
    from gateway.core.controller import ControllerRefused, parse_controller
    from gateway.loop.process import run_loop
    from gateway.mailbox.listener import AlreadyRunning, CannotListen, PathTooLong

    line = read_line(file)
    run_folder, data = begin_process(line, run_dir, data_dir)
    path = controller or data / LOOP_DATA / CONTROLLER
    way_out = f"r2rgate design {quote(str(file))} --out {quote(str(path))}"
    try:
        config = parse_controller(read_bytes(path, MOST_BYTES))
    except FileNotFoundError:
        _refuse(f"there is no controller configuration at {path}: {way_out} writes one")
    except OSError as error:
        _refuse(f"{path} cannot be read: {error.strerror}")
    except ControllerRefused as refused:
        _refuse(f"{path} is not used: {refused}. {way_out} writes another")
    _require_fit(line, config, path, way_out)
    try:
        with _a_crash_is_no_refusal():
            run_loop(
                line,
                config,
                run_folder,
                lambda text: print(text, file=sys.stderr, flush=True),
                data,
                simulated=simulated,
            )
    except AlreadyRunning as error:
        _refuse(f"a loop runs here already, this one ends: {error}", ALREADY_RUNNING)
    except (CannotListen, PathTooLong, LinksRefused) as error:
        _refuse(f"the loop cannot start: {error}")


def gateway(file: LineFile, run_dir: RunFolder = None, data_dir: DataFolder = None) -> None:
    """The gateway process: history, status, and the way of commands to the loop.

    Example: r2rgate gateway line.toml
    """
    from gateway.supervisor.process import run_gateway

    line = read_line(file)
    run_folder, data = begin_process(line, run_dir, data_dir)
    writable_folder(data / GATEWAY_DATA, "--data-dir")
    with _a_crash_is_no_refusal():
        code = run_gateway(line, run_folder, data)
    raise typer.Exit(code)


def sim(
    plant: Annotated[Path, typer.Argument(help="The plant: the truth of the simulated line.")],
    record: Annotated[Path, typer.Option(help="A new folder for the recording of what really happens.")],
    seed: Annotated[int, typer.Option(min=0, help="Of all noise.")] = 0,
    scale: Annotated[float, typer.Option(min=0.001, help="How much faster than real time.")] = 1.0,
    can_port: Annotated[int | None, typer.Option(help="In place of the plant's.")] = None,
    modbus_port: Annotated[int | None, typer.Option(help="In place of the plant's; 0 takes a free one.")] = None,
    opcua_port: Annotated[int | None, typer.Option(help="In place of the plant's; 0 takes a free one.")] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(help="Something that goes wrong, in quotes, as `r2rgate fault list` shows; repeatable."),
    ] = None,
    control: Annotated[
        Path | None,
        typer.Option(help="Socket for `r2rgate fault` while the line runs; control.sock in --record, if not told."),
    ] = None,
    priority: Annotated[
        int,
        typer.Option(min=0, max=90, help="Real-time priority, where permitted: devices do not wait for a computer."),
    ] = 0,
) -> None:
    """The simulated line: drives, load cells and line PLC on their wires, in a process of its own.

    Prints one line of JSON once every wire is open. Runs until Ctrl-C.

    Example: r2rgate sim sim_plant/plants/s_real.toml --record out/recording
    """
    from gateway.cli.lifetime import be_punctual
    from sim_plant.process import run_plant

    if priority:
        be_punctual(priority)
    code = run_plant(
        plant,
        record_folder=record,
        seed=seed,
        scale=scale,
        can_port=can_port,
        modbus_port=modbus_port,
        opcua_port=opcua_port,
        faults=fault or (),
        control=control,
    )
    raise typer.Exit(code)


def run(
    file: LineFile,
    controller: ControllerFile = None,
    plant: Annotated[Path | None, typer.Option(help="Start this simulated line as well.")] = None,
    run_dir: RunFolder = None,
    data_dir: DataFolder = None,
) -> None:
    """Loop, gateway, agents and operator together in this terminal, with the status on the screen.

    Ctrl-C stops the line, then ends. The screen says where the page and the OPC UA server are.

    Without --controller one is designed on the line's nominal model, kept, and designed anew when the line changes.
    What crashes is started again. Exit code: 0 ended as asked, 2 refused, 3 the line runs already.

    Example: r2rgate run line.toml
    """
    from gateway.cli.kept_controller import kept_controller
    from gateway.cli.together import run_together
    from gateway.control.design import DesignRefused

    line = read_line(file)
    if plant is not None:
        _require_plant(line, file, plant)
    run_folder, data = begin_process(line, run_dir, data_dir)
    _require_alone(run_folder)
    writable_folder(run_folder, "--run-dir")
    for own in (LOOP_DATA, GATEWAY_DATA):
        writable_folder(data / own, "--data-dir")
    _require_key(data / GATEWAY_DATA)
    opening: list[str] = []
    if controller is None:
        try:
            controller, said = kept_controller(line, data / LOOP_DATA)
        except DesignRefused as refused:
            _refuse(f"no lqi controller for {file}: {refused}; design one yourself and name it with --controller")
        except OSError as error:
            _refuse(f"a controller cannot be kept at {error.filename}: {error.strerror}")
        opening = [said] if said else []
    for sentence in opening:
        typer.echo(sentence, err=True)
    raise typer.Exit(run_together(file, line, controller, plant, run_folder, data, opening))


def writable_folder(path: Path, option: str, mode: int = 0o700) -> Path:
    """`path` as a folder that exists and may be written; one that is made has `mode`."""
    try:
        path.mkdir(parents=True, exist_ok=True, mode=mode)
        why = "" if os.access(path, os.W_OK | os.X_OK) else "Permission denied"
    except FileExistsError:
        why = "it is a file"
    except OSError as error:
        why = str(error.strerror)
    if why:
        _refuse(f"the folder {path} cannot be used: {why}; name one that you may write with {option}")
    return path


def _require_key(data: Path) -> None:
    """The gateway's key, before the loop looks for what it is known by."""
    from gateway.mailbox.keys import KeyUnusable, private_key

    try:
        private_key(data)
    except KeyUnusable as error:
        _refuse(str(error))


def _require_plant(line: Line, file: Path, plant_file: Path) -> None:
    """The simulated line must offer what the line's file expects."""
    from gateway.cli.plant_fit import misfits
    from sim_plant.plant import PlantRefused, load_plant

    try:
        found = misfits(line, file, load_plant(plant_file), plant_file)
    except PlantRefused as refused:
        _refuse(f"{plant_file} is not used: {'; '.join(refused.reasons)}")
    except OSError as error:
        _refuse(f"{plant_file} cannot be read: {error.strerror}; a plant is sim_plant/plants/s_real.toml")
    if found:
        _refuse(f"line and plant do not fit: {'; '.join(found)}. Change either so that they agree")


def _require_alone(run_folder: Path) -> None:
    """Nothing may be started, least of all a second simulated line on the same wires, where the line runs already."""
    from gateway.mailbox.listener import PathTooLong, check_path, living
    from gateway.mailbox.paths import GATEWAY_SOCKET, LOOP_SOCKET

    for name, socket in (("loop", LOOP_SOCKET), ("gateway", GATEWAY_SOCKET)):
        try:
            check_path(run_folder / socket)
        except PathTooLong as error:
            _refuse(f"{error} with --run-dir")
        if living(run_folder / socket):
            _refuse(f"a {name} of this line runs already, on {run_folder / socket}: end it first", ALREADY_RUNNING)


@contextmanager
def _a_crash_is_no_refusal() -> Iterator[None]:
    """What fails in mid-run is told with its place in the program, and `run` starts it again."""
    try:
        yield
    except OSError:
        traceback.print_exc()
        raise typer.Exit(CRASHED) from None


def _require_fit(line: Line, config: "Controller", path: Path, way_out: str) -> None:
    """A configuration for another line must not run on this one."""
    from gateway.core.controller_fit import misfits

    reasons = misfits(config, line)
    if reasons:
        _refuse(f"{path} is not used: {'; '.join(reasons)}. Design one for this line: {way_out}")


def _refuse(text: str, code: int = REFUSED) -> NoReturn:
    typer.echo(text, err=True)
    raise typer.Exit(code)
