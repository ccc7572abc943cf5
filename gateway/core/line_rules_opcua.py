"""Rules about OPC UA servers: where they are, and that nothing is connected with less security than it seems."""

from collections.abc import Iterator
from ipaddress import ip_address
from urllib.parse import SplitResult, urlsplit

from gateway.core.line import OpcUaBus
from gateway.core.line_problem import Finding, odd
from gateway.core.toml_places import Path

_SECURITY_FILES = ("certificate", "private_key", "server_certificate")


def opcua_endpoint(bus: OpcUaBus, path: Path) -> Iterator[Finding]:
    """The endpoint can be one, and it is odd to reach another machine without security."""
    parts = _split(bus.endpoint)
    if parts is None or not is_host(parts.hostname or "") or parts.query or parts.fragment or "@" in parts.netloc:
        plain = bus.endpoint.split("://")[-1].split("@")[-1].split("/")[0].strip()
        right = f"opc.tcp://{plain}" if ":" in plain else f"opc.tcp://{plain}:4840"
        known = _split(right)
        like = f'"{right}"' if known is not None and is_host(known.hostname or "") else ""
        yield Finding((*path, "endpoint"), "is no endpoint", '"opc.tcp://HOST:PORT", with a path or without', like)
    elif bus.security == "none" and not is_this_machine(parts.hostname or ""):
        without = "is reached without security: anybody on that network can command its devices"
        yield odd((*path, "endpoint"), without, 'security = "Basic256Sha256"')


def opcua_security(bus: OpcUaBus, path: Path) -> Iterator[Finding]:
    """All three files with security, none without: never less than what the file seems to say."""
    for key in _SECURITY_FILES:
        file: str | None = getattr(bus, key)
        if bus.security == "none" and file is not None:
            says = 'security is "none": nothing would be encrypted'
            yield Finding((*path, key), says, 'no such key, or security = "Basic256Sha256"')
        elif bus.security != "none" and file is None:
            yield Finding((*path, key), "is missing", f'the path of a file (security "{bus.security}" needs it)')
        elif file is not None and not file.startswith("/"):
            yield Finding((*path, key), "is no absolute path", 'a path from the root, as "/etc/r2rgate/pki/server.der"')
        elif file is not None and not file.endswith((".der", ".pem")):
            yield Finding((*path, key), "is no certificate or key file", "a file that ends in .der or .pem")


def host_and_port(endpoint: str) -> tuple[str, int | None]:
    """What tells two endpoints apart: one server may be reached by several paths."""
    parts = _split(endpoint)
    return (endpoint, None) if parts is None else (parts.hostname or "", parts.port)


def _split(endpoint: str) -> SplitResult | None:
    """An endpoint with a host and a port that can be, otherwise None."""
    try:
        parts = urlsplit(endpoint)
        return parts if parts.scheme == "opc.tcp" and parts.port and not any(c.isspace() for c in endpoint) else None
    except ValueError:
        return None


def is_host(host: str) -> bool:
    """Whether it may be an address or a name."""
    return bool(host) and all(c.isalnum() or c in ".-_:" for c in host)


def is_this_machine(host: str) -> bool:
    """Whether nobody else can reach it there."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
