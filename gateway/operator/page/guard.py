"""What holds for every request: for which host it may be, that it comes from this page, how long it is; and what every
answer tells the browser to refuse.
"""

import asyncio
from collections.abc import Mapping
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gateway.core.line_rules_opcua import is_this_machine

MOST_BYTES = 16_384  #: of a request's body
BODY_S = 10.0  #: for it to come
LOCALHOST = frozenset({"127.0.0.1", "localhost", "::1"})

POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self'",
        "connect-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
        "require-trusted-types-for 'script'",
    )
)
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=(), payment=()",
}


def names_of(host: str) -> frozenset[str] | None:
    """Under which a page on `host` is asked for; None: under any, as where it is reached from other machines.

    Each address of loopback is one of its own: what is bound to 127.0.0.2 is no `localhost`.
    """
    if host in LOCALHOST:
        return LOCALHOST
    return frozenset({host}) if is_this_machine(host) else None


def why_not_this_host(host: str, names: frozenset[str] | None) -> str:
    """Empty: it may be. Another name for this machine in a browser is a stranger's, who would read the answers."""
    try:
        name = urlsplit(f"//{host}").hostname
    except ValueError:
        name = None
    if not name:
        return "the request names no host"
    if names is not None and name not in names:
        return f"{name} is not this page's; allowed: {', '.join(sorted(names))}"
    return ""


def why_not_from_here(headers: Mapping[str, str]) -> str:
    """Empty: the request comes from this page itself. For all that changes something."""
    site, origin = headers.get("sec-fetch-site"), headers.get("origin")
    if site is None and origin is None:
        return "the request does not say from which page it comes"
    if site not in (None, "same-origin"):
        return f"the request comes from another page ({site})"
    if origin is not None and urlsplit(origin).netloc != headers.get("host"):
        return "the request comes from another page"
    return ""


class Guarded:
    """An ASGI application, within these rules."""

    def __init__(self, app: ASGIApp, names: frozenset[str] | None) -> None:
        """`names`: as `names_of`."""
        self._app = app
        self._names = names

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers[name] = value
                headers.setdefault("cache-control", "no-cache" if "etag" in headers else "no-store")
            await send(message)

        refused = self._why_not(scope["method"], Headers(scope=scope))
        app = PlainTextResponse(refused, status_code=403) if refused else self._app
        await app(scope, receive, send_guarded)

    def _why_not(self, method: str, headers: Headers) -> str:
        refused = why_not_this_host(headers.get("host", ""), self._names)
        return refused or ("" if method in ("GET", "HEAD") else why_not_from_here(headers))


async def body_of(request: Request) -> bytes:
    """Raises HTTPException where it is said to be no JSON, longer than MOST_BYTES whatever its header says, or slow."""
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise HTTPException(415, "the request is not application/json")
    body = bytearray()
    try:
        async with asyncio.timeout(BODY_S):
            async for part in request.stream():
                body += part
                if len(body) > MOST_BYTES:
                    raise HTTPException(413, f"the request is longer than {MOST_BYTES} bytes", {"connection": "close"})
    except TimeoutError:
        raise HTTPException(408, "the request does not come to its end", {"connection": "close"}) from None
    return bytes(body)
