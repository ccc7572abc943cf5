"""OPC UA servers in a line's file: where they are, and never less security than the file seems to say."""

import pytest

from gateway.core.line_file import LineRefused, check_line
from gateway.core.line_template import line_template

MAPS = {
    "cia402-torque": ("canopen", "drive", ""),
    "loadcell-amp": ("modbus-tcp", "load-cell", ""),
    "r2r-opcua-plc": ("opcua", "line-plc", "r2r-opcua"),
}
FILES = 'certificate = "/pki/a.der"\nprivate_key = "/pki/a.pem"\nserver_certificate = "/pki/s.der"\n'


def document(server: str) -> str:
    """The demonstration line with its PLC behind a server."""
    text = line_template(1)
    head, plc = text.split("[plc]")
    plc = plc.replace('bus = "io"', 'bus = "server"').replace('map = "line-plc"', 'map = "r2r-opcua-plc"')
    bus = f'[[buses]]\nname = "server"\nprotocol = "opcua"\n{server}\n'
    return head.replace("# Drives:", f"{bus}\n# Drives:", 1) + "[plc]" + plc


def complaints(server: str) -> list[str]:
    try:
        return [str(warning) for warning in check_line(document(server), "line.toml", MAPS).warnings]
    except LineRefused as refused:
        return [str(problem) for problem in refused.problems]


@pytest.mark.parametrize(
    "server",
    [
        'endpoint = "opc.tcp://127.0.0.1:4840"',
        'endpoint = "opc.tcp://localhost:4840/plc/1"',
        'endpoint = "opc.tcp://[::1]:4840"',
        'endpoint = "opc.tcp://127.0.0.1:4840"\nsecurity = "none"',
        f'endpoint = "opc.tcp://plc.example:4840"\nsecurity = "Basic256Sha256"\n{FILES}',
    ],
)
def test_what_is_right_is_taken_without_a_word(server: str) -> None:
    assert complaints(server) == []


@pytest.mark.parametrize(
    ("endpoint", "nearest"),
    [
        ("192.168.0.10", 'did you mean "opc.tcp://192.168.0.10:4840"?'),
        ("opc.tcp://127.0.0.1", 'did you mean "opc.tcp://127.0.0.1:4840"?'),
        ("http://127.0.0.1:4840", 'did you mean "opc.tcp://127.0.0.1:4840"?'),
        ("opc.tcp://operator:secret@127.0.0.1:4840", 'did you mean "opc.tcp://127.0.0.1:4840"?'),
        ("opc.tcp://127.0.0.1:99999", ""),
        ("opc.tcp://:4840", ""),
        ("opc.tcp://a b:4840", ""),
        ("opc.tcp://127.0.0.1:4840?x=1", ""),
        ("", ""),
    ],
)
def test_what_is_no_endpoint_is_refused(endpoint: str, nearest: str) -> None:
    (said,) = complaints(f'endpoint = "{endpoint}"')
    assert "buses[3].endpoint" in said and "is no endpoint; allowed: " in said
    assert nearest in said


def test_another_machine_without_security_is_odd() -> None:
    (said,) = complaints('endpoint = "opc.tcp://192.168.0.10:4840"')
    assert "anybody on that network can command its devices" in said


def test_security_needs_all_three_files() -> None:
    said = complaints('endpoint = "opc.tcp://127.0.0.1:4840"\nsecurity = "Basic256Sha256"\ncertificate = "/a.der"')
    assert [key for key in ("private_key", "server_certificate") if any(f"{key}: is missing" in s for s in said)] == [
        "private_key",
        "server_certificate",
    ]
    assert len(said) == 2


def test_files_without_security_are_refused() -> None:
    """Somebody meant it to be secured."""
    said = complaints(f'endpoint = "opc.tcp://127.0.0.1:4840"\n{FILES}')
    assert len(said) == 3 and all('security is "none"' in problem for problem in said)


@pytest.mark.parametrize(("file", "wrong"), [("pki/a.der", "is no absolute path"), ("/pki/a.txt", "is no certificate")])
def test_a_file_that_cannot_be_one_is_refused(file: str, wrong: str) -> None:
    files = FILES.replace("/pki/a.der", file)
    (said,) = complaints(f'endpoint = "opc.tcp://127.0.0.1:4840"\nsecurity = "Basic256Sha256"\n{files}')
    assert "buses[3].certificate" in said and wrong in said


def test_an_unknown_security_is_refused_with_the_nearest() -> None:
    (said,) = complaints('endpoint = "opc.tcp://127.0.0.1:4840"\nsecurity = "Basic256"')
    assert 'allowed: "none", "Basic256Sha256"; did you mean "Basic256Sha256"?' in said


def test_an_unknown_key_is_refused_with_the_nearest() -> None:
    said = complaints('endpoint = "opc.tcp://127.0.0.1:4840"\nservercertificate = "/a.der"')
    assert "did you mean server_certificate?" in said[0]


def test_two_tables_for_one_server_are_refused() -> None:
    server = 'endpoint = "opc.tcp://127.0.0.1:4840/{}"'
    again = '\n\n[[buses]]\nname = "again"\nprotocol = "opcua"\n'
    said = complaints(f"{server.format('a')}{again}{server.format('b')}")
    assert any("buses[4].endpoint" in problem and "is the same wire as buses[3]" in problem for problem in said)
