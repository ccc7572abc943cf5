import socket
from pathlib import Path

import pytest

from gateway.mailbox import paths
from gateway.mailbox.paths import default_run_folder, name_of, running_lines
from tests.unit.supervisor_support import line_of, short_folder


def test_the_run_folder_of_a_session_a_service_and_a_plain_user(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    line = line_of(1, "coater-2")
    leaf = f"{line.site}_coater-2"
    service = tmp_path / "r2rgate"
    monkeypatch.setattr(paths, "_SERVICE", service)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert default_run_folder(line) == tmp_path / "r2rgate" / leaf
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert default_run_folder(line) == service / leaf
    monkeypatch.setattr(paths.os, "access", lambda path, mode: not Path(path).is_relative_to(tmp_path))
    monkeypatch.setattr(paths.os, "getuid", lambda: 1234)
    assert default_run_folder(line) == Path("/tmp/r2rgate-1234") / leaf


def test_a_session_folder_that_does_not_exist_is_passed_over(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(paths, "_SERVICE", tmp_path / "service")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "gone" / "away"))
    assert default_run_folder(line_of(1)).parent == tmp_path / "service"


def test_only_lines_that_answer_are_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    with short_folder() as base:
        monkeypatch.setattr(paths, "_SERVICE", base / "none")
        monkeypatch.setattr(paths, "_bases", lambda: [base, base / "none"])
        for name in ("a-loop-only", "b-gateway", "c-dead", "d-empty"):
            (base / name).mkdir()
        living = []
        for path in ("a-loop-only/loop.sock", "b-gateway/gateway.sock", "c-dead/gateway.sock"):
            listening = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            listening.bind(str(base / path))
            listening.listen()
            living.append(listening)
        living.pop().close()  # leaves its file behind
        try:
            assert running_lines() == [base / "a-loop-only", base / "b-gateway"]
        finally:
            for listening in living:
                listening.close()


def test_no_two_lines_share_a_folder() -> None:
    assert name_of("a-b", "c") != name_of("a", "b-c")
