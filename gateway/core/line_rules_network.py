"""Rules about the table [network]: an address that can be listened on, with TLS, and the files that this needs."""

from collections.abc import Iterator
from urllib.parse import urlsplit

from gateway.core.line import Line
from gateway.core.line_problem import Finding
from gateway.core.line_rules_opcua import is_host

_FILES = ("certificate", "private_key", "authority")
_USUAL_PORT = 7447


def listens_with_tls(line: Line) -> Iterator[Finding]:
    """tls/HOST:PORT, as Zenoh writes endpoints, and nothing without TLS."""
    if line.network is None:
        return
    scheme, _, address = line.network.listen.partition("/")
    if scheme != "tls" or not _is_address(address):
        yield Finding(("network", "listen"), "is no endpoint", '"tls/HOST:PORT"', _meant(line.network.listen))


def files_are_named(line: Line) -> Iterator[Finding]:
    """From the root, so that it does not matter where the gateway is started, and each another file."""
    if (network := line.network) is None:
        return
    for key in _FILES:
        file: str = getattr(network, key)
        if not file.startswith("/"):
            yield Finding(("network", key), "is no absolute path", 'a path from the root, as "/etc/r2rgate/pki/a.pem"')
        elif not file.endswith(".pem"):
            yield Finding(("network", key), "is no certificate or key file", "a file that ends in .pem")
    if network.private_key in (network.certificate, network.authority):
        yield Finding(("network", "private_key"), "is the file of a certificate, too", "a file of its own")


def names_differ(line: Line) -> Iterator[Finding]:
    """Twice is a slip: another name was meant."""
    names = [] if line.network is None else line.network.names
    for index, name in enumerate(names):
        if name in names[:index]:
            yield Finding(("network", "names", index), "stands twice", "each name once")


def _is_address(address: str) -> bool:
    try:
        parts = urlsplit(f"//{address}")
        return parts.netloc == address and is_host(parts.hostname or "") and bool(parts.port) and "@" not in address
    except ValueError:
        return False


def _meant(listen: str) -> str:
    """What an address without TLS, or without a port, probably means."""
    address = listen.split("://")[-1].removeprefix("tls/").removeprefix("tcp/").split("/")[0].strip()
    for like in (address, f"{address}:{_USUAL_PORT}"):
        if _is_address(like):
            return f'"tls/{like}"'
    return ""
