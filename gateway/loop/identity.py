"""Who this loop is: a nonce of its start, shown with the line's key to whoever asks on its socket."""

import asyncio
import os
import secrets
from collections.abc import Callable
from contextlib import suppress
from functools import partial

from pydantic import ValidationError

from gateway.loop.aside import Aside
from gateway.loop.cycle import Cycle
from gateway.mailbox.inbox import Bounds, Caller, RateLimiter
from gateway.mailbox.loop_proof import AskShown, NoKey, shown
from gateway.mailbox.port import PEER

#: Of each process: whoever asks without end is not answered, and everybody else is.
BOUNDS = Bounds(per_s=20.0, at_once=20.0, group_per_s=1e6, group_at_once=1e6, bytes=200)
KEPT_EVERY_S = 0.5  #: that the key's file is looked at, at most


class Identity:
    """`answer` is a handler of requests. It says what the loop is doing, and changes nothing."""

    def __init__(self, key: bytes, cycle: Cycle, keep: Callable[[], None] | None = None) -> None:
        """`keep` has the key in its file, and takes its time; None: somebody else does."""
        self._key = key
        self._keep = keep
        self._keeping: asyncio.Future[None] | None = None
        self._kept_s = cycle.clock()
        self._aside = Aside()
        self._cycle = cycle
        self._start = secrets.token_hex(32)
        self._rates = RateLimiter(cycle.clock)

    async def answer(self, payload: bytes) -> bytes:
        """Never raises for what is in `payload`."""
        cycle, peer = self._cycle, PEER.get()
        if refusal := self._rates.refuse(Caller("", f"{peer}"), BOUNDS, len(payload)):
            return refusal.code.encode()
        try:
            challenge = AskShown.model_validate_json(payload).challenge
        except ValidationError:
            return b"no challenge"
        now_s, machine = cycle.clock(), cycle.machine
        self._keep_key(now_s)
        return shown(
            self._key, challenge, self._start, os.getpid(), cycle.account.sequence, now_s, machine.state.name,
            machine.phase.name,
        )  # fmt: skip

    def close(self) -> None:
        self._aside.close()

    def _keep_key(self, now_s: float) -> None:
        """Now and then, aside: whoever asks must find the key that this answer is made with."""
        idle = self._keeping is None or self._keeping.done()
        if self._keep is None or not idle or now_s - self._kept_s < KEPT_EVERY_S:
            return
        self._kept_s = now_s
        self._keeping = asyncio.ensure_future(self._aside.do(partial(_try, self._keep)))


def _try(keep: Callable[[], None]) -> None:
    with suppress(NoKey):  # the one who asks tells that there is none
        keep()
