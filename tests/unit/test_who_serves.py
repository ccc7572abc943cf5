"""Who listens is asked before anything is sent: real sockets, and as root a process of another user that listens."""

import asyncio
import os
import socket
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gateway.cli.stop_line import stop_line
from gateway.core.messages import Reply
from gateway.core.topics import GATEWAY_COMMAND, LOOP_COMMAND, LOOP_TELEMETRY
from gateway.mailbox import paths, who_serves
from gateway.mailbox.bus import BusUnavailable, connect
from gateway.mailbox.codec import Envelope, Kind, encode
from gateway.mailbox.dial import dial, dial_patiently
from gateway.mailbox.listener import CannotListen, Listener
from gateway.mailbox.loop_proof import KEY_FILE, NoKey, keep_key, new_key, read_key
from gateway.mailbox.paths import BUS_SOCKET, LOOP_SOCKET, running_lines
from gateway.mailbox.unix import UnixMailbox
from gateway.mailbox.who_serves import ServedByStranger, named, unsafe_place
from tests.unit.supervisor_support import child, short_folder
from tests.unit.test_supervisor_process import gateway, loop_and_client, run, status_with

pytestmark = pytest.mark.wires

STRANGER = 64002
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can start a process of another user")

#: Listens as another user, wherever root may, and says how long each message is.
LISTENS = """
import os, socket, sys
listening = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
listening.bind(sys.argv[1])
os.setgid(64002)
os.setuid(64002)
listening.listen()
print("listens", flush=True)
while True:
    taken, _ = listening.accept()
    while heard := taken.recv(65536):
        print(len(heard), flush=True)
"""


@contextmanager
def stranger(path: Path) -> Iterator[subprocess.Popen[str]]:
    with child(LISTENS, path) as (process, said):
        assert said == "listens\n", process.communicate()
        yield process


@needs_root
@pytest.mark.parametrize("dialled", [dial, lambda path: dial_patiently(path, 5.0)], ids=["at-once", "patiently"])
def test_a_stranger_who_listens_is_found_out_and_named(dialled: Callable[[Path], socket.socket]) -> None:
    with short_folder() as folder, stranger(folder / LOOP_SOCKET) as process:
        with pytest.raises(ServedByStranger) as refused:
            dialled(folder / LOOP_SOCKET)
        assert refused.value.found.code == "served-by-stranger"
        told = {"path": str(folder / LOOP_SOCKET), "process_uid": STRANGER, "process_pid": process.pid}
        assert refused.value.found.parameters == told


@needs_root
def test_a_stranger_hears_nothing_until_root_has_named_him(monkeypatch: pytest.MonkeyPatch) -> None:
    async def story(folder: Path) -> None:
        run_folder = folder / "base" / "line"
        run_folder.mkdir(parents=True)
        monkeypatch.setattr(who_serves, "NAMED", folder)
        monkeypatch.setattr(paths, "_bases", lambda: [folder / "base"])
        turn = iter(range(10**9))
        mailbox = UnixMailbox(lambda: float(next(turn)))  # it looks for the listener at each publish
        mailbox.connect((LOOP_COMMAND, LOOP_TELEMETRY), run_folder / LOOP_SOCKET)
        with stranger(run_folder / LOOP_SOCKET) as process:
            assert not mailbox.publish(LOOP_TELEMETRY, b"of no concern to others")
            assert f"user {STRANGER}" in mailbox.counters.last_error
            with pytest.raises(ServedByStranger):
                await mailbox.request(LOOP_COMMAND, b"nor is this", 5.0)
            assert running_lines() == []
            list_ = folder / "line"
            list_.write_text(f"1\n{STRANGER}\n")
            list_.chmod(0o666)  # by whoever may write it anybody is named
            assert not mailbox.publish(LOOP_TELEMETRY, b"still of no concern")
            list_.chmod(0o644)
            assert running_lines() == [run_folder]
            assert mailbox.publish(LOOP_TELEMETRY, b"now")
            assert process.stdout is not None
            heard = int(await asyncio.to_thread(process.stdout.readline))
            assert heard == len(encode(Envelope(Kind.PUBLISH, LOOP_TELEMETRY.name, 0, b"now")))  # nothing before it
        await mailbox.close()

    run(story)


@needs_root
def test_a_stop_goes_through_the_gateway_where_a_stranger_has_the_loops_socket() -> None:
    async def story(folder: Path) -> None:
        async def relay(_: bytes) -> bytes:
            return Reply(ok=True, state="STOP", text="done").model_dump_json().encode()

        serving = UnixMailbox()
        serving.serve(GATEWAY_COMMAND, relay)
        with stranger(folder / LOOP_SOCKET):
            with pytest.raises(ServedByStranger):  # neither way: it is said who listens
                await stop_line(folder, 5.0)
            await serving.listen(folder / "gateway.sock")
            reply = await stop_line(folder, 5.0)
            assert reply.ok and {one.code for one in reply.findings} == {"served-by-stranger"}
        await serving.close()

    run(story)


@needs_root
def test_the_gateway_alarms_a_stranger_on_the_loops_socket() -> None:
    async def story(folder: Path) -> None:
        with stranger(folder / LOOP_SOCKET), gateway(folder):
            async with loop_and_client(folder, shown=False) as (_, client):
                status = await status_with(
                    client, lambda status: any(one.name == "false-loop" for one in status.alarms)
                )
                assert {one.code for one in status.loop.false_loop} == {"served-by-stranger"}

    run(story)


@needs_root
def test_root_takes_the_owner_of_a_run_folder_that_only_root_can_have_given_him() -> None:
    with tempfile.TemporaryDirectory(prefix="r2r-", dir="/run") as made:
        folder = Path(made, "line")
        folder.mkdir()
        Path(made).chmod(0o755)
        keep_key(folder, new_key())
        os.chown(folder / KEY_FILE, STRANGER, STRANGER)
        with stranger(folder / LOOP_SOCKET):
            with pytest.raises(ServedByStranger):
                dial(folder / LOOP_SOCKET)
            os.chown(folder, STRANGER, STRANGER)
            dial(folder / LOOP_SOCKET).close()
            assert read_key(folder)  # so a stop is shown, too
            Path(made).chmod(0o1777)  # anybody may have made one there
            with pytest.raises(ServedByStranger):
                dial(folder / LOOP_SOCKET)
            with pytest.raises(NoKey):
                read_key(folder)


@needs_root
def test_agents_join_no_bus_of_a_stranger() -> None:
    async def story(folder: Path) -> None:
        path = folder / BUS_SOCKET
        with stranger(path):
            os.chown(path, STRANGER, STRANGER)
            with pytest.raises(BusUnavailable, match=f"user {STRANGER}"):
                await connect(folder, "site", "line")

    run(story)


# Folders


def test_nobody_listens_below_a_folder_that_others_may_write() -> None:
    with short_folder() as folder:
        (folder / "above").mkdir()
        (folder / "above").chmod(0o777)
        with pytest.raises(CannotListen, match="may be written by others"):
            Listener(folder / "above" / "run" / LOOP_SOCKET)
        (folder / "above").chmod(0o1777)  # as /tmp: nobody takes away what is another's
        Listener(folder / "above" / "run" / LOOP_SOCKET).close()
        with pytest.raises(CannotListen, match="may be written by others"):
            Listener(folder / "above" / LOOP_SOCKET)


@needs_root
@pytest.mark.parametrize("what", ["the run folder", "the one above", "a link to it"])
def test_nobody_listens_in_what_another_user_could_exchange(what: str) -> None:
    with short_folder() as folder:
        folder.chmod(0o755)
        run_folder = folder / "base" / "run"
        run_folder.mkdir(parents=True)
        link = folder / "link"
        link.symlink_to(run_folder)
        Listener(link / LOOP_SOCKET).close()
        place = {"the run folder": run_folder, "the one above": run_folder.parent, "a link to it": link}[what]
        os.chown(place, STRANGER, STRANGER, follow_symlinks=False)
        with pytest.raises(CannotListen, match="may be written by others"):
            Listener((link if place == link else run_folder) / LOOP_SOCKET)
        unsafe = unsafe_place(link if place == link else run_folder, {0})
        assert unsafe is not None and unsafe.parameters["owner_uid"] == STRANGER
        assert unsafe.parameters["place"] == str(place)


@pytest.mark.parametrize("content", [b"", b"anna\n", b"-1\n", b"\xff\n"])
def test_a_list_without_numbers_names_nobody(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, content: bytes) -> None:
    monkeypatch.setattr(who_serves, "NAMED", tmp_path)
    assert named(Path("run/line")) == frozenset()
    (tmp_path / "line").write_bytes(content)
    assert named(Path("run/line")) == frozenset()
