"""The gateway's way to its loop: each command signed for the loop that is there now."""

import asyncio

from pydantic import ValidationError

from gateway.core.messages import Command, Deploy, Keep, Reply, WatchGood, command_bytes
from gateway.core.proof import Grounds, Introduction
from gateway.core.topics import LOOP_COMMAND, LOOP_HELLO
from gateway.mailbox.port import Mailbox, NotSent, RemoteError, Unreachable
from gateway.mailbox.rights import may_be_said_by_anybody
from gateway.mailbox.seal import Signer

HELLO_S = 1.0  #: for a loop to say who it is
ANOTHER_LOOP = "proof-of-another-loop"


class ToLoop:
    """`tell` it a command. It asks a loop who it is once, and again where another one has taken its place."""

    def __init__(self, mailbox: Mailbox, signer: Signer) -> None:
        self._mailbox = mailbox
        self._signer = signer
        self._loop: str | None = None  #: nonce of its start, as it said last

    def forget(self) -> None:
        """Another start of the loop is there: it is asked who it is before anything is signed for it."""
        self._loop = None

    async def tell(self, command: Command, timeout_s: float, grounds: Grounds | None = None) -> Reply:
        """The loop's answer. Raises Unreachable; NotSent where it is not done for certain."""
        if may_be_said_by_anybody(command.command):
            return await self._ask(command_bytes(command), timeout_s)
        reply = await self._signed(command, timeout_s, grounds)
        if any(one.code == ANOTHER_LOOP for one in reply.findings):  # it was started anew: nothing was done
            self._loop = None
            reply = await self._signed(command, timeout_s, grounds)
        return reply

    async def _signed(self, command: Command, timeout_s: float, grounds: Grounds | None) -> Reply:
        loop = self._loop = self._loop or await self._hello()
        if isinstance(command, Deploy | Keep | WatchGood):  # packed and hashed, which takes its time
            payload = await asyncio.to_thread(self._signer.sealed, command, loop, grounds)
        else:
            payload = self._signer.sealed(command, loop, grounds)
        return await self._ask(payload, timeout_s)

    async def _hello(self) -> str:
        """Raises NotSent: whatever was to be told has not been told."""
        try:
            answer = await self._mailbox.request(LOOP_HELLO, b"", HELLO_S)
            return Introduction.model_validate_json(answer).loop
        except NotSent:
            raise
        except Unreachable as error:
            raise NotSent(f"the loop does not say who it is, nothing was told to it: {error}") from error
        except ValidationError as error:
            raise NotSent("what answers as the loop is of another version than this gateway") from error

    async def _ask(self, payload: bytes, timeout_s: float) -> Reply:
        answer = await self._mailbox.request(LOOP_COMMAND, payload, timeout_s)
        try:
            return Reply.model_validate_json(answer)
        except ValidationError as error:
            raise RemoteError("the loop answered what is no reply: it is of another version") from error
