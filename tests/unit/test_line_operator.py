"""The table [operator] of a line's file: where people reach it, and that nobody reads along."""

import pytest

from gateway.core.line_file import LineRefused, check_line, load_line
from gateway.core.line_template import line_template


def text(**changes: str) -> str:
    keys = "".join(f"{key} = {value}\n" for key, value in changes.items())
    before, found, after = line_template(1).partition("\n[operator]")
    assert found
    comment, _, after = after.partition("\n")
    return f"{before}\n[operator]{comment}\n{keys}{after}"


def complaints(**changes: str) -> list[str]:
    try:
        return [str(warning) for warning in check_line(text(**changes), "line.toml").warnings]
    except LineRefused as refused:
        return [str(problem) for problem in refused.problems]


def test_a_line_without_the_table_is_reached_on_this_machine_only() -> None:
    operator = load_line(line_template(1), "line.toml").operator
    assert "//127.0.0.1:" in operator.opc_ua and "//127.0.0.1:" in operator.page and operator.anonymous == "none"


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"opc_ua": '"opc.tcp://192.168.0.5:4841"'},
        {"opc_ua": '"opc.tcp://gateway.plant.example:4840/r2rgate"'},
        {"opc_ua": '"opc.tcp://[::1]:4841"', "page": '"http://[::1]:8480"'},
        {"page": '"http://localhost:9000"'},
        {"page": '"https://0.0.0.0:8443"'},
        {"page": '"https://gateway.plant.example:8443/"', "pki": '"/etc/r2rgate/pki"', "sessions_max": "100"},
        {"nodesets": '"/etc/r2rgate/nodesets"'},
    ],
)
def test_what_is_right_is_taken_without_a_word(changes: dict[str, str]) -> None:
    assert complaints(**changes) == []


@pytest.mark.parametrize(
    ("endpoint", "meant"),
    [
        ("192.168.0.5", 'did you mean "opc.tcp://192.168.0.5:4840"?'),
        ("opc.tcp://192.168.0.5", 'did you mean "opc.tcp://192.168.0.5:4840"?'),
        ("opc.tls://192.168.0.5:4841", 'did you mean "opc.tcp://192.168.0.5:4841"?'),
        ("opc.tcp://anna:secret@192.168.0.5:4841", 'did you mean "opc.tcp://192.168.0.5:4841"?'),
        ("opc.tcp://192.168.0.5:70000", 'or without'),
        ("opc.tcp://192.168.0.5:0", 'or without'),
        ("opc.tcp://a b:4840", 'or without'),
        ("opc.tcp://[::1:4840", 'or without'),
        ("", 'or without'),
    ],
)  # fmt: skip
def test_what_is_no_endpoint_is_refused_with_what_was_meant(endpoint: str, meant: str) -> None:
    (complaint,) = complaints(opc_ua=f'"{endpoint}"')
    assert "operator.opc_ua" in complaint and 'is no endpoint; allowed: "opc.tcp://HOST:PORT"' in complaint
    assert complaint.endswith(meant)


@pytest.mark.parametrize(
    ("page", "meant"),
    [
        ("127.0.0.1:8480", 'did you mean "https://127.0.0.1:8480"?'),
        ("http://127.0.0.1", 'did you mean "http://127.0.0.1:8480"?'),
        ("https://gateway/page", 'did you mean "https://gateway:8480"?'),
        ("http://127.0.0.1:8480/?a=1", 'did you mean "http://127.0.0.1:8480"?'),
        ("ftp://127.0.0.1:8480", 'did you mean "https://127.0.0.1:8480"?'),
        ("", '"https://HOST:PORT"'),
    ],
)
def test_what_is_no_address_of_a_page_is_refused_with_what_was_meant(page: str, meant: str) -> None:
    (complaint,) = complaints(page=f'"{page}"')
    assert "operator.page" in complaint and "is no address" in complaint and complaint.endswith(meant)


@pytest.mark.parametrize("host", ["192.168.0.5", "0.0.0.0", "[::]", "gateway.plant.example", "127.0.0.1.example"])
def test_beyond_this_machine_the_page_is_encrypted(host: str) -> None:
    (complaint,) = complaints(page=f'"http://{host}:8480"')
    assert "passwords could be read" in complaint and complaint.endswith(f'did you mean "https://{host}:8480"?')


def test_two_servers_do_not_share_a_port() -> None:
    (complaint,) = complaints(page='"http://127.0.0.1:4840"')
    assert "has the port of opc_ua, 4840" in complaint and complaint.endswith('did you mean "http://127.0.0.1:8480"?')
    (other,) = complaints(opc_ua='"opc.tcp://[::1]:8480"', page='"http://[::1]:8480"')
    assert other.endswith('did you mean "http://[::1]:8481"?')


@pytest.mark.parametrize("key", ["pki", "nodesets"])
def test_folders_are_named_from_the_root(key: str) -> None:
    (complaint,) = complaints(**{key: '"here"'})
    assert f"operator.{key}" in complaint and "is no absolute path" in complaint
    assert complaint.endswith(f'as "/etc/r2rgate/{key}"')


def test_every_mistake_is_told_at_once_and_a_mistyped_key_with_the_nearest() -> None:
    assert len(complaints(opc_ua='"x"', page='"y z"', pki='"z"')) == 3
    assert any("did you mean anonymous?" in one for one in complaints(anonymus='"read"'))
    assert any("operator.sessions_max" in one for one in complaints(sessions_max="101"))
