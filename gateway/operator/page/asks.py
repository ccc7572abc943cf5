"""What the page asks for: the line, proposals, records, tensions of the past; and what people say."""

import json
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.routing import Route

from gateway.core.finding import finding
from gateway.core.line import Line, Strict
from gateway.core.line_past import TensionsBetween
from gateway.core.messages import Hold, Reply, Stop
from gateway.core.people import LEAST, Person, Said, may, why_may_not
from gateway.operator.line_side import Declined, LineSide, NotTold
from gateway.operator.page.answer import JSONResponse
from gateway.operator.page.guard import body_of
from gateway.operator.page.login import Door
from gateway.operator.page.sessions import MAY_IDLE
from gateway.operator.page.tick import line_told
from gateway.operator.page.told import proposal_told
from gateway.wording.catalogue import languages, sentence

MAX_SAFE = 8  #: stops that wait for their answer, and holds, whatever else is asked
#: Each at an address of its own: where there is no place for requests any more, there still is one for these.
SAFE: dict[str, Stop | Hold] = {"/api/stop": Stop(), "/api/hold": Hold()}
_SAID: TypeAdapter[Said] = TypeAdapter(Annotated[Said, Field(discriminator="command")])


class Asks:
    """Hands on what the gateway tells, to whoever may look; and what a person says, in their name."""

    def __init__(self, line: Line, side: LineSide, door: Door) -> None:
        self._line = line_told(line)
        self._side = side
        self._door = door
        self._waiting: Counter[str] = Counter()  #: of what is SAFE

    def routes(self) -> list[Route]:
        return [
            Route("/api/line", self._of_line),
            Route("/api/proposals", self._proposals),
            Route("/api/proposals/{proposal}", self._proposal),
            Route("/api/courses/{proposal}", self._courses),
            Route("/api/asked/{proposal}", self._asked),
            Route("/api/records", self._records),
            Route("/api/tensions", self._tensions),
            Route("/api/say", self._say, methods=["POST"]),
            *(Route(path, self._say_safe, methods=["POST"]) for path in SAFE),
        ]

    async def _of_line(self, request: Request) -> JSONResponse:
        visitor = self._door.visitor(request)
        return JSONResponse({**self._line, "may": [command for command in LEAST if may(visitor.role, command)]})

    async def _proposals(self, request: Request) -> JSONResponse:
        self._door.visitor(request)
        if self._side.proposals is None:
            raise HTTPException(503, self._side.trouble or "the gateway has not told yet")
        return JSONResponse(self._side.proposals.model_dump())

    async def _proposal(self, request: Request) -> JSONResponse:
        self._door.visitor(request)
        try:
            return JSONResponse(proposal_told(await self._side.shown(request.path_params["proposal"])))
        except ValidationError as error:
            raise HTTPException(400, _in_words(error)) from None
        except NotTold as error:
            raise HTTPException(503, str(error)) from error

    async def _courses(self, request: Request) -> JSONResponse:
        return await self._of_proposal(request, self._side.courses)

    async def _asked(self, request: Request) -> JSONResponse:
        return await self._of_proposal(request, self._side.asked)

    async def _of_proposal(self, request: Request, tell: Callable[[str], Awaitable[Strict]]) -> JSONResponse:
        self._door.visitor(request)
        try:
            return JSONResponse((await tell(request.path_params["proposal"])).model_dump())
        except ValidationError as error:
            raise HTTPException(400, _in_words(error)) from None
        except Declined as error:  # whoever asks again and again may stop
            raise HTTPException(409, str(error)) from error
        except NotTold as error:
            raise HTTPException(503, str(error)) from error

    async def _records(self, request: Request) -> JSONResponse:
        self._door.visitor(request)
        after = request.query_params.get("after")
        if after is not None and not (after.isdecimal() and len(after) < 18):
            raise HTTPException(400, f"after is {after[:20]!r}; allowed: the number of a record")
        try:
            told = await self._side.records(None if after is None else int(after))
        except NotTold as error:
            raise HTTPException(503, str(error)) from error
        # What a record holds in full stays in the audit: the page has its sentence.
        return JSONResponse(told.model_dump(exclude={"records": {"__all__": {"what"}}}))

    async def _tensions(self, request: Request) -> JSONResponse:
        self._door.visitor(request)
        try:
            asked = TensionsBetween.model_validate_strings(dict(request.query_params))
        except ValidationError as error:
            raise HTTPException(400, _in_words(error)) from None
        try:
            return JSONResponse((await self._side.tensions(asked)).model_dump())
        except NotTold as error:
            raise HTTPException(503, str(error)) from error

    async def _say(self, request: Request) -> JSONResponse:
        self._door.person(request, idle_too=True)
        try:
            said = _SAID.validate_python(_object(await body_of(request)))
        except ValidationError as error:
            raise HTTPException(400, _in_words(error)) from None
        person = self._door.person(request, idle_too=said.command in MAY_IDLE)
        return await self._said(person, said)

    async def _say_safe(self, request: Request) -> JSONResponse:
        """A stop or a hold; its address says all, nothing is read."""
        person, path = self._door.person(request, idle_too=True), request.url.path
        said = SAFE[path]
        if self._waiting[path] >= MAX_SAFE:
            found = finding("safe-crowded", command=said.command, waiting=MAX_SAFE)
            text = sentence(found)
            reply = Reply(ok=False, state="", text=text, reasons=[text], findings=[found], known=False)
            return JSONResponse(_told(reply), 503)
        self._waiting[path] += 1
        try:
            return await self._said(person, said)
        finally:
            self._waiting[path] -= 1

    async def _said(self, person: Person, said: Said) -> JSONResponse:
        if reason := why_may_not(person, said.command):
            # The gateway refuses it as well, and its audit has to know that it was tried.
            reply = await self._side.say(person, said)
            return JSONResponse({**_told(reply), "ok": False, "text": reason}, 403)
        reply = await self._side.say(person, said)
        return JSONResponse(_told(reply), _status(reply))


def _told(reply: Reply) -> dict[str, Any]:
    """With what each finding's sentence is in the other languages: `said`, by language, then by the English one."""
    said = {
        language: {sentence(one): sentence(one, language) for one in reply.findings} for language in languages()[1:]
    }
    return {**reply.model_dump(exclude={"in_service"}), "said": said if reply.findings else {}}


def _status(reply: Reply) -> int:
    """409: the gateway refuses. 504: it did not answer, and nobody knows whether it was done."""
    if reply.ok:
        return 200
    return 409 if reply.known else 504


def _object(body: bytes) -> dict[str, Any]:
    """Raises HTTPException."""
    try:
        found = json.loads(body)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise HTTPException(400, "what is said is no JSON object")
    return found


def _in_words(error: ValidationError) -> str:
    return "; ".join(f"{'.'.join(map(str, one['loc'])) or 'it'}: {one['msg']}" for one in error.errors()[:20])
