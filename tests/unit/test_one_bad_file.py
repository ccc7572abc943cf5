"""One bad file stops nothing else: whatever lies in a folder under a good name is named, and all the rest works."""

import asyncio
import json
import os
import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding
from typer.testing import CliRunner

from agents.rag.library import INDEX, NOTES, notes_in, open_library
from drivers.device_map import MAPS, MapRefused, load_map, load_maps, map_names
from drivers.registry import LinksRefused, build_links
from gateway.cli.main import app
from gateway.cli.pki_opcua import self_signed
from gateway.control.design import design_lqi, task_of
from gateway.core.controller import config_hash
from gateway.core.line_template import line_template
from gateway.files import NotText, read_bytes, read_text
from gateway.loop.deaths import DEATHS, Deaths
from gateway.loop.kept import FILE, Store
from gateway.mailbox.paths import running_lines
from gateway.operator.opcua.nodeset_files import look_into
from gateway.operator.opcua.trust import TRUSTED, TrustList
from gateway.operator.users import FILE_NAME as USERS
from gateway.operator.users import Users, UsersRefused
from gateway.storage.sqlite_file import FileKind, begin, open_there
from gateway.supervisor.audit_anchor import FILE_NAME as ANCHOR
from gateway.supervisor.audit_verify import verify
from gateway.supervisor.audit_writer import AuditWriter
from gateway.supervisor.configurations import KIND as CONFIGURATIONS
from gateway.supervisor.interactions import KIND as INTERACTIONS
from gateway.supervisor.model_store import KIND as MODELS
from gateway.supervisor.tail import DamagedTail, read_tail
from sim_plant.plant import PlantRefused, load_plant
from tests.closed_loop.conftest import demo_line
from tests.support.bad_files import BAD_FILES, put

MODEL = "urn:good"
NODE_SET = (
    '<UANodeSet xmlns="http://opcfoundation.org/UA/2011/03/UANodeSet.xsd"><Models>'
    f'<Model ModelUri="{MODEL}" PublicationDate="2024-01-01T00:00:00Z"/></Models></UANodeSet>'
)
EACH = pytest.mark.parametrize("kind", BAD_FILES)
LINE = demo_line(2)
#: Any text is a document; these are none.
NO_DOCUMENT = ("empty", "not UTF-8", "zeros", "a folder", "a pipe", "a socket", "huge")


@EACH
def test_a_file_is_read_within_its_bound_or_refused_at_once(tmp_path: Path, kind: str) -> None:
    put(tmp_path / "file", kind)
    try:
        assert len(read_text(tmp_path / "file", 1_000_000)) <= 1_000_000
    except OSError as error:
        assert error.strerror and error.filename == str(tmp_path / "file")
        assert not isinstance(error, FileNotFoundError), "a link to nowhere is something that is there"
    except NotText as error:
        assert error.line == 1


def test_a_file_at_its_bound_is_read_and_one_beyond_is_not(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(bytes(100))
    assert read_bytes(tmp_path / "file", 100) == bytes(100)
    with pytest.raises(OSError, match="more than 99 bytes"):
        read_bytes(tmp_path / "file", 99)
    with pytest.raises(OSError, match="more than 0 bytes"):  # its size is said to be 0
        read_bytes(Path("/proc/self/status"), 0)
    with pytest.raises(FileNotFoundError):
        read_bytes(tmp_path / "none", 99)
    (tmp_path / "text").write_bytes(b"one\ntwo\n\xff\n")
    with pytest.raises(NotText, match="line 3"):
        read_text(tmp_path / "text", 99)


# Device maps


@pytest.fixture
def maps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a copy of the maps, in which the commands look."""
    folder = tmp_path / "maps"
    shutil.copytree(MAPS, folder)
    for place in ("gateway.cli.line_commands", "gateway.cli.process_commands", "gateway.cli.scan_commands"):
        monkeypatch.setattr(f"{place}.load_maps", lambda: load_maps(folder))
    monkeypatch.setattr("drivers.device_map.load_maps", lambda: load_maps(folder))
    return folder


@EACH
def test_a_bad_map_takes_nothing_from_the_others(maps: Path, kind: str) -> None:
    whole = load_maps(maps)
    put(maps / "bad.toml", kind)
    found = load_maps(maps)
    assert dict(found.usable) == dict(whole.usable) and list(found.unusable) == ["bad"]
    assert all(str(one).startswith("bad.toml:1: ") for one in found.unusable["bad"])
    assert "bad" in map_names(maps) and len(build_links(LINE, maps)) == len(build_links(LINE))
    with pytest.raises(MapRefused, match="bad.toml:1: "):
        load_map(maps / "bad.toml")


def test_a_mistake_in_a_map_is_told_with_its_line_and_the_nearest_key(maps: Path) -> None:
    text = (maps / "loadcell-amp.toml").read_text()
    wrong = text.replace("stride = ", "stridee = ", 1)
    (maps / "bad.toml").write_text(wrong)
    line = next(number for number, one in enumerate(wrong.splitlines(), 1) if "stridee" in one)
    reasons = list(map(str, load_maps(maps).unusable["bad"]))
    assert any(one.startswith(f"bad.toml:{line}: ") and "did you mean 'stride'" in one for one in reasons), reasons
    (maps / "bad.toml").write_text('format = 1\nprotocol = "canopn"\nrole = "drve"\n')
    (problem,) = load_maps(maps).unusable["bad"]
    assert problem.line == 2 and problem.nearest == "protocol = 'canopen' with role = 'drive'"
    (maps / "bad.toml").write_text('format = 1\nprotocl = "canopen"\nrole = "drive"\n')
    (problem,) = load_maps(maps).unusable["bad"]
    assert (problem.line, problem.nearest) == (2, "'protocol'")


def test_a_folder_of_maps_that_is_not_there_is_told_and_refuses_the_lines_that_need_it(tmp_path: Path) -> None:
    found = load_maps(tmp_path / "none")
    assert not found.usable and "cannot be listed" in str(found.unusable["none"][0])
    with pytest.raises(LinksRefused, match="cannot be listed"):
        build_links(LINE, tmp_path / "none")


def test_only_a_line_that_names_the_map_is_refused(maps: Path, tmp_path: Path) -> None:
    text = (maps / "loadcell-amp.toml").read_text()
    (maps / "draft.toml").write_text(text.replace("address_base = 0", "address_base = 7"))
    other, named = tmp_path / "other.toml", tmp_path / "named.toml"
    other.write_text(line_template(2))
    named.write_text(line_template(2).replace('"loadcell-amp"', '"draft"'))
    good = CliRunner().invoke(app, ["check", str(other)])
    assert good.exit_code == 0 and "draft.toml:" in good.output and "not usable" in good.output
    warnings = json.loads(CliRunner().invoke(app, ["check", "--json", str(other)]).output)["warnings"]
    assert [one["file"] for one in warnings] == ["draft.toml"]
    commands = (["check"], ["doctor"], ["design"], ["loop"], ["run"], ["gateway"], ["agents"], ["operator"])
    for command in commands:
        bad = CliRunner().invoke(app, [*command, str(named)])
        assert bad.exit_code == 2 and isinstance(bad.exception, SystemExit), (command, bad.exception)
        assert "draft.toml:" in bad.output and "address_base" in bad.output and "Traceback" not in bad.output


@pytest.mark.wires
def test_scan_and_doctor_list_what_is_not_usable(maps: Path, tmp_path: Path) -> None:
    put(maps / "draft.toml", "half written")
    scanned = CliRunner().invoke(app, ["scan", "modbus", "127.0.0.1", "--port", "1", "--units", "1"])
    assert "draft.toml:1: " in scanned.output and "no connection" in scanned.output
    (tmp_path / "line.toml").write_text(line_template(2))
    folders = ["--run-dir", str(tmp_path / "r"), "--data-dir", str(tmp_path / "d")]
    told = CliRunner().invoke(app, ["doctor", str(tmp_path / "line.toml"), "--json", "--seconds", "0.2", *folders])
    checks = [one for one in json.loads(told.stdout)["checks"] if one["group"] == "device maps"]
    assert [(one["subject"], one["verdict"]) for one in checks] == [("draft", "warning")]


# Knowledge


@EACH
def test_a_bad_note_takes_nothing_from_the_others(tmp_path: Path, kind: str) -> None:
    shutil.copytree(NOTES, tmp_path / "notes")
    whole, none = notes_in(tmp_path / "notes")
    put(tmp_path / "notes" / "control" / "bad.md", kind)
    found, refused = notes_in(tmp_path / "notes")
    assert none == [] and found == whole and [one.file for one in refused] == ["control/bad.md"] and refused[0].reason


def test_a_mistake_in_the_head_of_a_note_is_told_with_its_line(tmp_path: Path) -> None:
    shutil.copytree(NOTES, tmp_path / "notes")
    note = next(iter(sorted((tmp_path / "notes" / "control").glob("*.md"))))
    text = note.read_text().replace("confidence =", "confidnce =", 1)
    line = next(number for number, one in enumerate(text.splitlines(), 1) if "confidnce" in one)
    note.write_text(text)
    _, (refused,) = notes_in(tmp_path / "notes")
    assert f"line {line}: " in refused.reason and "did you mean confidence?" in refused.reason


@pytest.mark.parametrize("kind", [*NO_DOCUMENT, *(kind for kind in BAD_FILES if kind.startswith("a link"))])
def test_a_bad_document_takes_nothing_from_the_others(tmp_path: Path, kind: str) -> None:
    (tmp_path / "documents").mkdir()
    (tmp_path / "documents" / "good.md").write_text("Dancer rollers are light.")
    put(tmp_path / "documents" / "bad.md", kind)
    opened = asyncio.run(open_library(tmp_path, 2))
    with opened.index as index:
        names = [one.name for one in index.documents() if one.origin == "file"]
    assert names == ["good.md"] and [one.file for one in opened.refused] == ["bad.md"]


@pytest.mark.parametrize("kind", [kind for kind in BAD_FILES if kind != "a folder"])
def test_a_bad_index_is_made_anew(tmp_path: Path, kind: str) -> None:
    put(tmp_path / INDEX, kind)
    opened = asyncio.run(open_library(tmp_path, 2))
    opened.index.close()
    assert opened.made and opened.index.documents_count > 100


# What is kept of a line


@EACH
def test_a_bad_kept_configuration_is_told_and_the_given_one_runs(tmp_path: Path, kind: str) -> None:
    config = design_lqi(task_of(LINE))
    put(tmp_path / FILE, kind)
    said = list[str]()
    assert Store(tmp_path, config).read(LINE, said.append) is None
    assert len(said) == 1 and said[0].startswith(f"{tmp_path / FILE} is not used, the configuration given is: ")


@EACH
def test_a_bad_count_of_deaths_is_told_and_counts_nothing(tmp_path: Path, kind: str) -> None:
    config = design_lqi(task_of(LINE))
    put(tmp_path / DEATHS, kind)
    said = list[str]()
    assert Store(tmp_path, config).read(LINE, said.append) is None
    assert len(said) == 1 and str(tmp_path / DEATHS) in said[0]
    assert not Deaths(tmp_path / DEATHS).too_often(config_hash(config))


@EACH
def test_a_bad_controller_is_refused_in_a_sentence(tmp_path: Path, kind: str) -> None:
    (tmp_path / "line.toml").write_text(line_template(2))
    put(tmp_path / "controller.json", kind)
    loop = ["loop", str(tmp_path / "line.toml"), "--controller", str(tmp_path / "controller.json")]
    result = CliRunner().invoke(app, [*loop, "--run-dir", str(tmp_path / "r"), "--data-dir", str(tmp_path / "d")])
    assert result.exit_code == 2 and isinstance(result.exception, SystemExit), result.exception
    assert str(tmp_path / "controller.json") in result.output


@EACH
@pytest.mark.parametrize("store", [CONFIGURATIONS, MODELS, INTERACTIONS], ids=lambda kind: kind.name)
def test_a_bad_store_is_named_and_left_as_it_is(tmp_path: Path, kind: str, store: FileKind) -> None:
    path = tmp_path / "store.sqlite"
    put(path, kind)
    before = os.lstat(path)
    for opened in (open_there, begin) if kind != "empty" else (open_there,):
        with pytest.raises(store.error, match=str(path)):
            opened(path, store)
    after = os.lstat(path)
    assert (after.st_mode, after.st_size, after.st_ino) == (before.st_mode, before.st_size, before.st_ino)


@EACH
def test_a_bad_anchor_is_told_and_nothing_is_written_upon_it(tmp_path: Path, kind: str) -> None:
    writer = AuditWriter(tmp_path)
    writer.append([])
    writer.close()
    put(tmp_path / ANCHOR, kind)
    assert any(ANCHOR in text for text in verify(tmp_path).problems)
    with pytest.raises(Exception, match=ANCHOR) as refused:
        AuditWriter(tmp_path).append([])
    assert type(refused.value).__name__ == "AuditUnavailable"


@EACH
def test_a_bad_tail_of_the_history_is_known_for_none(tmp_path: Path, kind: str) -> None:
    put(tmp_path / "tail", kind)
    if kind == "empty":
        assert read_tail(tmp_path / "tail") is None
        return
    with pytest.raises(DamagedTail, match=str(tmp_path / "tail")):
        read_tail(tmp_path / "tail")


# Who may come in


@pytest.fixture(scope="module")
def certificate_der() -> bytes:
    """Of an OPC UA client."""
    pair = self_signed("client", "urn:test:client", [], datetime.now(UTC))
    return x509.load_pem_x509_certificate(pair.certificate).public_bytes(Encoding.DER)


@EACH
def test_bad_users_let_nobody_in_and_are_told(tmp_path: Path, kind: str) -> None:
    put(tmp_path / USERS, kind)
    if (tmp_path / USERS).is_file():
        (tmp_path / USERS).chmod(0o600)
    with pytest.raises(UsersRefused, match=str(tmp_path / USERS)):
        Users.read(tmp_path / USERS)


def test_a_mistake_in_the_users_is_told_with_its_line_and_the_nearest_key(tmp_path: Path) -> None:
    Users.nobody().with_user("anna", "four words in a row", "operator").write(tmp_path / USERS)
    text = (tmp_path / USERS).read_text()
    (tmp_path / USERS).write_text(text.replace("role =", "rol ="))
    line = next(number for number, one in enumerate(text.splitlines(), 1) if one.startswith("role ="))
    with pytest.raises(UsersRefused, match=rf"{USERS}:{line}: .*did you mean 'role'"):
        Users.read(tmp_path / USERS)


@EACH
def test_a_bad_trusted_certificate_lets_nobody_in_and_keeps_nobody_out(
    tmp_path: Path, kind: str, certificate_der: bytes
) -> None:
    (tmp_path / TRUSTED).mkdir()
    (tmp_path / TRUSTED / "good.der").write_bytes(certificate_der)
    put(tmp_path / TRUSTED / "bad.der", kind)
    said = list[str]()
    trusted = TrustList(tmp_path, said.append, lambda: datetime.now(UTC))
    trusted.look()
    trusted.look()
    assert trusted.holds(certificate_der) and not trusted.holds(b"")
    assert len(said) == 1 and str(tmp_path / TRUSTED / "bad.der") in said[0]


@EACH
def test_a_bad_node_set_takes_nothing_from_the_others(tmp_path: Path, kind: str) -> None:
    (tmp_path / "good.xml").write_text(NODE_SET)
    put(tmp_path / "bad.xml", kind)
    found = look_into(tmp_path)
    assert list(found.node_sets) == [MODEL]
    assert len(found.problems) == 1 and str(tmp_path / "bad.xml") in found.problems[0]


# Other places


@EACH
def test_what_lies_where_lines_run_hides_no_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    before = running_lines()
    put(tmp_path / "r2rgate", kind)
    assert running_lines() == before
    (tmp_path / "r2rgate").rmdir() if kind == "a folder" else (tmp_path / "r2rgate").unlink()
    (tmp_path / "r2rgate" / "demo-line").mkdir(parents=True)
    put(tmp_path / "r2rgate" / "demo-line" / "loop.sock", kind)
    assert running_lines() == before


@EACH
def test_a_bad_plant_is_refused(tmp_path: Path, kind: str) -> None:
    put(tmp_path / "plant.toml", kind)
    with pytest.raises((PlantRefused, OSError), match=str(tmp_path / "plant.toml")):
        load_plant(tmp_path / "plant.toml")


def test_what_a_loop_cannot_use_is_an_event_with_a_code(tmp_path: Path) -> None:
    put(tmp_path / FILE, "half written")
    put(tmp_path / DEATHS, "a folder")
    store = Store(tmp_path, design_lqi(task_of(LINE)))
    assert store.read(LINE, lambda _: None) is None
    told = [one.as_data() for one in store.unusable]
    assert [(one.code, one.parameters["file"]) for one in told if one is not None] == [
        ("file-unusable", str(tmp_path / DEATHS)),
        ("file-unusable", str(tmp_path / FILE)),
    ]
