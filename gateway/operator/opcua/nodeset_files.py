"""Node sets as the OPC Foundation publishes them: which of a folder's files holds which model, and what that needs.

What a file is, is told by its content, not by its name. Only its beginning is read here.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from gateway.files import read_beginning

MOST_FILES = 200  #: of a folder; others are not looked at
MOST_BYTES = 4 * 2**20  #: of a file
_HEAD_BYTES = 65_536  #: by then a file has said what it is
_NODE_SET = "http://opcfoundation.org/UA/2011/03/UANodeSet.xsd "
_PATH = [f"{_NODE_SET}{name}" for name in ("UANodeSet", "Models", "Model", "RequiredModel")]


class NotUsable(Exception):
    """The text says which file or model, and why."""


@dataclass(frozen=True)
class Model:
    uri: str
    published: str  #: RFC 3339; empty: not told


@dataclass(frozen=True)
class NodeSet:
    path: Path
    model: Model
    requires: tuple[Model, ...]

    def read(self) -> bytes:
        """All of it. Raises NotUsable."""
        data = _read(self.path, MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise NotUsable(f"{self.path} has more than {MOST_BYTES} bytes")
        return data


@dataclass
class Folder:
    """What was found."""

    node_sets: dict[str, NodeSet] = field(default_factory=dict[str, NodeSet])  #: by model; of several the newest
    problems: list[str] = field(default_factory=list[str])  #: sentences about files that cannot be used


def look_into(folder: Path) -> Folder:
    found = Folder()
    try:
        paths = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".xml")
    except OSError as error:
        found.problems.append(f"{folder} cannot be read: {error.strerror}")
        return found
    if len(paths) > MOST_FILES:
        found.problems.append(f"{folder} holds {len(paths)} files: only the first {MOST_FILES} are looked at")
    for path in paths[:MOST_FILES]:
        try:
            one = _node_set(path)
        except NotUsable as problem:
            found.problems.append(str(problem))
            continue
        held = found.node_sets.get(one.model.uri)
        if held is None or held.model.published < one.model.published:
            found.node_sets[one.model.uri] = one
    return found


def _node_set(path: Path) -> NodeSet:
    """Raises NotUsable."""
    elements = _models(path, _read(path, _HEAD_BYTES))
    models = [(depth, attributes) for depth, attributes in elements if attributes.get("ModelUri")]
    own = [_model(attributes) for depth, attributes in models if depth == len(_PATH) - 1]
    if not own:
        raise NotUsable(f"{path} is no node set: it names no model")
    if len(own) > 1:
        raise NotUsable(f"{path} holds {len(own)} models; allowed: one a file")
    return NodeSet(path, own[0], tuple(_model(attributes) for depth, attributes in models if depth == len(_PATH)))


def _models(path: Path, head: bytes) -> list[tuple[int, dict[str, str]]]:
    """Depth and attributes of the elements that name models. Raises NotUsable."""
    found: list[tuple[int, dict[str, str]]] = []
    above: list[str] = []

    def begins(name: str, attributes: dict[str, str]) -> None:
        above.append(name)
        if len(above) > 2 and above == _PATH[: len(above)]:
            found.append((len(above), attributes))

    def refuse(*_: object) -> None:
        raise NotUsable(f"{path} declares a document type: entities are not resolved")

    parser = expat.ParserCreate(namespace_separator=" ")
    parser.StartElementHandler = begins
    parser.EndElementHandler = lambda _: above.pop()
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(head, False)
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise NotUsable(f"{path} is no XML: {error}") from error
    return found


def _model(attributes: dict[str, str]) -> Model:
    return Model(attributes["ModelUri"], attributes.get("PublicationDate", ""))


def _read(path: Path, most: int) -> bytes:
    try:
        return read_beginning(path, most)
    except OSError as error:
        raise NotUsable(f"{path} cannot be read: {error.strerror}") from error


def too_old(needs: NodeSet, held: dict[str, str]) -> Iterator[str]:
    """Of what `needs` requires, what is older than that. `held`: dates by model."""
    for one in needs.requires:
        if held[one.uri][:10] < one.published[:10]:
            yield f"{one.uri} of {one.published[:10]} or newer, and has that of {held[one.uri][:10] or 'no date'}"
