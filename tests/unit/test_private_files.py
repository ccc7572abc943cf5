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
from gateway.mailbox.paths import GATEWAY_DATA, LOGS, LOOP_DATA, OPERATOR_DATA
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
        own = data / GATEWAY_DATA
        own.mkdir(parents=True)
        file.write_text(line_template(6))
        writer = AuditWriter(own)
        writer.append([])
        writer.close()
        assert (mode_of(own), mode_of(own / AUDIT)) == (0o755, 0o644)  # as somebody has put them there
        before = set(own.rglob("*"))
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
                assert mode_of(own) == 0o700
                made = [one for one in own.iterdir() if one not in before]
                assert made and {one.name: mode_of(one) & 0o077 for one in made} == {one.name: 0 for one in made}
                if os.geteuid() == 0:
                    with child(READS, own / AUDIT) as (_, said):
                        assert said == "PermissionError\n"
            finally:
                process.terminate()


@pytest.mark.usefixtures("umask")
def test_of_a_folder_that_is_named_the_processes_own_are_closed(tmp_path: Path) -> None:
    (tmp_path / LOOP_DATA).mkdir(mode=0o755)
    tmp_path.chmod(0o755)
    assert begin_process(LINE, tmp_path / "run", tmp_path) == (tmp_path / "run", tmp_path)
    assert (mode_of(tmp_path), mode_of(tmp_path / LOOP_DATA)) == (0o755, 0o700)


def test_what_lay_in_one_folder_is_moved_by_the_command_that_a_process_is_refused_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A line would begin a new audit beside its own, and nobody could come in."""
    data = tmp_path / "of a line"
    data.mkdir()
    before = {
        LOOP_DATA: ("configuration.json", "controller.json", "wiring-proof.json"),
        GATEWAY_DATA: ("audit.sqlite", "audit.anchor", "history.sqlite", "history.sqlite-wal", "alarms.json"),
        OPERATOR_DATA: ("users.toml",),
        LOGS: ("loop.log",),
    }
    for name in (name for names in before.values() for name in names):
        (data / name).write_text(name)
    (data / "keys").mkdir()
    (data / "notes.txt").write_text("a person's")
    with pytest.raises(typer.Exit):
        begin_process(LINE, tmp_path / "run", data)
    said = capsys.readouterr().err
    subprocess.run(said[said.index("`") + 1 : said.rindex("`")], shell=True, check=True)  # noqa: S602 (as a person would)
    found = {path.relative_to(data) for path in data.rglob("*") if path.is_file()}
    assert found == {Path(own, name) for own, names in before.items() for name in names} | {Path("notes.txt")}
    assert (data / GATEWAY_DATA / "keys").is_dir()
    assert begin_process(LINE, tmp_path / "run", data)[1] == data


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
