"""The page as a web application: its files, what it asks for, what it is told ten times a second, and the way in."""

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from urllib.parse import urlsplit

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from gateway.core.line import Line
from gateway.operator.access import Access
from gateway.operator.line_side import LineSide
from gateway.operator.page.answer import JSONResponse
from gateway.operator.page.asks import Asks
from gateway.operator.page.events import Ticks, stream
from gateway.operator.page.guard import Guarded, names_of
from gateway.operator.page.login import Check, Door
from gateway.operator.page.serve import port_of
from gateway.operator.page.words import words_routes
from gateway.operator.users import RoleOf

STATIC = Path(str(files("gateway.operator.page"))) / "static"


def page_app(
    line: Line, side: LineSide, check: Check, role_of: RoleOf, clock: Callable[[], float], access: Access | None = None
) -> Starlette:
    """`check`: the role of whoever has this name and password, None: nobody has. `clock`: monotonic, s.
    `access` is told who comes in, and who does not.

    The page speaks TLS where the address in the line's file says https; then its cookie is sent over TLS alone.
    """
    address = urlsplit(line.operator.page)
    anonymous, secure = line.operator.anonymous == "read", address.scheme == "https"
    door = Door(check, role_of, clock, anonymous, secure, port_of(address), access)
    asks, ticks = Asks(line, side, door), Ticks(side)
    app = Starlette(
        routes=[
            *door.routes(),
            *asks.routes(),
            *words_routes(),
            Route("/events", stream(ticks, door.visitor, door.looks)),
            Mount("/", StaticFiles(directory=STATIC, html=True)),
        ],
        middleware=[Middleware(Guarded, names=names_of(address.hostname or ""))],
        exception_handlers={HTTPException: _refused},
    )
    app.state.end = ticks.end  # `serve_on` calls it: a stream has no end of its own
    return app


async def _refused(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    return JSONResponse({"ok": False, "text": error.detail}, error.status_code, error.headers)
