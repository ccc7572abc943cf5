"""`r2rgate operator`, `pki init`, `pki trust` and `doctor`, as somebody who sets up a line meets them."""

import asyncio
import os
import signal
import socket
import subprocess
import sys
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyAes256Sha256RsaPss
from cryptography import x509
from typer.testing import CliRunner

from gateway.cli.doctor_certificates import opcua_certificates
from gateway.cli.main import app
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.mailbox.paths import OPERATOR_DATA
from gateway.mailbox.unix import UnixMailbox
from gateway.operator.opcua.trust import MOST_BYTES, TRUSTED, fingerprint
from gateway.operator.users import FILE_NAME, Users
from tests.operator.names import PASSWORD
from tests.protocol.operator_support import NUMBER, FakeGateway, der, pair
from tests.support.ports import free_port
from tests.unit.supervisor_support import short_folder

pytestmark = pytest.mark.wires


def set_up(folder: Path, *words: str) -> Path:
    """A line's file, and certificates of server and client."""
    text = line_template(1)
    for key, address in (("opc_ua", "opc.tcp://127.0.0.1:4840"), ("page", "http://127.0.0.1:8480")):
        free = f"{address.rpartition(':')[0]}:{free_port()}"
        text = text.replace(f'# {key} = "{address}"', f'{key} = "{free}"')
    (folder / "line.toml").write_text(text, encoding="utf-8")
    done = command(folder, "init", "--client", "panel", *words)
    assert done.exit_code == 0, done.output
    return folder / "data" / OPERATOR_DATA / "pki"


def command(folder: Path, name: str, *words: str):
    where = ["--line", str(folder / "line.toml"), "--data-dir", str(folder / "data")]
    return CliRunner().invoke(app, ["pki", name, *words, *where])


@contextmanager
def operator(folder: Path):
    arguments = ["operator", "line.toml", "--run-dir", str(folder), "--data-dir", str(folder / "data")]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    with subprocess.Popen(
        [sys.executable, "-m", "gateway.cli", *arguments], cwd=folder, env=environment, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            yield process
        finally:
            process.kill()


def test_a_panel_with_its_own_certificate_and_a_user_of_the_file_reach_the_line():
    async def story(folder: Path):
        pki = set_up(folder)
        Users.nobody().with_user("otto", PASSWORD, "operator").write(folder / "data" / OPERATOR_DATA / FILE_NAME)
        line = load_line((folder / "line.toml").read_text(encoding="utf-8"), "line.toml")
        mailbox = UnixMailbox()
        gateway = FakeGateway(line, mailbox)
        await mailbox.listen(folder / "gateway.sock")
        with operator(folder) as process:
            said = await asyncio.to_thread(process.stdout.readline)
            served = f"page at {line.operator.page}, OPC UA at {line.operator.opc_ua}\n"
            assert said.endswith(served), said
            assert ":4840" not in said and ":8480" not in said
            assert (await asyncio.to_thread(httpx.get, line.operator.page)).status_code == 200
            client = Client(line.operator.opc_ua)
            client.application_uri = f"urn:r2rgate:{line.site}:{line.line}:panel"
            await client.set_security(
                SecurityPolicyAes256Sha256RsaPss, pki / "opcua-client-panel.pem", pki / "opcua-client-panel.key.pem",
                server_certificate=pki / "opcua-server.pem",
            )  # fmt: skip
            client.set_user("otto")
            client.set_password(PASSWORD)
            async with client:
                request = ua.CallMethodRequest(ua.NodeId("Line", NUMBER), ua.NodeId("Line.Stop", NUMBER), [])
                (result,) = await client.uaclient.call([request])
                assert [one.Value for one in result.OutputArguments] == [True, "done"]
            assert [(one.person.name, one.said.command) for one in gateway.heard] == [("otto", "stop")]
            process.send_signal(signal.SIGTERM)
            assert await asyncio.to_thread(process.wait) == 0
            assert process.stderr.read() == ""
        await mailbox.close()

    with short_folder() as folder:
        asyncio.run(story(folder))


def test_without_a_certificate_yet_there_is_the_page_and_what_to_do_is_said():
    with short_folder() as folder:
        (set_up(folder) / "opcua-server.pem").unlink()
        page = load_line((folder / "line.toml").read_text(encoding="utf-8"), "line.toml").operator.page
        with operator(folder) as process:
            assert process.stdout.readline().endswith(f": page at {page}\n")
            assert httpx.get(page).status_code == 200
            process.send_signal(signal.SIGTERM)
            assert process.wait() == 0
            told = process.stderr.read()
            assert "no OPC UA at" in told and "r2rgate pki init" in told and "r2rgate users add" in told


def test_that_nobody_can_come_in_is_told_until_there_is_a_user():
    with short_folder() as folder:
        set_up(folder)
        file = folder / "data" / OPERATOR_DATA / FILE_NAME
        Users.nobody().write(file)  # the last one was removed
        with operator(folder) as process:
            assert process.stderr.readline().startswith("nobody can come in yet: ")
            Users.nobody().with_user("otto", PASSWORD, "operator").write(file)
            assert process.stderr.readline() == "somebody can come in now\n"


def test_where_both_ports_are_in_use_it_ends_with_code_2_and_says_which():
    with short_folder() as folder:
        set_up(folder)
        with operator(folder) as first:
            assert first.stdout.readline()
            with operator(folder) as second:
                assert second.wait() == 2
                told = second.stderr.read()
                assert "the page cannot be at http://127.0.0.1" in told and "Traceback" not in told
                assert "the OPC UA server cannot listen on 127.0.0.1" in told


def test_an_https_page_without_its_certificate_is_not_told_as_served():
    with short_folder() as folder:
        pki = set_up(folder)
        file = folder / "line.toml"
        file.write_text(file.read_text(encoding="utf-8").replace('page = "http:', 'page = "https:'), encoding="utf-8")
        places = load_line(file.read_text(encoding="utf-8"), "line.toml").operator
        assert places.page.startswith("https:")
        (pki / "opcua-server.pem").unlink()
        with operator(folder) as process:  # neither way in can be opened
            assert process.wait() == 2
            told = process.stderr.read()
            assert "no page at https:" in told and "opcua-server.pem" in told and "now" not in told


@pytest.mark.parametrize("taken", ["page", "opc_ua"])
def test_of_two_ways_in_one_goes_on_where_the_others_port_is_in_use(taken):
    with short_folder() as folder, socket.socket() as holder:
        set_up(folder)
        places = load_line((folder / "line.toml").read_text(encoding="utf-8"), "line.toml").operator
        holder.bind(("127.0.0.1", urlsplit(getattr(places, taken)).port))
        holder.listen()
        with operator(folder) as process:
            said = process.stdout.readline()
            assert (f"page at {places.page}" in said, f"OPC UA at {places.opc_ua}" in said) == (
                taken != "page", taken != "opc_ua",
            )  # fmt: skip
            with (
                socket.create_connection(("127.0.0.1", urlsplit(places.page).port)),
                socket.create_connection(("127.0.0.1", urlsplit(places.opc_ua).port)),
            ):
                pass
            process.send_signal(signal.SIGTERM)
            assert process.wait() == 0
            told = process.stderr.read()
            assert "Traceback" not in told and "it is tried again every 10 s" in told
            assert f":{urlsplit(getattr(places, taken)).port}" in told


def test_the_servers_certificate_names_its_application_and_where_it_is_reached(tmp_path):
    pki = set_up(tmp_path, "--host", "line-7.plant.example", "--host", "192.168.7.5")
    found = x509.load_pem_x509_certificate((pki / "opcua-server.pem").read_bytes())
    names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    line = load_line((tmp_path / "line.toml").read_text(encoding="utf-8"), "line.toml")
    assert names.get_values_for_type(x509.UniformResourceIdentifier) == [f"urn:r2rgate:{line.site}:{line.line}"]
    assert {"line-7.plant.example", "localhost"} <= set(names.get_values_for_type(x509.DNSName))
    assert "192.168.7.5" in map(str, names.get_values_for_type(x509.IPAddress))
    assert found.public_key().key_size >= 2048
    assert (pki / "opcua-server.key.pem").stat().st_mode & 0o077 == 0
    before = (pki / "opcua-server.pem").read_bytes()
    again = command(tmp_path, "init", "--client", "tablet")  # adds one, and leaves the others
    assert again.exit_code == 0 and "opcua-client-tablet.pem" in again.stdout
    assert (pki / "opcua-server.pem").read_bytes() == before
    assert len(list((pki / TRUSTED).iterdir())) == 2
    assert command(tmp_path, "init", "--client", "tablet").exit_code == 2  # nothing was missing
    assert command(tmp_path, "init", "--client", "../out").exit_code == 2


def test_a_certificate_is_trusted_by_its_file_and_what_is_none_is_not(tmp_path):
    pki = set_up(tmp_path)
    before = set((pki / TRUSTED).iterdir())
    (tmp_path / "panel.der").write_bytes(der(pair("stranger")))
    done = command(tmp_path, "trust", str(tmp_path / "panel.der"))
    assert done.exit_code == 0 and "urn:test:stranger" in done.stdout
    assert fingerprint(der(pair("stranger"))) in done.stdout
    (new,) = set((pki / TRUSTED).iterdir()) - before
    assert new.read_bytes() == der(pair("stranger"))
    for content in (b"", b"nonsense", der(pair("stranger"))[:-9], b"0\x82\xff\xff" + bytes(2 * MOST_BYTES)):
        (tmp_path / "bad.der").write_bytes(content)
        done = command(tmp_path, "trust", str(tmp_path / "bad.der"))
        assert done.exit_code == 2 and "is not trusted" in done.stderr
    done = command(tmp_path, "trust", str(tmp_path / "pki" / "authority.pem"))  # a key of another kind
    assert done.exit_code == 2 and "RSA" in done.stderr
    assert set((pki / TRUSTED).iterdir()) == before | {new}


def test_doctor_warns_before_a_certificate_of_opc_ua_ends(tmp_path):
    pki = set_up(tmp_path)
    fine = list(opcua_certificates(pki, datetime.now(UTC)))
    assert [one.verdict for one in fine] == ["OK"] * 3
    late = {one.subject: one for one in opcua_certificates(pki, datetime.now(UTC) + timedelta(days=720))}
    assert "ends in" in late["OPC UA server"].measured and "pki init" in late["OPC UA server"].todo
    assert late["OPC UA client"].verdict == "warning" and "pki trust" in late["OPC UA client"].todo
    (none,) = opcua_certificates(tmp_path / "nowhere", datetime.now(UTC))
    assert none.verdict == "warning" and "pki init" in none.todo
