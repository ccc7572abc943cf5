"""Which of a folder's files holds which model. What a file is, is told by its content, and no content harms."""

from pathlib import Path

import pytest

from gateway.operator.opcua.nodeset_files import MOST_BYTES, Model, NotUsable, look_into
from tests.protocol.nodeset_support import DATE, DI, MACHINERY, SMALL, node_set, write


def test_models_are_found_whatever_their_files_are_called(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "readme.txt").write_text("no matter", encoding="utf-8")
    (tmp_path / "folder.xml").mkdir()
    found = look_into(tmp_path)
    assert found.problems == [f"{tmp_path / 'folder.xml'} cannot be read: Is a directory"]
    assert set(found.node_sets) == set(SMALL)
    assert found.node_sets[MACHINERY].model == Model(MACHINERY, DATE)
    assert found.node_sets[MACHINERY].requires == (Model(DI, DATE),)
    assert found.node_sets[DI].read().decode() == SMALL[DI]


@pytest.mark.parametrize("names", [("a.xml", "b.xml"), ("b.xml", "a.xml")])
def test_of_two_versions_the_newer_counts(tmp_path: Path, names: tuple[str, str]) -> None:
    for name, date in zip(names, ("2020-01-01T00:00:00Z", "2023-01-01T00:00:00Z"), strict=True):
        (tmp_path / name).write_text(node_set(DI, "", date=date), encoding="utf-8")
    assert look_into(tmp_path).node_sets[DI].path.name == names[1]


def test_a_file_of_another_encoding_is_read_as_it_says(tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_bytes(node_set(DI, "").replace("utf-8", "utf-16").encode("utf-16"))
    assert set(look_into(tmp_path).node_sets) == {DI}


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "names no model"),
        (b"no xml", "is no XML"),
        (b"<UANodeSet><Models><Model ModelUri='a'/></Models></UANodeSet>", "names no model"),
        (node_set(DI, "").replace("<Model ", "<Model ModelUri='again'/><Model ").encode(), "holds 2 models"),
        (b"<!-- " + b"x" * 100_000 + b"-->" + node_set(DI, "").split("\n")[1].encode(), "names no model"),
        (node_set(DI, "").replace("utf-8", "klingon").encode(), "is no XML"),
        (
            node_set(DI, "").replace("\n", '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/hostname">]>').encode(),
            "declares a document type",
        ),
    ],
)
def test_what_is_no_node_set_is_told_and_the_others_count(tmp_path: Path, content: bytes, told: str) -> None:
    write(tmp_path)
    (tmp_path / "bad.xml").write_bytes(content)
    found = look_into(tmp_path)
    (problem,) = found.problems
    assert told in problem and str(tmp_path / "bad.xml") in problem and set(found.node_sets) == set(SMALL)


def test_entities_that_grow_are_not_resolved(tmp_path: Path) -> None:
    grown = "".join(f'<!ENTITY e{k + 1} "{f"&e{k};" * 10}">' for k in range(12))
    text = node_set(DI, "").replace("\n", f'<!DOCTYPE a [<!ENTITY e0 "x">{grown}]>').replace(DI, "&e12;")
    (tmp_path / "a.xml").write_text(text, encoding="utf-8")
    found = look_into(tmp_path)
    assert "declares a document type" in found.problems[0] and not found.node_sets


def test_a_file_that_is_too_large_is_not_read_whole(tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_bytes(node_set(DI, "").encode() + b" " * MOST_BYTES)
    (found,) = look_into(tmp_path).node_sets.values()
    with pytest.raises(NotUsable, match=f"more than {MOST_BYTES} bytes"):
        found.read()


def test_what_cannot_be_read_is_told(tmp_path: Path) -> None:
    (problem,) = look_into(tmp_path / "nowhere").problems
    assert problem == f"{tmp_path / 'nowhere'} cannot be read: No such file or directory"
    write(tmp_path)
    found = look_into(tmp_path).node_sets[DI]
    found.path.unlink()
    with pytest.raises(NotUsable, match="cannot be read"):
        found.read()
