"""The way in: names and passwords, the cookie of a session, and who a request comes from."""

import math
import secrets
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field, ValidationError
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.routing import Route

from gateway.core.line import Strict
from gateway.core.people import Person, Role, may
from gateway.operator.access import Access
from gateway.operator.page.answer import JSONResponse
from gateway.operator.page.guard import body_of
from gateway.operator.page.sessions import LONGEST_S, MAY_IDLE, Session, Sessions, Tries
from gateway.operator.places import place_of, share_of
from gateway.operator.users import RoleOf

Check = Callable[[str, str], Awaitable[Role | None]]

MOST_CHECKS = 4  #: passwords that wait to be checked, a share of them from one place: each takes memory and time
LOOK_UP_S = 10.0  #: between two looks at the role of somebody who looks on; whoever says something is looked up then
TOKEN_HEADER = "x-r2rgate-token"


class _Login(Strict):
    name: Annotated[str, Field(max_length=64)]
    password: Annotated[str, Field(max_length=1000)]


@dataclass(frozen=True)
class Visitor:
    """Whoever looks at the page."""

    name: str | None  #: None: nobody has logged in, and anybody may look
    role: Role
    token: str | None
    idle: str | None = None  #: whose session is idle: it may still stop and hold, and nothing else


class Door:
    """Lets people in, and says who they are. `anonymous`: whoever has no name may look."""

    def __init__(
        self,
        check: Check,
        role_of: RoleOf,
        clock: Callable[[], float],
        anonymous: bool,
        secure: bool,
        port: int,
        access: Access | None,
    ) -> None:
        """`access`: is told who comes in, and who does not."""
        self._check = check
        self._role_of = role_of
        self._clock = clock
        self._access = access
        self._anonymous = anonymous
        self._secure = secure
        # Cookies do not tell ports apart: two lines on one machine would log each other out.
        self._cookie = f"__Host-r2rgate-{port}" if secure else f"r2rgate-{port}"
        self._sessions = Sessions(clock)
        self._tries = Tries(clock)
        self._checking: Counter[str] = Counter()  #: by place

    def routes(self) -> list[Route]:
        return [
            Route("/api/login", self._login, methods=["POST"]),
            Route("/api/logout", self._logout, methods=["POST"]),
            Route("/api/me", self._me),
        ]

    def visitor(self, request: Request) -> Visitor:
        """Raises HTTPException 401: log in."""
        visitor = self._known(self._session(request))
        if visitor is None:
            raise HTTPException(401, "log in")
        return visitor

    def looks(self, request: Request) -> Visitor | None:
        """As whom, still; None: they may not. This is no request of the person."""
        session = self._sessions.find(self._key(request))
        if session is not None and self._clock() - session.looked_up_s >= LOOK_UP_S:
            session = self._session(request)
        return self._known(session)

    def person(self, request: Request, idle_too: bool = False) -> Person:
        """Who says something. Raises HTTPException where nobody has logged in, or another site's page asks.

        `idle_too`: also of a session that is idle, for what such a one may still say.
        """
        session = self._session(request)
        if session is None or (session.is_idle and not idle_too):
            raise HTTPException(401, "log in")
        if not secrets.compare_digest(request.headers.get(TOKEN_HEADER, "").encode(), session.token.encode()):
            raise HTTPException(403, "the request does not carry this session's token; load the page anew")
        self._sessions.use(self._key(request))
        return Person(name=session.name, role=session.role, through="page")

    async def _login(self, request: Request) -> JSONResponse:
        try:
            login = _Login.model_validate_json(await body_of(request))
        except ValidationError:
            raise HTTPException(400, "a login is a name and a password") from None
        address = address_of(request)
        place = place_of(address)
        if wait_s := self._tries.wait_s(place):
            whole_s = math.ceil(wait_s)
            raise HTTPException(429, f"too many tries; wait {whole_s} s", {"retry-after": str(whole_s)})
        if self._checking.total() >= MOST_CHECKS or self._checking[place] >= share_of(MOST_CHECKS):
            raise HTTPException(503, "too many people are logging in; try again", {"retry-after": "1"})
        role = await self._role(login, place)
        if role is None:
            self._tries.failed(place, login.name)
            if self._access is not None:
                self._access.refused("page", address, None, login.name)
            raise HTTPException(403, "name or password is wrong")
        self._tries.went_well(place, login.name)
        _prove(request)
        self._sessions.end(self._key(request))
        if self._access is not None:
            self._access.came_in(Person(name=login.name, role=role, through="page"), address)
        return self._let_in(login.name, role)

    async def _role(self, login: _Login, place: str) -> Role | None:
        self._checking[place] += 1
        try:
            return await self._check(login.name, login.password)
        finally:
            self._checking -= Counter([place])  # which forgets a place without any

    def _let_in(self, name: str, role: Role) -> JSONResponse:
        key = self._sessions.begin(name, role)
        session = self._sessions.find(key)
        assert session is not None
        answer = JSONResponse(_told(Visitor(name, role, session.token)))
        answer.set_cookie(
            self._cookie, key, max_age=int(LONGEST_S), path="/", secure=self._secure, httponly=True, samesite="strict"
        )
        return answer

    async def _logout(self, request: Request) -> JSONResponse:
        self.person(request, idle_too=True)
        self._sessions.end(self._key(request))
        answer = JSONResponse({})
        answer.delete_cookie(self._cookie, path="/", secure=self._secure, httponly=True, samesite="strict")
        return answer

    async def _me(self, request: Request) -> JSONResponse:
        session = self._session(request)
        self._sessions.use(self._key(request))
        visitor = self._known(session)
        if session is None or not session.is_idle:
            return JSONResponse(_told(visitor))
        return JSONResponse(_told(visitor) | {"token": session.token, "idle": session.name})

    def _session(self, request: Request) -> Session | None:
        """With the role that they have now. None: nobody has one, is a user any more, or may say anything with it."""
        key = self._key(request)
        session = self._sessions.find(key)
        if session is None:
            return None
        role, session.looked_up_s = self._role_of(session.name), self._clock()
        if role is None or (session.is_idle and not any(may(role, command) for command in MAY_IDLE)):
            self._sessions.end(key)
            return None
        session.role = role
        _prove(request)
        return session

    def _known(self, session: Session | None) -> Visitor | None:
        if session is not None and not session.is_idle:
            return Visitor(session.name, session.role, session.token)
        idle = None if session is None else session.name
        return Visitor(None, "viewer", None, idle) if self._anonymous else None

    def _key(self, request: Request) -> str:
        return request.cookies.get(self._cookie, "")


def address_of(request: Request) -> str:
    return request.client.host if request.client else ""


def _told(visitor: Visitor | None) -> dict[str, str | None]:
    if visitor is None:
        return {"name": None, "role": None, "token": None}
    return {"name": visitor.name, "role": visitor.role, "token": visitor.token}


def _prove(request: Request) -> None:
    """Whoever asks this has a session: their connection is the last that makes room for another."""
    if (proven := getattr(request.state, "proven", None)) is not None:  # of one that `serve` has accepted
        proven()
