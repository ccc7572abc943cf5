"""Courses of the proposal that waits, for whoever decides on it: simulated once, when somebody asks, and kept.

They are made of exactly what was judged, in a process that no verdict waits for: whoever asks never waits here, but is
told to ask again. What still waits for a decision is never drawn twice.
"""

import asyncio
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Protocol

from pydantic import ValidationError

from gateway.core.courses import Courses, CoursesTold, DrawnCourse, ShowCourses
from gateway.core.deployment import Region
from gateway.core.judge_context import JudgeContext
from gateway.core.line_model import model_hash
from gateway.core.messages import Reply
from gateway.core.topics import GATEWAY_COURSES
from gateway.mailbox.port import Mailbox
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.deployer import Deployer
from gateway.supervisor.deployer_sides import NotKnown
from gateway.supervisor.judging import NoVerdict
from gateway.supervisor.lifecycle import Stage

MOST_KEPT = 8  #: of what waits no more
MOST_WAITING = 200  #: that are drawn at all: 200 kB each at most


class Draws(Protocol):
    async def courses(self, payload: bytes, context: JudgeContext, region: Region) -> Courses:
        """Raises NoVerdict."""
        ...


class CoursesDesk:
    """A handler on a mailbox; `close` at the end."""

    def __init__(self, mailbox: Mailbox, deployer: Callable[[], Deployer | None], judge: Draws) -> None:
        """`deployer`: None while the gate is shut."""
        self._deployer = deployer
        self._judge = judge
        #: By the hash of the verdict, with the proposal; those last that were asked for last.
        self._kept: OrderedDict[str, tuple[str, bytes]] = OrderedDict()
        self._drawing: asyncio.Task[None] | None = None
        mailbox.serve(GATEWAY_COURSES, self._answer)

    async def close(self) -> None:
        if self._drawing is not None:
            self._drawing.cancel()
            await asyncio.gather(self._drawing, return_exceptions=True)

    async def _answer(self, payload: bytes) -> bytes:
        try:
            asked = ShowCourses.model_validate_json(payload)
        except ValidationError as error:
            reasons = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
            return _refused("not understood", reasons)
        deployer = self._deployer()
        if deployer is None:
            return _refused("the gate is shut", ["ask again once it is open"])
        try:
            return await self._told(asked.proposal, deployer)
        except (NotKnown, AuditUnavailable) as error:
            return _refused("there are no courses of it", [str(error)])

    async def _told(self, proposal: str, deployer: Deployer) -> bytes:
        """Raises NotKnown, AuditUnavailable."""
        entry = deployer.book.entries.get(proposal)
        if entry is None or entry.verdict is None:
            raise NotKnown("it is not judged yet")
        if (found := self._kept.get(entry.verdict)) is not None:
            self._kept.move_to_end(entry.verdict)
            return found[1]
        if entry.kind != "gains" or entry.stage is not Stage.WAITING:
            raise NotKnown("they are drawn of another controller alone, and while it waits for a decision")
        self._make_room(deployer)
        judged = await deployer.judged_as(entry)
        if self._drawing is not None and self._drawing.done() and not self._drawing.cancelled():
            drawn, self._drawing = self._drawing, None
            drawn.result()  # what was raised is told to whoever asks next, who may ask again
        if self._drawing is None or self._drawing.done():
            work = self._draw(proposal, entry.verdict, *judged)
            self._drawing = asyncio.get_running_loop().create_task(work)
        return _of(proposal, entry.verdict, None, drawing=True)

    def _make_room(self, deployer: Deployer) -> None:
        """What waits for a decision stays. Raises NotKnown where too much does."""
        waiting = {entry.proposal for entry in deployer.book.undecided if entry.stage is Stage.WAITING}
        over = [one for one, (whose, _) in self._kept.items() if whose not in waiting]
        for one in over[: max(0, len(over) - MOST_KEPT)]:
            del self._kept[one]
        if len(self._kept) >= MOST_KEPT + MOST_WAITING:
            raise NotKnown(f"courses of {len(self._kept)} proposals are kept already: decide some of them first")

    async def _draw(self, proposal: str, verdict: str, payload: bytes, context: JudgeContext, region: Region) -> None:
        try:
            courses = (await self._judge.courses(payload, context, region)).courses
        except NoVerdict:
            courses = []
        self._kept[verdict] = proposal, await asyncio.to_thread(_of, proposal, verdict, context, courses)


def _of(
    proposal: str,
    verdict: str,
    context: JudgeContext | None,
    courses: Sequence[DrawnCourse] = (),
    *,
    drawing: bool = False,
) -> bytes:
    model = None if context is None or context.model is None else model_hash(context.model)
    told = CoursesTold(
        format=1, proposal=proposal, verdict=verdict, model=model, drawing=drawing, courses=list(courses)
    )
    return told.model_dump_json().encode()


def _refused(text: str, reasons: list[str]) -> bytes:
    return Reply(ok=False, state="", text=text, reasons=reasons[:20]).model_dump_json().encode()
