"""What `r2rgate compute` is given in place of a running line: files."""

from collections.abc import Sequence
from pathlib import Path

from agents.code.materials import Given
from gateway.cli.data_place import gateway_folder
from gateway.cli.line_in_service import in_service
from gateway.cli.model_place import chosen, chosen_of, reasons_against_line
from gateway.cli.recordings import read_recording
from gateway.cli.recordings_table import RecordingRefused
from gateway.core.controller import Controller, ControllerRefused, parse_controller
from gateway.core.line import Line
from gateway.core.line_model import LineModel
from gateway.files import MOST_BYTES, read_bytes
from gateway.supervisor.configurations import ConfigurationsError
from gateway.supervisor.model_store import ModelsError
from gateway.supervisor.models import FILE_NAME, open_repository


class MaterialsRefused(Exception):
    """A file cannot be used; the text says which and why."""


def given(
    line: Line, file: Path, controller: Path | None, model: str | None, recordings: Sequence[Path],
    data_dir: Path | None,
) -> Given:  # fmt: skip
    """Raises MaterialsRefused."""
    models = gateway_folder(line, data_dir) / FILE_NAME
    try:
        held = None if controller is not None else in_service(line, data_dir)
        return Given(
            _named(model, line, file, data_dir) if model else _accepted(line, models),
            _controller(controller) if controller is not None else None if held is None else held.controller,
            [read_recording(one, line.control.period_s) for one in recordings],
        )
    except (ModelsError, RecordingRefused, ConfigurationsError, ControllerRefused, OSError) as error:
        raise MaterialsRefused(str(error)) from error


def _named(wanted: str, line: Line, file: Path, data_dir: Path | None) -> LineModel:
    return _of_line(chosen(wanted, file, data_dir).model, line, f"--model {wanted}")


def _accepted(line: Line, path: Path) -> LineModel | None:
    """None: none is accepted yet."""
    if not path.exists():
        return None
    with open_repository(path) as models:
        accepted = [one for one in models.entries(line.site, line.line) if one.state == "accepted"]
    if not accepted:
        return None
    found = chosen_of(accepted[-1], path)
    return _of_line(found.model, line, f"the accepted model, {found.name},")


def _of_line(model: LineModel, line: Line, name: str) -> LineModel:
    if reasons := reasons_against_line(model, line):
        raise MaterialsRefused("\n".join(f"{name} is not used: {reason}" for reason in reasons))
    return model


def _controller(path: Path) -> Controller:
    try:
        return parse_controller(read_bytes(path, MOST_BYTES))
    except OSError as error:
        raise MaterialsRefused(f"{path} cannot be read: {error.strerror}") from error
    except ControllerRefused as error:
        raise MaterialsRefused(f"{path} is no controller configuration: {error}") from error
