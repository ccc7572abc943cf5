"""The simulated line as a process of its own.

    python -m sim_plant.process PLANT.toml --record FOLDER

prints one line of JSON on standard output once every wire is open, and runs until SIGTERM or SIGINT.
"""

import argparse
import asyncio
import gc
import json
import signal
import sys
from collections.abc import Callable, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from sim_plant.faces.canopen_bus import FaceUnavailable
from sim_plant.faults.control import SOCKET_FILE
from sim_plant.faults.parse import parse_fault
from sim_plant.plant import Plant, PlantRefused, load_plant
from sim_plant.wired import Settings, WiredLine

EXIT_FAILED = 1  #: the line ran, and then could not go on
EXIT_REFUSED = 2  #: it never ran
SUMMARY_FILE = "summary.json"


def run_plant(
    plant_path: Path | str,
    *,
    record_folder: Path | str,
    seed: int = 0,
    scale: float = 1.0,
    can_port: int | None = None,
    modbus_port: int | None = None,
    opcua_port: int | None = None,
    faults: Sequence[str] = (),
    control: Path | None = None,
    on_ready: Callable[[WiredLine], None] | None = None,
) -> int:
    """Run the line of a plant file until SIGTERM or SIGINT.

    Returns the exit code: 0, 2 when the line cannot run, 1 when the system failed it after it was ready. Why goes to
    standard error. See `Settings`; without `control` the socket for faults lies in the folder of the recording, and the
    line goes on without it where it cannot be opened. `on_ready` is called once every wire is open; without it a line
    of JSON goes to standard output.
    """
    try:
        planned = tuple(parse_fault(fault) for fault in faults)
        folder = Path(record_folder)
        settings = Settings(
            folder,
            seed,
            scale,
            can_port,
            modbus_port,
            opcua_port,
            planned,
            control or folder / SOCKET_FILE,
            control_is_optional=control is None,
        )
        if not (isfinite(settings.scale) and settings.scale > 0.0):
            raise ValueError(f"the time scale must be finite and above 0, got {settings.scale}")
        plant = load_plant(plant_path)
    except PlantRefused as error:
        return _refused(f"{error.path} is not used", *error.reasons)
    except ValueError as error:
        return _refused(str(error))
    except OSError as error:
        return _refused(in_words(error))
    return asyncio.run(_run(plant, settings, on_ready or _print_ready))


async def _run(plant: Plant, settings: Settings, on_ready: Callable[[WiredLine], None]) -> int:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    broken: list[BaseException] = []

    def end(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        # A line that has failed in a callback is no witness any more.
        broken.append(context.get("exception") or RuntimeError(context["message"]))
        stop.set()

    loop.set_exception_handler(end)
    try:
        line = WiredLine(plant, settings)
        await line.open()
    except FileExistsError:
        return _refused(f"{settings.record_folder} already holds a recording: choose another folder, or remove it")
    except (FaceUnavailable, ValueError) as error:
        return _refused(str(error))
    except OSError as error:
        return _refused(in_words(error))
    if line.control_refused:
        print(f"simulated line: goes on without a control socket: {line.control_refused}", file=sys.stderr)
    try:
        await _live(line, on_ready, stop)
        if broken:
            raise broken[0]
    except OSError as error:
        print(f"simulated line: it has failed while it ran: {in_words(error)}", file=sys.stderr)
        return EXIT_FAILED
    return 0


async def _live(line: WiredLine, on_ready: Callable[[WiredLine], None], stop: asyncio.Event) -> None:
    """From ready to the summary."""
    try:
        gc.freeze()
        on_ready(line)
        await line.run(stop)
    finally:
        await line.close()
        _write_summary(line.settings.record_folder / SUMMARY_FILE, line.summary())
        told = f"simulated line {line.plant.name}: stopped, unsafe events: {line.recorder.unsafe_total}"
        print(told, file=sys.stderr)


def _print_ready(line: WiredLine) -> None:
    print(json.dumps(line.ready()), flush=True)


def _write_summary(path: Path, summary: dict[str, Any]) -> None:
    """All of it or nothing, for whoever reads it meanwhile."""
    beside = path.with_suffix(".part")
    beside.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    beside.replace(path)


def _refused(*reasons: str) -> int:
    print("simulated line: " + "\n  ".join(reasons), file=sys.stderr)
    return EXIT_REFUSED


def in_words(error: OSError) -> str:
    """What the system says, and of which file."""
    why = error.strerror or str(error)
    return f"{error.filename}: {why}" if error.filename else why


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser("sim_plant", description="Run the simulated line of a plant file on its wires.")
    parser.add_argument("plant", type=Path, help="PLANT.toml: the truth")
    parser.add_argument("--seed", type=int, default=0, help="of the noise (default 0)")
    parser.add_argument("--scale", type=float, default=1.0, help="seconds of the line per second (default 1)")
    parser.add_argument("--record", type=Path, metavar="FOLDER", required=True, help="new folder for the recording")
    parser.add_argument("--can-port", type=int, help="port of udp_multicast, in place of the plant's")
    parser.add_argument("--modbus-port", type=int, help="in place of the plant's; 0 takes a free one")
    parser.add_argument("--opcua-port", type=int, help="in place of the plant's; 0 takes a free one")
    parser.add_argument("--fault", action="append", default=[], help="a fault by name, see docs/faults.md; repeatable")
    parser.add_argument(
        "--control", type=Path, help="socket for faults while the line runs (default: in the recording)"
    )
    given = parser.parse_args(arguments)
    return run_plant(
        given.plant,
        record_folder=given.record,
        seed=given.seed,
        scale=given.scale,
        can_port=given.can_port,
        modbus_port=given.modbus_port,
        opcua_port=given.opcua_port,
        faults=given.fault,
        control=given.control,
    )


if __name__ == "__main__":
    sys.exit(main())
