"""Documents of files: Markdown, plain text, CSV and PDF.

A file that cannot be read is refused with a reason, and the rest goes on.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from agents.rag.documents import Document, Tier, of_note
from agents.rag.notes import FENCE, NoteRefused, parse_note
from agents.rag.pdf import text_of_pdf
from agents.rag.tables import text_of_csv
from gateway.core.line_problem import printable
from gateway.core.nearest import nearest
from gateway.files import read_bytes, what_is_there

MOST_BYTES = 50_000_000  #: of a file
MOST_LETTERS = 5_000_000  #: of its text, some 2,000 pages
MOST_FILES = 10_000
_BYTES_LOOKED_AT = 4096


class FileRefused(Exception):
    """A file is no document; the text says why and what to do."""


@dataclass(frozen=True)
class Refused:
    file: str
    reason: str


@dataclass(frozen=True)
class FilesRead:
    documents: list[Document]
    refused: list[Refused]


def read_files(paths: Sequence[Path], tier: Tier, known: Mapping[str, Document] | None = None) -> FilesRead:
    """Of files, and of folders with all that lies in them.

    `tier`: of what has no head that says it. `known`: by name, documents of earlier; a file of the same size and time
    is not read again.
    """
    found, documents, refused = list(_files(paths)), list[Document](), list[Refused]()
    for name, file in found[:MOST_FILES]:
        try:
            before = (known or {}).get(name)
            same = before is not None and before.stamp == stamp_of(file)
            documents.append(before if before and same else _document(name, file, tier))
        except FileRefused as error:
            refused.append(Refused(printable(name), str(error)))
        except OSError as error:
            refused.append(Refused(printable(name), f"cannot be read: {error.strerror}"))
    if len(found) > MOST_FILES:
        refused.append(Refused(f"{len(found) - MOST_FILES} more", f"{MOST_FILES} files are the most that are read"))
    return FilesRead(documents, refused)


def stamp_of(file: Path) -> str:
    """Of a file that has not changed the same as before."""
    status = file.stat()
    return f"{status.st_size}-{status.st_mtime_ns}"


def _files(paths: Sequence[Path]) -> Iterator[tuple[str, Path]]:
    """With a name of each: in a folder its path from there. Hidden files are left out."""
    for path in paths:
        if path.is_dir():
            for file in sorted(path.rglob("*")):
                name = file.relative_to(path)
                if not _is_folder(file) and not any(part.startswith(".") for part in name.parts):
                    yield name.as_posix(), file
        else:
            yield path.name, path


def _is_folder(file: Path) -> bool:
    """Whether it is gone into. A folder with the name of a document is told, as is what is no file at all."""
    return file.is_dir() and (file.suffix.lower() not in _READERS or any(file.iterdir()))


def _document(name: str, file: Path, tier: Tier) -> Document:
    if not name.isprintable():
        raise FileRefused("has a name with letters that cannot be shown: rename it")
    read = _READERS.get(file.suffix.lower())
    if read is None:
        like = nearest(file.suffix.lower(), _READERS)
        raise FileRefused(
            f"files that end in {file.suffix or 'nothing'} are not read; allowed: {', '.join(_READERS)}"
            + (f"; the nearest is {like}" if like else "")
        )
    if wrong := what_is_there(file):
        raise FileRefused(wrong)
    size = file.stat().st_size
    if size > MOST_BYTES:
        raise FileRefused(f"has {size / 1e6:.0f} MB; allowed: {MOST_BYTES / 1e6:.0f}. Add the part that is needed")
    document = read(name, file, tier)
    if not document.text.strip():
        raise FileRefused("is empty")
    if len(document.text) > MOST_LETTERS:
        raise FileRefused(f"has {len(document.text)} letters; allowed: {MOST_LETTERS}. Add the part that is needed")
    day = datetime.fromtimestamp(file.stat().st_mtime, UTC).date().isoformat()
    return document.model_copy(update={"date": document.date or day, "stamp": stamp_of(file)})


def _markdown(name: str, file: Path, tier: Tier) -> Document:
    text = _text(file)
    if text.startswith(f"{FENCE}\n"):
        try:
            return of_note(parse_note(name, text), "file")
        except NoteRefused as refused:
            raise FileRefused("; ".join(refused.reasons)) from refused
    headings = (line.lstrip("#").strip() for line in text.splitlines() if line.startswith("#"))
    return _plain(name, next(filter(None, headings), ""), text, tier)


def _plain_text(name: str, file: Path, tier: Tier) -> Document:
    return _plain(name, "", _text(file), tier)


def _csv(name: str, file: Path, tier: Tier) -> Document:
    try:
        return _plain(name, "", text_of_csv(_text(file)), tier)
    except ValueError as error:
        raise FileRefused(f"is no table: {error}") from error


def _pdf(name: str, file: Path, tier: Tier) -> Document:
    try:
        title, text = text_of_pdf(file)
    except ValueError as error:
        raise FileRefused(str(error)) from error
    return _plain(name, title, text, tier)


def _plain(name: str, title: str, text: str, tier: Tier) -> Document:
    words = Path(name).stem.replace("_", " ").replace("-", " ")
    title = " ".join((title or words).split())[:300]
    return Document(origin="file", name=name, title=title, tier=tier, text=text, sources=[name], keywords=[words])


def _text(file: Path) -> str:
    content = read_bytes(file, MOST_BYTES)
    if b"\0" in content[:_BYTES_LOOKED_AT]:
        raise FileRefused("is no text but binary, whatever its name says")
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise FileRefused(f"is no text in UTF-8 (byte {error.start}): save it as UTF-8") from error


_READERS: dict[str, Callable[[str, Path, Tier], Document]] = {
    ".md": _markdown,
    ".txt": _plain_text,
    ".csv": _csv,
    ".pdf": _pdf,
}
