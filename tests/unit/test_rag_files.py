"""Documents of files: what each kind says, and what is refused while the rest goes on."""

import os
from pathlib import Path

import pytest
from pypdf import PdfWriter

from agents.rag import read_files as reading
from agents.rag.documents import Document, consistent
from agents.rag.read_files import read_files
from tests.unit.rag_support import document

NOTE = """+++
title = "Belt of roller 4"
tier = 3
topic = "drives"
sources = ["workshop"]
confidence = 0.7
applies_to = "this line"
serves = ["monitor.diagnosis"]
keywords = ["belt"]
date = "2026-03-01"
+++

It slips above 40 N.
"""


def pdf(text: str) -> bytes:
    """The least that a reader takes for a PDF with a line of text."""
    stream = f"BT /F1 12 Tf 10 100 Td ({text}) Tj ET".encode()
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        b"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 200 200] /Contents 4 0 R"
        b" /Resources << /Font << /F1 << /Type /Font /Subtype /Type1 /BaseFont /Helvetica >> >> >> >>",
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream),
    ]
    content, places = b"%PDF-1.4\n", []
    for number, one in enumerate(objects, start=1):
        places.append(len(content))
        content += b"%d 0 obj\n%s\nendobj\n" % (number, one)
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    return content + (
        b"xref\n0 %d\n0000000000 65535 f \n%strailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n"
        % (len(objects) + 1, table, len(objects) + 1, len(content))
    )


def one_of(path: Path) -> Document:
    read = read_files([path], 2)
    assert read.refused == []
    return read.documents[0]


def refusal_of(path: Path) -> str:
    read = read_files([path], 2)
    assert read.documents == []
    return read.refused[0].reason


def test_a_note_keeps_what_its_head_says(tmp_path: Path) -> None:
    (tmp_path / "belt.md").write_text(NOTE)
    found = one_of(tmp_path / "belt.md")
    assert (found.origin, found.tier, found.title, found.date) == ("file", 3, "Belt of roller 4", "2026-03-01")
    assert found.serves == ["monitor.diagnosis"] and found.text == "It slips above 40 N."


def test_markdown_and_text_without_a_head_take_the_tier_of_the_caller(tmp_path: Path) -> None:
    (tmp_path / "winder_notes.txt").write_text("Core tension 80 N.\n")
    (tmp_path / "manual.md").write_text("\n# The oven\n\nThree zones.\n")
    os.utime(tmp_path / "manual.md", (0, 86_400 * 365))
    text, manual = one_of(tmp_path / "winder_notes.txt"), one_of(tmp_path / "manual.md")
    assert (text.tier, text.title) == (2, "winder notes")
    assert (manual.title, manual.date) == ("The oven", "1971-01-01")


def test_a_table_says_its_columns_and_where_it_is_short_its_rows(tmp_path: Path) -> None:
    (tmp_path / "grades.csv").write_text("grade;tension N;width mm\nPET 12;30;1000\nPET 50;90.5;\n")
    text = one_of(tmp_path / "grades.csv").text
    assert "- tension N: 30 to 90.5, median 60.25, 2 values" in text
    assert "grade: PET 12; tension N: 30; width mm: 1000" in text and "grade: PET 50; tension N: 90.5\n" in text + "\n"
    (tmp_path / "long.csv").write_text("time,tension\n" + "".join(f"{k},{30 + k % 5}\n" for k in range(5000)))
    text = one_of(tmp_path / "long.csv").text
    assert "tension: 30 to 34" in text and "Rows" not in text


def test_a_pdf_gives_its_text(tmp_path: Path) -> None:
    (tmp_path / "drive.pdf").write_bytes(pdf("The drive takes torque off after 100 ms."))
    assert "takes torque off after 100 ms" in one_of(tmp_path / "drive.pdf").text


def test_what_is_no_document_is_refused_with_a_reason_and_the_rest_goes_on(tmp_path: Path) -> None:
    empty = PdfWriter()
    empty.add_blank_page(72, 72)
    empty.write(tmp_path / "scan.pdf")
    empty.encrypt("secret", algorithm="RC4-128")
    empty.write(tmp_path / "locked.pdf")
    contents = {
        "cut.pdf": pdf("x")[:80],
        "fake.pdf": b"not a pdf",
        "image.md": b"\x89PNG\0\0\0",
        "latin.txt": "Öl".encode("latin-1"),
        "empty.txt": b" \n",
        "note.md": NOTE.replace("tier = 3", "tier = 4").encode(),
        "ragged.csv": b"a,b\n1,2\n1,2,3\n",
        "names.csv": b"a,b\n",
        "sheet.xlsx": b"PK",
        "good.txt": b"This one goes on.",
    }
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "tag\u202e.txt").write_text("a name that plays with the terminal")
    (tmp_path / ".hidden.txt").write_text("not looked at")
    read = read_files([tmp_path, tmp_path / "absent.txt"], 2)
    reasons = {one.file: one.reason for one in read.refused}
    assert [one.name for one in read.documents] == ["good.txt"]
    assert set(reasons) == {"scan.pdf", "locked.pdf", "absent.txt", "tag\\u202e.txt", *contents} - {"good.txt"}
    said = {
        "scan.pdf": "only pictures", "locked.pdf": "encrypted", "cut.pdf": "no PDF", "fake.pdf": "no PDF",
        "image.md": "binary", "latin.txt": "save it as UTF-8", "empty.txt": "empty", "note.md": "tier = 4",
        "ragged.csv": "row 3 has 3 cells", "names.csv": "no row", "sheet.xlsx": ".md, .txt, .csv, .pdf",
        "absent.txt": "No such file",
    }  # fmt: skip
    for name, part in said.items():
        assert part in reasons[name], (name, reasons[name])


def test_what_is_too_large_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "MOST_BYTES", 100)
    (tmp_path / "a.txt").write_text("x" * 101)
    assert "allowed" in refusal_of(tmp_path / "a.txt")
    monkeypatch.setattr(reading, "MOST_LETTERS", 10)
    (tmp_path / "b.txt").write_text("x" * 11)
    assert "11 letters" in refusal_of(tmp_path / "b.txt")
    monkeypatch.setattr(reading, "MOST_FILES", 1)
    (tmp_path / "c.txt").write_text("x")
    assert read_files([tmp_path / "c.txt", tmp_path / "a.txt"], 2).refused[0].file == "1 more"


def test_a_pdf_that_hangs_its_reader_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agents.rag.pdf.READ_MAX_S", 0.0)
    (tmp_path / "slow.pdf").write_bytes(pdf("x"))
    assert "was not read within" in refusal_of(tmp_path / "slow.pdf")


def test_a_file_that_has_not_changed_is_not_read_again(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("old")
    before = read_files([tmp_path], 2).documents[0].model_copy(update={"title": "from before"})
    assert read_files([tmp_path], 2, {"a.txt": before}).documents == [before]
    (tmp_path / "a.txt").write_text("newer")
    assert read_files([tmp_path], 2, {"a.txt": before}).documents[0].text == "newer"


def test_the_newer_of_one_name_stays_and_twins_are_one() -> None:
    old, new = document("model", "old", date="2026-01-01"), document("model", "new", date="2026-02-01")
    for order in ([old, new], [new, old]):
        found = consistent(order)
        assert found.documents == [new] and "replaces" in found.left_out[0]
    of_line = document("model", "old", origin="line", title="another")
    assert len(consistent([new, of_line]).documents) == 2  # of another origin: another thing
    twin = document("copy", "old", title=old.title)
    assert consistent([old, twin]).documents == [old] and "same as model" in consistent([old, twin]).left_out[0]
