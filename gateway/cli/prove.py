"""The proof of a line's wiring from beginning to end, as a client of its gateway: drill, arm, pull, ask, keep."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field

from gateway.core.finding import Finding
from gateway.core.messages import Arm, Command, Drill, KeepProof, Prove, Reply
from gateway.core.status import GatewayStatus
from gateway.core.wiring_proof import Answer, asked_of

LOOK_S = 0.2  #: between two looks at the status
ASKED = "person-asked"  #: begins the findings of a proof that is kept once a person has answered
TOLD = ("drilled", "proving", "proved")  #: kinds of event that a person who waits is shown

Tell = Callable[[Command], Awaitable[Reply]]
Look = Callable[[], Awaitable[GatewayStatus | None]]
Ask = Callable[[Finding], bool]


@dataclass(frozen=True, slots=True)
class Proved:
    """What came of it. `reply` is the last answer: of what was refused, or that the proof is kept."""

    step: str  #: drill, arm, prove or keep-proof: how far it has come
    reply: Reply
    answers: list[Answer] = field(default_factory=list[Answer])

    @property
    def ok(self) -> bool:
        return self.reply.ok


async def prove(
    tell: Tell, look: Look, ask: Ask, by: str, say: Callable[[str], None], only: Sequence[str] = ()
) -> Proved:
    """Prove the wiring. `ask` has a person look where no pull can show; `by` is who that is. Raises Unreachable.

    `only`: devices that are proved anew while the stored proof stands for all others; empty: all are.
    """
    begun = await _newest(look)
    say("every watchdog is drilled: its feed is withheld at rest")
    for step in (Drill(), Arm(), Prove(only=list(only))):
        reply = await tell(step)
        if not reply.ok:
            return Proved(step.command, reply)
        say(reply.text)
    await _wait(look, begun, say)
    reply = await tell(KeepProof(only=list(only)))
    if reply.ok or not reply.findings or reply.findings[0].code != ASKED:
        return Proved("keep-proof", reply)
    questions = reply.findings[1:]
    # Of a person who has denied one of them nothing else is asked.
    if not all(ask(question) for question in questions):
        return Proved("keep-proof", reply)
    answers = [Answer(question=each.code, device=asked_of(each), by=by) for each in questions]
    return Proved("keep-proof", await tell(KeepProof(answers=answers, only=list(only))), answers)


async def _newest(look: Look) -> float:
    """The time of the newest event that is shown."""
    status = await look()
    return max((event.wall_s for event in status.events), default=0.0) if status is not None else 0.0


async def _wait(look: Look, since_wall_s: float, say: Callable[[str], None]) -> None:
    """Until the line has come to rest again; what is told meanwhile is passed on."""
    told_s = since_wall_s
    while True:
        status = await look()
        if status is not None:
            for event in sorted(status.events, key=lambda event: event.wall_s):
                if event.wall_s > told_s:
                    told_s = event.wall_s
                    if event.kind in TOLD:
                        say(event.text)
            if status.loop.phase in ("OFF", "SILENT"):
                return
            if status.loop.state == "READY" and status.loop.phase == "READY":
                return  # something spoke against it while the line warned
        await asyncio.sleep(LOOK_S)
