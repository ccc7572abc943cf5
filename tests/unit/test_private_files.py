"""What a process of a line keeps is its user's alone: real processes, folders as earlier versions have made them."""

import os
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from gateway.cli.process_commands import begin_process
from gateway.core.line_template import line_template
from gateway.supervisor.audit_file import FILE_NAME as AUDIT
from gateway.supervisor.audit_writer import AuditWriter
from tests.unit.supervisor_support import child, line_of, short_folder

pytestmark = pytest.mark.wires

ROOT = Path(__file__).parents[2]
LINE = line_of(6)

#: Another user, who holds a read lock on the whole audit for as long as he likes where he can open it.
READS = """
import fcntl, os, sys
os.setgid(64003)
os.setuid(64003)
try:
    fcntl.lockf(os.open(sys.argv[1], os.O_RDONLY), fcntl.LOCK_SH)
    print("locked", flush=True)
except OSError as error:
    print(type(error).__name__, flush=True)
"""


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture
def umask() -> Iterator[None]:
    """As a person's shell has it; what a command sets ends with the test."""
    before = os.umask(0o022)
    yield
    os.umask(before)


@pytest.mark.usefixtures("umask")
def test_who_is_not_the_lines_user_can_neither_read_its_files_nor_lock_them() -> None:
    with short_folder() as folder:
        folder.chmod(0o755)
        data, file = folder / "data", folder / "line.toml"
        data.mkdir()
        file.write_text(line_template(6))
        writer = AuditWriter(data)
        writer.append([])
        writer.close()
        assert (mode_of(data), mode_of(data / AUDIT)) == (0o755, 0o644)  # as earlier versions have left them
        before = set(data.rglob("*"))
        command = [
            sys.executable,
            "-m",
            "gateway.cli",
            "gateway",
            file,
            "--run-dir",
            folder / "run",
            "--data-dir",
            data,
        ]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
            try:
                assert process.stdout is not None and process.stdout.readline().startswith("gateway of ")
                assert mode_of(data) == 0o700
                made = [one for one in data.iterdir() if one not in before]
                assert made and {one.name: mode_of(one) & 0o077 for one in made} == {one.name: 0 for one in made}
                if os.geteuid() == 0:
                    with child(READS, data / AUDIT) as (_, said):
                        assert said == "PermissionError\n"
            finally:
                process.terminate()


@pytest.mark.usefixtures("umask")
def test_a_folder_that_is_named_is_closed_where_databases_lie_in_it(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("to be read by all")
    tmp_path.chmod(0o755)
    assert begin_process(LINE, tmp_path / "run", tmp_path) == (tmp_path / "run", tmp_path)
    assert mode_of(tmp_path) == 0o755
    (tmp_path / "history.sqlite").write_bytes(b"")
    assert mode_of(tmp_path / "history.sqlite") == 0o600
    begin_process(LINE, tmp_path / "run", tmp_path)
    assert mode_of(tmp_path) == 0o700
    assert mode_of(tmp_path / "notes.txt") == 0o644


@pytest.mark.usefixtures("umask")
def test_the_lines_own_folder_is_closed_whatever_lies_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gateway.cli.process_commands.data_base", lambda: tmp_path)
    data = tmp_path / f"{LINE.site}_{LINE.line}"
    data.mkdir(mode=0o755)
    assert begin_process(LINE, tmp_path / "run", None)[1] == data
    assert mode_of(data) == 0o700


def test_a_folder_of_an_earlier_version_is_not_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A line would begin a new audit beside its own."""
    monkeypatch.setattr("gateway.cli.process_commands.data_base", lambda: tmp_path)
    earlier = tmp_path / f"{LINE.site}-{LINE.line}"
    earlier.mkdir()
    with pytest.raises(typer.Exit):
        begin_process(LINE, tmp_path / "run", None)
    assert f"mv {earlier} {tmp_path / f'{LINE.site}_{LINE.line}'}" in capsys.readouterr().err
