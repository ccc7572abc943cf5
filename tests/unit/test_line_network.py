"""The table [network] of a line's file: where agents of other machines come in, with which files, and who."""

import pytest

from gateway.core.line import Network
from gateway.core.line_file import LineRefused, check_line, load_line
from gateway.core.line_template import line_template

RIGHT = {
    "listen": '"tls/192.168.0.5:7447"',
    "certificate": '"/pki/gateway.pem"',
    "private_key": '"/pki/gateway.key.pem"',
    "authority": '"/pki/authority.pem"',
    "names": '["agents"]',
}


def text(**changes: str) -> str:
    keys = {key: value for key, value in {**RIGHT, **changes}.items() if value}
    return line_template(1) + "\n[network]\n" + "".join(f"{key} = {value}\n" for key, value in keys.items())


def complaints(**changes: str) -> list[str]:
    try:
        return [str(warning) for warning in check_line(text(**changes), "line.toml").warnings]
    except LineRefused as refused:
        return [str(problem) for problem in refused.problems]


def test_a_line_without_the_table_listens_to_nobody_and_the_template_shows_how() -> None:
    plain = line_template(1)
    assert load_line(plain, "line.toml").network is None
    head, table = plain.split("# [network]", 1)
    shown = "\n".join(line.removeprefix("# ") for line in ("[network]" + table).split("# Recipes", 1)[0].splitlines())
    line = load_line(head + shown + "\n# Recipes" + table.split("# Recipes", 1)[1], "line.toml")
    assert line.network is not None and line.network.names == ["agents"]


@pytest.mark.parametrize(
    "changes",
    [{}, {"listen": '"tls/[::1]:7447"'}, {"listen": '"tls/gateway.plant.example:1"'}, {"names": '["agents", "night"]'}],
)
def test_what_is_right_is_taken_without_a_word(changes: dict[str, str]) -> None:
    assert complaints(**changes) == []
    assert isinstance(load_line(text(**changes), "line.toml").network, Network)


@pytest.mark.parametrize(
    ("listen", "meant"),
    [
        ("tcp/192.168.0.5:7447", 'did you mean "tls/192.168.0.5:7447"?'),
        ("192.168.0.5", 'did you mean "tls/192.168.0.5:7447"?'),
        ("tls://192.168.0.5:7447", 'did you mean "tls/192.168.0.5:7447"?'),
        ("tls/192.168.0.5", 'did you mean "tls/192.168.0.5:7447"?'),
        ("tls/192.168.0.5:7447?prio=1", ""),
        ("tls/192.168.0.5:7447#iface=eth0", ""),
        ("tls/192.168.0.5:70000", ""),
        ("tls/user@192.168.0.5:7447", ""),
        ("tls/a b:7447", ""),
        ("", ""),
    ],
)
def test_an_address_without_tls_or_with_zenohs_own_options_is_refused(listen: str, meant: str) -> None:
    (complaint,) = complaints(listen=f'"{listen}"')
    assert "network.listen" in complaint and 'allowed: "tls/HOST:PORT"' in complaint
    assert complaint.endswith(meant)


@pytest.mark.parametrize("key", ["certificate", "private_key", "authority"])
def test_each_file_is_named_from_the_root_and_ends_as_it_should(key: str) -> None:
    (relative,) = complaints(**{key: '"pki/a.pem"'})
    assert f"network.{key}" in relative and "is no absolute path" in relative
    (other,) = complaints(**{key: '"/pki/a.der"'})
    assert f"network.{key}" in other and "ends in .pem" in other
    (missing,) = complaints(**{key: ""})
    assert f"network.{key}: is missing" in missing


def test_a_key_that_lies_in_the_file_of_a_certificate_is_refused() -> None:
    (complaint,) = complaints(private_key=RIGHT["certificate"])
    assert "network.private_key" in complaint and "a file of its own" in complaint


def test_names_are_there_and_each_once() -> None:
    (none,) = complaints(names="[]")
    assert "is empty; allowed: a list [ ... ] of 1 to 32 texts in quotes" in none
    (twice,) = complaints(names='["a", "b", "a"]')
    assert "network.names[3]" in twice and "stands twice" in twice
    (upper,) = complaints(names='["Agents"]')
    assert 'did you mean "agents"?' in upper


def test_a_mistyped_key_is_told_with_the_nearest() -> None:
    found = complaints(certifcate='"/pki/a.pem"')
    assert any("network.certifcate" in one and "did you mean certificate?" in one for one in found)
