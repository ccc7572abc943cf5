"""Rules about the table [operator]: what can be listened on, and nothing readable on the way to another machine."""

from collections.abc import Iterator
from urllib.parse import SplitResult, urlsplit

from gateway.core.line import Line
from gateway.core.line_problem import Finding
from gateway.core.line_rules_opcua import is_host, is_this_machine

_USUAL_PORTS = {"opc.tcp": 4840, "http": 8480, "https": 8480}


def opc_ua_is_an_endpoint(line: Line) -> Iterator[Finding]:
    """opc.tcp://HOST:PORT, with a path or without."""
    if _parts(line.operator.opc_ua, ("opc.tcp",)) is None:
        allowed = '"opc.tcp://HOST:PORT", with a path or without'
        yield Finding(("operator", "opc_ua"), "is no endpoint", allowed, _meant(line.operator.opc_ua, "opc.tcp"))


def page_is_an_address(line: Line) -> Iterator[Finding]:
    """http://HOST:PORT on this machine; whoever comes from another logs in, so https there."""
    page = line.operator.page
    parts = _parts(page, ("http", "https"))
    if parts is None or parts.path not in ("", "/"):
        yield Finding(("operator", "page"), "is no address", '"http://HOST:PORT" or "https://HOST:PORT"', _meant(page))
    elif parts.scheme == "http" and not is_this_machine(parts.hostname or ""):
        wrong = "is reached from other machines without encryption: passwords could be read on the way"
        allowed = '"https://HOST:PORT" there, http on 127.0.0.1 only'
        yield Finding(("operator", "page"), wrong, allowed, f'"https://{parts.netloc}"')


def ports_differ(line: Line) -> Iterator[Finding]:
    """Two servers do not share one."""
    opc_ua, page = _parts(line.operator.opc_ua, ("opc.tcp",)), _parts(line.operator.page, ("http", "https"))
    if opc_ua is not None and page is not None and opc_ua.port == page.port:
        wrong = f"has the port of opc_ua, {opc_ua.port}"
        other = next(port for port in (_USUAL_PORTS["https"], _USUAL_PORTS["https"] + 1) if port != opc_ua.port)
        host = page.netloc.rpartition(":")[0]
        yield Finding(("operator", "page"), wrong, "a port of its own", f'"{page.scheme}://{host}:{other}"')


def folders_are_absolute(line: Line) -> Iterator[Finding]:
    """From the root, so that it does not matter where the process is started."""
    for key in ("pki", "nodesets"):
        folder = getattr(line.operator, key)
        if folder is not None and not folder.startswith("/"):
            yield Finding(("operator", key), "is no absolute path", f'a path from the root, as "/etc/r2rgate/{key}"')


def _parts(address: str, schemes: tuple[str, ...]) -> SplitResult | None:
    """An address with a host and a port that can be, otherwise None."""
    try:
        parts = urlsplit(address)
        plain = not (parts.query or parts.fragment or "@" in parts.netloc or any(c.isspace() for c in address))
        host = parts.hostname or ""
        return parts if parts.scheme in schemes and parts.port and plain and is_host(host) else None
    except ValueError:
        return None


def _meant(address: str, scheme: str = "") -> str:
    """What one without a port, or of another scheme, probably means."""
    before, _, after = address.strip().rpartition("://")
    plain = after.split("@")[-1].split("/")[0].strip()
    scheme = scheme or (before if before in ("http", "https") else "https")
    for like in (f"{scheme}://{plain}", f"{scheme}://{plain}:{_USUAL_PORTS[scheme]}"):
        if _parts(like, (scheme,)) is not None:
            return f'"{like}"'
    return ""
