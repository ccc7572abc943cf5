"""Where models lie and which one is meant: a file, or one of the repository of a line."""

from dataclasses import dataclass
from pathlib import Path

from gateway.cli.data_place import gateway_data
from gateway.cli.process_commands import read_line
from gateway.core.line import Line
from gateway.core.line_model import LineModel, ModelRefused, model_hash, parse_model
from gateway.supervisor.model_store import ModelsError
from gateway.supervisor.models import FILE_NAME, Entry, open_repository

LARGEST_BYTES = 5_000_000


@dataclass(frozen=True)
class Place:
    """A repository, and the line whose models are looked at; None: all that lie in it."""

    path: Path
    line: Line | None = None

    @property
    def key(self) -> tuple[str, str] | tuple[None, None]:
        """(site, line)"""
        return (self.line.site, self.line.line) if self.line else (None, None)


@dataclass(frozen=True)
class Chosen:
    """A model that somebody has named."""

    name: str  #: "version 3", or the file's name
    id: str
    model: LineModel
    entry: Entry | None  #: None: it comes from a file


def place_of(line_file: Path | None, data_dir: Path | None) -> Place:
    """The repository that is meant, though it may not exist. Raises ModelsError where none or several may be."""
    line = None if line_file is None else read_line(line_file)
    advice = "r2rgate models import FILE takes one"
    folder = gateway_data(line, data_dir, FILE_NAME, "models", advice, ModelsError)
    return Place(folder / FILE_NAME, line)


def read_model(file: Path) -> LineModel:
    """The model of a file. Raises ModelsError with every reason."""
    try:
        with file.open("rb") as stream:
            payload = stream.read(LARGEST_BYTES + 1)
    except OSError as error:
        raise ModelsError(f"{file} cannot be read: {error.strerror}") from error
    if len(payload) > LARGEST_BYTES:
        raise ModelsError(f"{file} is larger than {LARGEST_BYTES / 1e6:g} MB: no model")
    try:
        return parse_model(payload)
    except ModelRefused as refused:
        raise ModelsError("\n".join(f"{file}: {reason}" for reason in refused.reasons)) from refused


def chosen(wanted: str, line_file: Path | None, data_dir: Path | None) -> Chosen:
    """The model of a file, or the one of the repository with that version or id. Raises ModelsError."""
    file = Path(wanted)
    if file.is_file() or file.suffix == ".json" or len(file.parts) > 1:
        model = read_model(file)
        return Chosen(wanted, model_hash(model), model, None)
    place = place_of(line_file, data_dir)
    with open_repository(place.path) as models:
        return chosen_of(models.find(wanted, *place.key), place.path)


def chosen_of(entry: Entry, path: Path) -> Chosen:
    """Raises ModelsError where it is damaged."""
    if entry.model is None:
        raise ModelsError(f"version {entry.version} in {path}, {entry.id[:12]}, is damaged: {entry.damage}")
    return Chosen(f"version {entry.version}", entry.id, entry.model, entry)


def reasons_against_line(model: LineModel, line: Line) -> list[str]:
    """Why a model is none of this line; empty where it is."""
    found: list[str] = []
    if (model.site, model.line) != (line.site, line.line):
        found.append(f"it is a model of {model.site}/{model.line}, the line is {line.site}/{line.line}")
    if model.n != line.n:
        found.append(f"it has {model.n} span{'' if model.n == 1 else 's'}, the line {line.n}")
    return found
