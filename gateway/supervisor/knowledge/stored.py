"""What is known of a line without asking its gateway, whether one runs or not."""

from dataclasses import replace
from pathlib import Path

from gateway.core.line import Line
from gateway.supervisor.audit_file import FILE_NAME as AUDIT
from gateway.supervisor.gate import CannotBegin, book_in
from gateway.supervisor.knowledge.gathered import Known, LineKnowledge, now_of
from gateway.supervisor.lifecycle import Book


def known_in(folder: Path, line: Line) -> Known:
    """Of the line's file and the stores in its data folder, which need not be there. Raises nothing; it blocks."""
    book, wrong = Book(), list[str]()
    if (folder / AUDIT).is_file():
        try:
            book = book_in(folder)
        except CannotBegin as error:
            wrong.append(f"what became of proposals: {error}")
    known = LineKnowledge(line, folder).told(now_of(book))
    return replace(known, left_out=[*wrong, *known.left_out])
