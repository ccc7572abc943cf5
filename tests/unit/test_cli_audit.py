"""`r2rgate audit`, `configurations` and `baselines` as a user runs them."""

import json
import os
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gateway.cli.main import app
from gateway.core.audit_export import RecordLine, line_text, parse_line
from gateway.core.audit_record import Who, canonical, head_of
from gateway.supervisor.audit_file import FILE_NAME
from gateway.supervisor.audit_writer import AuditWriter, Draft
from gateway.supervisor.baselines import begin_baselines
from gateway.supervisor.configurations import Origin, begin_configurations
from tests.unit.test_configurations import SITE, controller, run


def r2rgate(*given: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, [*map(str, given)])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, result.stderr


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Records of 14:05, 14:06, ...: begun, proposed, approved, proposed."""
    folder, now = tmp_path_factory.mktemp("data"), iter(range(1785765900, 1785770000, 60))
    writer = AuditWriter(folder, wall_clock=lambda: float(next(now)))
    ann = Who(name="ann", uid=1000, pid=7)
    writer.append([])
    writer.append([Draft("proposed", ann, {"proposal": "p-000012"}, {"controller": b"phi", "verdict": b"\xff\x00"})])
    writer.append([Draft("approved", ann, {"proposal": "p-000012"}, {"controller": b"phi"})])
    writer.append([Draft("proposed", Who(name="refine"), {"proposal": "p-000013", "text": "\x1b[31mred"})])
    writer.close()
    return folder


@pytest.fixture
def folder(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "data"))


def relinked(text: str, begun: str) -> str:
    """The line of a record after the first, made anew as if it followed `begun`."""
    line = parse_line(text.encode())
    if not isinstance(line, RecordLine) or line.record.sequence == 1:
        return text
    record = line.record.model_copy(update={"previous": json.loads(begun)["head"]})
    return line_text(RecordLine(head=head_of(canonical(record)), record=record)) + "\n"


def shown(folder: Path, *options: str) -> list[int]:
    code, said, err = r2rgate("audit", "show", "--data-dir", folder, "--json", *options)
    assert code == 0, err
    return [one["sequence"] for one in json.loads(said)]


def test_a_sound_audit_is_verified_and_its_head_noted_elsewhere_is_looked_up(folder: Path) -> None:
    code, said, _ = r2rgate("audit", "verify", "--data-dir", folder)
    assert code == 0 and ": sound" in said and "4 records, 2 blobs" in said
    code, said, _ = r2rgate("audit", "verify", "--data-dir", folder, "--json")
    found = json.loads(said)
    assert code == 0 and found["sound"] and found["anchor"] == {"sequence": 4, "head": found["head"]}
    head = f"4:{found['head']}"
    assert r2rgate("audit", "verify", "--data-dir", folder, "--head", head)[0] == 0
    for other in (f"3:{found['head']}", f"9:{found['head']}"):
        code, said, _ = r2rgate("audit", "verify", "--data-dir", folder, "--head", other)
        assert code == 1 and "noted elsewhere" in said
    assert r2rgate("audit", "verify", "--data-dir", folder, "--head", "four")[0] == 2


def test_records_are_shown_the_newest_last_and_by_what_is_asked(folder: Path) -> None:
    code, said, _ = r2rgate("audit", "show", "--data-dir", folder)
    lines = said.splitlines()
    assert code == 0 and lines[0].startswith("#1  2026-08-03 14:05:00 UTC  begun")
    assert "#2  2026-08-03 14:06:00 UTC  proposed  by ann (uid 1000, pid 7)" in said
    assert "proposal: p-000012" in said and "verdict: -> " in said and "\x1b" not in said
    assert shown(folder) == [1, 2, 3, 4] and shown(folder, "--last", "2") == [3, 4]
    assert shown(folder, "--kind", "proposed") == [2, 4]
    assert shown(folder, "--since", "2026-08-03T14:07:00+00:00") == [3, 4] and shown(folder, "--since", "99999d") != []
    assert shown(folder, "--id", "p-000012") == [2, 3] and shown(folder, "--id", "4") == [4]
    whole = json.loads(r2rgate("audit", "show", "--data-dir", folder, "--json")[1])
    assert shown(folder, "--id", whole[1]["record"]["blobs"]["controller"][:8]) == [2, 3]
    assert shown(folder, "--id", whole[2]["head"][:10]) == [3]
    code, _, err = r2rgate("audit", "show", "--data-dir", folder, "--kind", "propsed")
    assert code == 2 and "did you mean proposed?" in err
    code, _, err = r2rgate("audit", "show", "--data-dir", folder, "--since", "yesterday")
    assert code == 2 and "allowed is" in err


def test_an_export_is_verified_without_the_database(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "audit.jsonl"
    code, said, err = r2rgate("audit", "export", "--data-dir", folder, "--out", out)
    assert code == 0 and "4 records, 2 blobs" in said, err
    assert [json.loads(line)["type"] for line in out.read_text().splitlines()] == [
        "record", "blob", "blob", "record", "record", "record",
    ]  # fmt: skip
    assert r2rgate("audit", "verify", "--export", out)[0] == 0
    assert r2rgate("audit", "export", "--data-dir", folder, "--out", out)[0] == 2  # it is there
    assert r2rgate("audit", "export", "--data-dir", folder, "--out", "-")[1] == out.read_text()
    lines = out.read_text().splitlines(keepends=True)
    another = [relinked(line, lines[0]) for line in lines]  # each as it should be, of a chain of its own
    for spoilt, why in (
        (lines[:3] + lines[4:], "does not follow record 1"),
        (lines[:1] + lines[2:], "is missing: blob"),
        ([*lines[:4], *another[4:]], "record 3 does not follow record 2"),
        ([line.replace("p-000013", "p-000014") for line in lines], "is not the hash of its content"),
        ([line.replace('"phi"', '"psi"') for line in lines], "is not what was stored"),
    ):
        out.write_text("".join(spoilt))
        code, said, _ = r2rgate("audit", "verify", "--export", out)
        assert code == 1 and why in said


def test_a_damaged_audit_is_told_is_not_exported_and_is_begun_anew(folder: Path, tmp_path: Path) -> None:
    content = (folder / FILE_NAME).read_bytes()
    (folder / FILE_NAME).write_bytes(content.replace(b"p-000013", b"p-000014"))
    code, said, _ = r2rgate("audit", "verify", "--data-dir", folder)
    assert code == 1 and "NOT SOUND" in said and "record 4 is damaged" in said
    code, said, _ = r2rgate("audit", "show", "--data-dir", folder)
    assert code == 0 and "#4  DAMAGED" in said and "#3  2026" in said
    assert r2rgate("audit", "export", "--data-dir", folder, "--out", tmp_path / "out.jsonl")[0] == 1
    assert not (tmp_path / "out.jsonl").exists()
    assert r2rgate("audit", "begin-anew", "--data-dir", folder)[0] == 2  # without a reason
    code, said, err = r2rgate("audit", "begin-anew", "--data-dir", folder, "--because", "a test")
    assert code == 0 and "not sound" in said, err
    assert r2rgate("audit", "verify", "--data-dir", folder)[0] == 0
    kept = next(folder.glob("audit-*"))
    assert r2rgate("audit", "verify", "--data-dir", kept)[0] == 1


def test_where_there_is_no_audit_nothing_is_made(tmp_path: Path) -> None:
    code, said, _ = r2rgate("audit", "verify", "--data-dir", tmp_path)
    assert code == 1 and "there is no audit" in said
    assert r2rgate("audit", "show", "--data-dir", tmp_path / "none")[0] == 2
    assert list(tmp_path.iterdir()) == []


def test_configurations_are_listed_shown_compared_and_archived(tmp_path: Path) -> None:
    data = ("--data-dir", tmp_path)
    with begin_configurations(tmp_path / "configurations.sqlite") as storage:
        first = storage.store(*SITE, controller(), Origin(1.0, "design", "first"))
        storage.store(*SITE, controller(0.011), Origin(2.0, "refine", "later", parent=first.id))
    code, said, err = r2rgate("configurations", "archive", "1", "--because", "it held", *data)
    assert code == 0 and "phi_stable: version 1" in said, err
    _, said, _ = r2rgate("audit", "show", "--kind", "archived", "--json", *data)
    (one,) = json.loads(said)
    assert one["record"]["what"] == {
        "configuration": first.id,
        "version": 1,
        "name": "phi_stable",
        "because": "it held",
    }
    assert one["record"]["who"]["uid"] == os.getuid() and r2rgate("audit", "verify", *data)[0] == 0
    for name, why in (("3", "is no name"), ("other", "another process writes the audit")):
        writer = AuditWriter(tmp_path)
        writer.lock()
        code, _, err = r2rgate("configurations", "archive", "1", "--name", name, "--because", "x", *data)
        writer.close()
        assert code == 2 and "nothing was archived" in err and why in err
    code, said, _ = r2rgate("configurations", "list", *data)
    assert code == 0 and "phi_stable" in said and "v2" in said and first.id[:8] in said
    code, said, _ = r2rgate("configurations", "list", "--archived", "--json", *data)
    assert [one["version"] for one in json.loads(said)["configurations"]] == [1]
    code, said, _ = r2rgate("configurations", "show", "phi_stable", "--json", *data)
    assert json.loads(said)["controller"]["latency_s"] == 0.01 and "archived" in said
    assert "put forward 1970-01-01 00:00 UTC by design: first" in r2rgate("configurations", "show", "1", *data)[1]
    code, said, _ = r2rgate("configurations", "compare", "phi_stable", "newest", "--json", *data)
    assert json.loads(said)["differences"] == [{"name": "latency_s", "a": 0.01, "b": 0.011}]
    assert "latency_s" in r2rgate("configurations", "compare", "1", "2", *data)[1]
    code, _, err = r2rgate("configurations", "show", "phi_stabel", *data)
    assert code == 2 and "a name (phi_stable)" in err


def test_baselines_are_listed(tmp_path: Path) -> None:
    with begin_baselines(tmp_path / "baselines.sqlite") as database:
        for rmse_n in (1.25, 0.75):
            number = database.add(run(rmse_n=rmse_n)).number
            database.set_baseline(number, 1.0, "r2rgate", "end of phase 2")
        database.add(run("velocity", configuration="d" * 64))
    code, said, err = r2rgate("baselines", "--data-dir", tmp_path)
    assert code == 0 and "never" in said and "3 of 3 measurements" in said, err
    marks = [line.split()[0] for line in said.splitlines() if "tension" in line]
    assert marks == ["(*)", "*"]
    code, said, _ = r2rgate("baselines", "--data-dir", tmp_path, "--json", "--configuration", "cccc")
    assert [(one["measured"]["rmse_n"], one["is_baseline"]) for one in json.loads(said)["measurements"]] == [
        (1.25, False), (0.75, True),
    ]  # fmt: skip
    assert json.loads(said)["measurements"][0]["measured"]["settling_s"] is None
    assert r2rgate("baselines", "--data-dir", tmp_path / "none")[0] == 2
