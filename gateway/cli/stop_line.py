"""Stop the line from the command line: straight to the loop, and done only once the loop itself shows it.

Whoever has taken the loop's socket can answer "done". So the loop is asked who it is, and what it is doing, with a
challenge that only the line's key answers (`mailbox.loop_proof`). At the same time the stop goes through the gateway,
which may still have its connection to the true one where another process has taken the socket.
"""

import asyncio
import time
from pathlib import Path
from typing import NamedTuple

from pydantic import ValidationError

from gateway.core.finding import Finding, finding
from gateway.core.messages import Reply, Stop
from gateway.core.states import shows_stop
from gateway.core.topics import GATEWAY_COMMAND, LOOP_COMMAND, LOOP_SHOWN
from gateway.mailbox.loop_proof import AskShown, NoKey, NotTheLoop, new_challenge, proven, read_key
from gateway.mailbox.paths import GATEWAY_SOCKET, LOOP_SOCKET
from gateway.mailbox.port import ANSWERED, Peer, RemoteError, Unreachable
from gateway.mailbox.unix import UnixMailbox
from gateway.mailbox.who_serves import ServedByStranger
from gateway.wording.catalogue import sentence, sentences

SHOWN_S = 1.0  #: for the loop to show that the line stops
ASK_S = 0.05
WHY_S = 0.5  #: for what answers on the loop's socket, or does not, once the gateway's way has shown the stop


class _Straight(NamedTuple):
    """What came straight from the loop's socket, and why it is not believed; empty: it is."""

    reply: Reply
    why: list[Finding]


async def stop_line(run_folder: Path, timeout_s: float) -> Reply:
    """The reply, `ok` only where the line's loop shows the stop. Raises Unreachable and PathTooLong.

    Both ways at once: a second stop changes nothing, and whoever keeps silent on one way delays nobody.
    """
    mailbox = UnixMailbox()
    mailbox.connect({LOOP_COMMAND, LOOP_SHOWN}, run_folder / LOOP_SOCKET)
    mailbox.connect({GATEWAY_COMMAND}, run_folder / GATEWAY_SOCKET)
    straight = asyncio.create_task(_straight(mailbox, run_folder, timeout_s))
    through = asyncio.create_task(_through_gateway(mailbox, timeout_s))
    try:
        await asyncio.wait((straight, through), return_when=asyncio.FIRST_COMPLETED)
        relayed = through.result() if through.done() else None
        if relayed is not None and relayed.ok:
            await asyncio.wait((straight,), timeout=WHY_S)
            if not straight.done():
                return _through(relayed, [finding("false-loop-mute", error=f"no answer within {WHY_S:g} s")])
        return await _told(straight, through)
    finally:
        for task in (straight, through):
            task.cancel()
        await asyncio.gather(straight, through, return_exceptions=True)
        await mailbox.close()


async def _told(straight: "asyncio.Task[_Straight]", through: "asyncio.Task[Reply | None]") -> Reply:
    """What is known once the way straight to the loop has come to its end. Raises Unreachable."""
    try:
        reply, why = await straight
    except Unreachable as error:
        if (relayed := await through) is not None and relayed.ok:
            return _through(relayed, [error.found]) if isinstance(error, ServedByStranger) else relayed
        raise
    if not why:
        return reply
    if (relayed := await through) is not None and relayed.ok:
        return _through(relayed, why)
    findings = [*why, finding("stop-not-known")]
    reasons = [sentence(one) for one in findings]
    return Reply(ok=False, state="UNKNOWN", text=reasons[-1], reasons=reasons[:-1], findings=findings, known=False)


def _through(relayed: Reply, why: list[Finding]) -> Reply:
    text = f"{relayed.text}; through the gateway, for the loop's socket was not believed: {sentences(why)}"
    return relayed.model_copy(update={"text": text, "findings": [*relayed.findings, *why]})


async def _straight(mailbox: UnixMailbox, run_folder: Path, timeout_s: float) -> _Straight:
    reply = _reply(await mailbox.request(LOOP_COMMAND, Stop().model_dump_json().encode(), timeout_s))
    return _Straight(reply, await _why_not_shown(mailbox, run_folder, ANSWERED.get()))


async def _why_not_shown(mailbox: UnixMailbox, run_folder: Path, answered: Peer | None) -> list[Finding]:
    """Why what has answered `stop` is not believed; empty: it is the line's loop, and shows that the line stops."""
    until_s = time.monotonic() + SHOWN_S
    phase = "-"
    while time.monotonic() < until_s:
        challenge = new_challenge()
        try:
            key = read_key(run_folder)
            asked = AskShown(challenge=challenge).model_dump_json().encode()
            answer = await mailbox.request(LOOP_SHOWN, asked, SHOWN_S)
            found = proven(key, challenge, answer, ANSWERED.get())
        except (NoKey, NotTheLoop) as error:
            return [error.found]
        except Unreachable as error:
            return [finding("false-loop-mute", error=str(error))]
        if answered is not None and answered.pid != found.pid:
            return [finding("false-loop-answered", command="stop")]
        if shows_stop(found.phase):
            return []
        phase = found.phase
        await asyncio.sleep(ASK_S)
    return [finding("stop-not-shown", phase=phase, after_s=SHOWN_S)]


async def _through_gateway(mailbox: UnixMailbox, timeout_s: float) -> Reply | None:
    try:
        return _reply(await mailbox.request(GATEWAY_COMMAND, Stop().model_dump_json().encode(), timeout_s))
    except Unreachable:
        return None


def _reply(answer: bytes) -> Reply:
    try:
        return Reply.model_validate_json(answer)
    except ValidationError as error:
        raise RemoteError("what answers there is of another version than this command") from error
