"""A session with a server that answers questions, one at a time.

When to connect again is decided here, and what an answer says is believed only when it fits the question. Any answer
that does not, and any that does not come in time, ends the connection: it is reset, so that requests that a stopped
server has not taken yet do not come to life when it goes on.
"""

import asyncio
from typing import Any

from drivers.opcua.messages import Answer, Outcome, Plan, Question
from drivers.opcua.nodes import Reading
from drivers.opcua.services import Services, statuses
from drivers.opcua.session import Session
from gateway.tasks.cleanup import end, finish

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0  #: between attempts to connect


class NotConnected(Exception):
    """There is no session; the text says why."""


class Engine:
    """`generation` counts the engines of a link: connection numbers of different engines never coincide."""

    def __init__(self, plan: Plan, generation: int) -> None:
        self._plan = plan
        self._kinds = [node.type for node in plan.nodes]
        self._connection = generation << 32
        self._session: Session | None = None
        self._services = Services([], [])
        self._connecting: asyncio.Task[None] | None = None
        self._retry_s = float("-inf")
        self._pause_s = FIRST_PAUSE_S
        self._why = "not connected yet"

    async def answer(self, question: Question) -> Answer:
        """Ask the server. Returns by the question's deadline, with a reason when there is nothing else."""
        loop = asyncio.get_running_loop()
        try:
            session = await self._need_session(question)
        except NotConnected as error:
            return Answer(question.number, Outcome.NO_CONNECTION, self._connection, text=str(error))
        if question.writes and question.connection != self._connection:
            return Answer(question.number, Outcome.OTHER_CONNECTION, self._connection, text="connected anew")
        if loop.time() >= (question.write_by_s if question.writes else question.deadline_s):
            return Answer(question.number, Outcome.TOO_LATE, self._connection, text="the command came too late")
        written: tuple[int, ...] = ()
        readings: tuple[Reading, ...] = ()
        text = ""
        asked: list[asyncio.Future[Any]] = []
        try:
            requests = [self._services.write(question.writes)] if question.writes else []
            requests += [self._services.read(question.reads)] if question.reads else []
            async with asyncio.timeout_at(question.deadline_s):
                asked = session.ask(requests)
                if question.writes:
                    written = statuses(bytes(await asked[0]), len(question.writes))
                if question.reads:
                    answer = bytes(await asked[-1])
                    readings = self._services.readings(answer, question.reads)
                    text = self._services.serial(answer, question.reads)
        except TimeoutError:
            why = "no answer in time"
        # asyncua's side of the connection raises whatever Python does on bytes that are none of OPC UA's.
        except Exception as error:
            why = _in_words(error)
        else:
            self._pause_s = FIRST_PAUSE_S
            return Answer(question.number, Outcome.DONE, self._connection, written, readings, text)
        finally:
            _forget(asked)
        await self._drop(why)
        return Answer(question.number, Outcome.FAILED, self._connection, written, text=why)

    async def close(self) -> None:
        """End the session in order, as far as the server takes part. Idempotent; no cancellation cuts it."""
        await finish(self._close())

    async def _close(self) -> None:
        if self._connecting is not None:
            await end(self._connecting)
        session, self._session = self._session, None
        if session is not None:
            await session.close()

    def abandon(self) -> None:
        """Drop everything at once, from outside of a coroutine."""
        if self._connecting is not None:
            self._connecting.cancel()
        if self._session is not None:
            self._session.abort()
            self._session = None

    # the connection

    async def _need_session(self, question: Question) -> Session:
        """Raises NotConnected, after an attempt has begun where the time has come for one."""
        if self._session is not None and not self._session.is_open:
            await self._drop("the server closed the connection")
        if self._session is not None:
            return self._session
        now_s = asyncio.get_running_loop().time()
        if self._connecting is None and (question.patient or now_s >= self._retry_s):
            self._retry_s = now_s + self._pause_s
            self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)
            self._connecting = asyncio.create_task(self._connect())
        if question.patient and self._connecting is not None:
            await asyncio.wait([self._connecting], timeout=max(0.0, question.deadline_s - now_s))
        if self._session is None:
            raise NotConnected(self._why)
        return self._session

    async def _connect(self) -> None:
        """One attempt. The outcome is in `_session` and `_why`."""
        try:
            session = await Session.open(self._plan)
        except Exception as error:  # see `answer`
            self._why = _in_words(error)
        else:
            self._services = Services(session.nodes, self._kinds)
            self._connection += 1
            self._session = session
        finally:
            self._connecting = None

    async def _drop(self, why: str) -> None:
        self._why = why
        session, self._session = self._session, None
        if session is not None:
            await session.drop()


def _forget(asked: list[asyncio.Future[Any]]) -> None:
    """Nobody waits for these any more; what went wrong with them has been said."""
    for answer in asked:
        if answer.done() and not answer.cancelled():
            answer.exception()
        answer.cancel()


def _in_words(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
