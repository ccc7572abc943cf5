"""The OPC UA client in a process of its own: it may die, hang or be attacked, and the link only misses."""

import asyncio
import os
import re
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Awaitable, Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import NameOID

from drivers.opcua import link as links
from drivers.opcua.messages import Plan
from drivers.opcua.process import ProcessChannel, processors_without
from drivers.opcua.worker import ADDRESS_SPACE_BYTES
from gateway.core.signals import DriveState, Quality
from tests.protocol.driver_opcua_support import DeviceServer, Rig, device_server, line, link_with_worker
from tests.protocol.driver_support import until
from tests.support.patience import PATIENCE_S

pytestmark = pytest.mark.wires

NULL_BOMB = bytes.fromhex("80 ffffff7f")  #: a Variant: an array of 2^31 - 1 Nulls, in five bytes


def certificate(folder: Path, name: str) -> tuple[Path, Path]:
    """A self-signed certificate and its key."""
    key = rsa.generate_private_key(public_exponent=65537, key_size=2048)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.now(UTC)
    names = x509.SubjectAlternativeName([x509.UniformResourceIdentifier(f"urn:test:{name}"), x509.DNSName("localhost")])
    signed = (
        x509.CertificateBuilder(subject, subject, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(names, critical=False)
        .sign(key, hashes.SHA256())
    )
    der = serialization.Encoding.DER
    files = folder / f"{name}.der", folder / f"{name}-key.der"
    files[0].write_bytes(signed.public_bytes(der))
    plain = serialization.NoEncryption()
    files[1].write_bytes(key.private_bytes(der, serialization.PrivateFormat.PKCS8, plain))
    return files


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Path]]:
    folder = tmp_path_factory.mktemp("pki")
    return {name: certificate(folder, name) for name in ("gateway", "server", "stranger")}


@pytest.fixture(scope="module")
def shared_server(pki: dict[str, tuple[Path, Path]]) -> Iterator[DeviceServer]:
    with device_server(pki["server"]) as server:
        yield server


@pytest.fixture
def server(shared_server: DeviceServer) -> Iterator[DeviceServer]:
    shared_server.reset()
    yield shared_server
    shared_server.reset()


def run(rig: Rig, scene: Callable[[Rig], Awaitable[None]]) -> None:
    async def play() -> None:
        try:
            await rig.link.open()
            await scene(rig)
        finally:
            await rig.link.close()

    asyncio.run(play())


def channel_of(rig: Rig) -> ProcessChannel:
    channel = rig.link._channel  # noqa: SLF001 (who the worker is, is nobody else's business)
    assert isinstance(channel, ProcessChannel)
    return channel


def worker_of(rig: Rig) -> int:
    spawner = channel_of(rig).pid
    assert spawner is not None
    (pid,) = children(spawner)
    return pid


def children(pid: int) -> list[int]:
    """Processes that it has started and that have not ended."""
    found: list[int] = []
    for path in Path("/proc").glob("[0-9]*"):
        if of_process(int(path.name), "status", r"PPid:\s+(\d+)") == pid and is_running(int(path.name)):
            found.append(int(path.name))
    return found


def of_process(pid: int, file: str, pattern: str) -> int:
    """A number in a file of /proc, 0 when the process is gone."""
    try:
        found = re.search(pattern, Path(f"/proc/{pid}/{file}").read_text(encoding="ascii"))
    except (FileNotFoundError, ProcessLookupError):
        return 0
    return int(found[1]) if found else 0


def address_space_bytes(pid: int) -> int:
    return 1024 * of_process(pid, "status", r"VmPeak:\s+(\d+) kB")


def is_running(pid: int) -> bool:
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    except FileNotFoundError:
        return False


def test_a_round_trip_and_an_ordered_end(server: DeviceServer) -> None:
    rig = Rig(link_with_worker(line(server.endpoint)))
    pids: list[int] = []

    async def scene(rig: Rig) -> None:
        pids.append(worker_of(rig))
        await rig.enable(torque_nm=5.0)
        await rig.until(lambda: server.devices.value("Axis2.TargetTorque") == 5.0)
        assert list(rig.inputs.tension.value) == [10.0, 20.0]
        cells = dict.fromkeys(("cell-1", "cell-2"), "AMP-7")
        assert rig.link.serials == {"drive-1": "AX-1", "drive-2": "AX-2", "plc": str(2**63 + 1), **cells}
        assert of_process(pids[0], "limits", r"Max address space +\d+ +(\d+)") == ADDRESS_SPACE_BYTES
        assert os.sched_getaffinity(pids[0]) == set(processors_without(None))

    run(rig, scene)
    assert not is_running(pids[0])


def test_on_one_processor_the_real_time_class_is_the_loops_alone(server: DeviceServer) -> None:
    async def scene(rig: Rig) -> None:
        await rig.until(rig.inputs.tension.good)
        assert os.sched_getscheduler(worker_of(rig)) == os.SCHED_OTHER

    granted = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(granted)})
    try:
        run(Rig(link_with_worker(line(server.endpoint))), scene)
    finally:
        os.sched_setaffinity(0, granted)


def test_a_worker_that_is_killed_is_replaced_and_nothing_is_written_meanwhile(server: DeviceServer) -> None:
    devices = server.devices
    rig, other = (Rig(link_with_worker(line(server.endpoint))) for _ in range(2))

    async def scene(rig: Rig) -> None:
        await other.link.open()
        try:
            await other.until(other.inputs.tension.good)
            await rig.enable()
            before = worker_of(rig)
            os.kill(before, signal.SIGKILL)
            await rig.until(lambda: len(rig.link.health.absent) == 4)
            assert list(rig.inputs.drive_state) == [DriveState.ABSENT] * 2
            devices.writes.clear()
            devices.set("Line.Watchdog", 0)
            await other.cycle()
            assert other.inputs.tension.good()
            await rig.until(rig.inputs.tension.good)
            for _ in range(5):
                await rig.cycle()
            # The line's watchdog is not the one that was set: it is told to stop. The drives were lost: nothing.
            assert devices.writes == [{"Line.Run": False, "Line.SpeedRequest": 0.0}]
            assert rig.inputs.plc.quality == Quality.STALE
            assert worker_of(rig) != before and not is_running(before)
            devices.set("Line.Watchdog", 100)
            await rig.until(lambda: devices.written("Line.Life") != [])
            assert other.link.health.reconnects == 0
        finally:
            await other.link.close()

    run(rig, scene)


def test_a_worker_that_hangs_is_ended_and_its_question_is_not_written(server: DeviceServer) -> None:
    devices = server.devices
    rig = Rig(link_with_worker(line(server.endpoint)))

    async def scene(rig: Rig) -> None:
        await rig.enable()
        before = worker_of(rig)
        os.kill(before, signal.SIGSTOP)
        await rig.cycle(0.05)
        devices.writes.clear()
        await rig.until(lambda: not channel_of(rig).up.is_set())
        await rig.until(rig.inputs.tension.good)
        assert worker_of(rig) != before and not is_running(before)
        assert devices.written("Axis1.Life") == []

    run(rig, scene)


def test_a_worker_dies_with_its_parent(server: DeviceServer) -> None:
    program = (
        "import asyncio, os, sys\n"
        "from drivers.opcua.messages import Plan\n"
        "from drivers.opcua.process import ProcessChannel\n"
        "async def main():\n"
        f"    channel = ProcessChannel(Plan({server.endpoint!r}, 'none', '', '', '', []), None, 60)\n"
        "    channel.start(lambda answer: None, lambda why: None)\n"
        "    await channel.up.wait()\n"
        "    assert 'asyncua' not in sys.modules\n"
        "    print(channel.pid, flush=True)\n"
        "    await asyncio.sleep(60)\n"
        "asyncio.run(main())\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        spawner = int(parent.stdout.readline())
        (pid,) = children(spawner)
        handle = os.pidfd_open(pid)
        parent.kill()
        try:
            signalled = asyncio.run(_readable(handle))
        finally:
            os.close(handle)
    assert signalled


def test_a_worker_whose_loop_closed_with_an_answer_unread_ends_in_silence() -> None:
    """The kernel says "connection reset" then, and not that the other side has ended."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    arguments = [str(number) for number in (theirs.fileno(), os.getpid(), 1, 1)]
    program = [sys.executable, "-m", "drivers.opcua.worker", *arguments]
    with ours, subprocess.Popen(program, pass_fds=[theirs.fileno()], stderr=subprocess.PIPE) as worker:
        theirs.close()
        ours.send(Plan("opc.tcp://127.0.0.1:1", "none", "", "", "", []).to_json())
        assert select.select([ours], [], [], PATIENCE_S)[0], "it says that it is ready"
        ours.close()
        _, said = worker.communicate(timeout=PATIENCE_S)
    assert (worker.returncode, said) == (0, b"")


async def _readable(handle: int) -> bool:
    ended = asyncio.Event()
    asyncio.get_running_loop().add_reader(handle, ended.set)
    async with asyncio.timeout(PATIENCE_S):
        await ended.wait()
    asyncio.get_running_loop().remove_reader(handle)
    return True


# hostile servers


def chunk(kind: bytes, body: bytes, declared: int | None = None) -> bytes:
    return kind + (8 + len(body) if declared is None else declared).to_bytes(4, "little") + body


ACKNOWLEDGE = chunk(b"ACKF", b"".join(n.to_bytes(4, "little") for n in (0, 65535, 65535, 0, 0)))
POLICY = b"http://opcfoundation.org/UA/SecurityPolicy#None"


def open_answer(additional_header: bytes) -> bytes:
    """An OpenSecureChannelResponse whose header carries what the server likes."""
    security = len(POLICY).to_bytes(4, "little") + POLICY + b"\xff" * 8
    sequence = (1).to_bytes(4, "little") + (1).to_bytes(4, "little")
    header = bytes(16) + b"\x00" + b"\xff" * 4 + additional_header
    return chunk(b"OPNF", bytes(4) + security + sequence + b"\x01\x00\xc1\x01" + header)


def extension(type_id: int, body: bytes) -> bytes:
    return b"\x01\x00" + type_id.to_bytes(2, "little") + b"\x01" + len(body).to_bytes(4, "little") + body


LITERAL_OPERAND = 597
HOSTILE = {
    "nothing": [],
    "noise": [bytes(range(256)) * 4],
    "a header of 4 GB": [chunk(b"ACKF", b"", declared=0xFFFFFFF0), bytes(1 << 20)],
    "an error": [chunk(b"ERRF", (0x80010000).to_bytes(4, "little") + b"\xff" * 4)],
    "cut short": [ACKNOWLEDGE, open_answer(b"")[:-9]],
    "an array of two thousand million Nulls": [ACKNOWLEDGE, open_answer(extension(LITERAL_OPERAND, NULL_BOMB))],
}


@pytest.mark.parametrize("answers", HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_server_only_makes_the_link_miss(answers: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(links, "CONNECT_PATIENCE_S", 0.3)

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            for answer in answers:
                await reader.read(4096)
                writer.write(answer)
                await writer.drain()
            await reader.read()
        except ConnectionError:
            pass
        finally:
            writer.close()

    async def scene() -> None:
        listener = await asyncio.start_server(serve, "127.0.0.1", 0)
        rig = Rig(link_with_worker(line(f"opc.tcp://127.0.0.1:{listener.sockets[0].getsockname()[1]}")))
        opening = asyncio.create_task(rig.link.open())
        most = 0
        try:
            await until(lambda: channel_of(rig).pid is not None and children(channel_of(rig).pid or 0) != [])
            first = worker_of(rig)
            while not opening.done():
                most = max(most, address_space_bytes(first))
                await asyncio.sleep(0.01)
            with pytest.raises(OSError, match="no connection to opc.tcp://"):
                await opening
            for _ in range(10):
                await rig.cycle()
                most = max(most, address_space_bytes(first))
            assert 0 < most <= ADDRESS_SPACE_BYTES
            assert list(rig.inputs.tension.quality) == [Quality.MISSING] * 2
            assert len(rig.link.health.absent) == 4
        finally:
            await rig.link.close()
            listener.close()
            await listener.wait_closed()

    asyncio.run(scene())


# security


def secured(server: DeviceServer, pki: dict[str, tuple[Path, Path]], expected: str) -> Rig:
    ours, key = pki["gateway"]
    files = {"certificate": str(ours), "private_key": str(key), "server_certificate": str(pki[expected][0])}
    return Rig(link_with_worker(line(server.endpoint, security="Basic256Sha256", files=files)))


def test_a_secured_round_trip(server: DeviceServer, pki: dict[str, tuple[Path, Path]]) -> None:
    async def scene(rig: Rig) -> None:
        await rig.enable(torque_nm=5.0)
        await rig.until(lambda: server.devices.value("Axis1.TargetTorque") == 5.0)

    run(secured(server, pki, "server"), scene)


def test_no_other_server_than_the_one_that_is_known(
    server: DeviceServer, pki: dict[str, tuple[Path, Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(links, "CONNECT_PATIENCE_S", 1.0)
    rig = secured(server, pki, "stranger")

    async def scene() -> None:
        with pytest.raises(OSError, match="no connection"):
            await rig.link.open()
        await rig.cycle()
        await rig.link.close()

    asyncio.run(scene())
    assert server.devices.reads == 0 and server.devices.writes == []


def test_a_server_that_offers_less_is_told_nothing(
    pki: dict[str, tuple[Path, Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It hears a greeting and a request in the policy of the line's file, never one without."""
    monkeypatch.setattr(links, "CONNECT_PATIENCE_S", 0.5)
    heard: list[bytes] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            for answer in (ACKNOWLEDGE, open_answer(b"\x00\x00\x00")):
                heard.append(await reader.read(65536))
                writer.write(answer)
            heard.append(await reader.read(65536))
        except ConnectionError:
            pass
        finally:
            writer.close()

    async def scene() -> None:
        listener = await asyncio.start_server(serve, "127.0.0.1", 0)
        ours, key = pki["gateway"]
        endpoint = f"opc.tcp://127.0.0.1:{listener.sockets[0].getsockname()[1]}"
        files = {"certificate": str(ours), "private_key": str(key), "server_certificate": str(pki["server"][0])}
        rig = Rig(link_with_worker(line(endpoint, security="Basic256Sha256", files=files)))
        try:
            with pytest.raises(OSError, match="no connection"):
                await rig.link.open()
        finally:
            await rig.link.close()
            listener.close()
            await listener.wait_closed()

    asyncio.run(scene())
    assert any(b"SecurityPolicy#Basic256Sha256" in message for message in heard)
    assert not any(b"SecurityPolicy#None" in message for message in heard)
    assert not any(message.startswith(b"MSG") for message in heard)


def test_a_plan_that_fits_no_message_is_no_crash() -> None:
    async def scene() -> None:
        plan = Plan("opc.tcp://127.0.0.1:1", "none", "x" * (1 << 20), "", "", [])
        channel = ProcessChannel(plan, None, 60)
        with pytest.raises(OSError, match="cannot be started"):
            channel.start(lambda answer: None, lambda why: None)
        await channel.close()
        assert channel.pid is None

    asyncio.run(scene())


def test_a_worker_that_hangs_is_ended_before_there_is_another_and_the_spawner_starts_it(server: DeviceServer) -> None:
    """The loop starts no process: that would hold it up until the new one runs."""
    rig = Rig(link_with_worker(line(server.endpoint)))

    async def scene(rig: Rig) -> None:
        spawner, hung = channel_of(rig).pid, worker_of(rig)
        assert children(os.getpid()).count(hung) == 0
        os.kill(hung, signal.SIGSTOP)
        channel_of(rig).give_up("for the test")
        await rig.until(channel_of(rig).up.is_set)
        assert not is_running(hung)
        assert channel_of(rig).pid == spawner and worker_of(rig) != hung

    run(rig, scene)


def test_a_spawner_that_dies_takes_the_worker_along_and_is_said(server: DeviceServer) -> None:
    rig = Rig(link_with_worker(line(server.endpoint)))

    async def scene(rig: Rig) -> None:
        worker, spawner = worker_of(rig), channel_of(rig).pid
        assert spawner is not None
        os.kill(spawner, signal.SIGKILL)
        await rig.until(lambda: "the OPC UA process cannot be started" in rig.link.health.last_error)
        assert not is_running(worker)
        await rig.until(lambda: len(rig.link.health.absent) == 4)

    run(rig, scene)
