"""Which process is the line's loop, and what is taken of it. What others tell is counted, and is a fault of its own.

A loop shows who it is when it is asked (`mailbox.loop_proof`). What a process that is not known yet publishes waits for
that, a little; nothing of one that is not the loop reaches status, history or records. It is asked again now and then,
and at once where another process begins to tell: a loop that was started anew, or one that only says so.
"""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path

from gateway.core.finding import Finding, finding
from gateway.core.messages import Command, Reply, Stop
from gateway.core.states import LoopState, shows_stop
from gateway.mailbox.loop_proof import AskShown, LoopShown, NoKey, NotTheLoop, new_challenge, proven, read_key
from gateway.mailbox.port import ANSWERED, PEER, Peer, RemoteError, Unreachable
from gateway.mailbox.who_serves import ServedByStranger
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.bounded import Bounded
from gateway.wording.catalogue import sentence

ASK_EVERY_S = 1.0
ASK_AT_MOST_EVERY_S = 0.05
TOLD_FOR_S = 10.0  #: for which what was found is told in the status
MOST_STRANGERS = 4  #: processes of which something waits
MOST_WAITING = 256  #: messages of each
MOST_WAITING_BYTES = 1_048_576  #: and bytes: as many frames of 60 spans have half of it
MOST_UNRECORDED = 20  #: findings that wait for the audit
WAITS_S = 1.5  #: at most, before it is dropped as a stranger's

Deliver = Callable[[bytes], None]
Ask = Callable[[bytes], Awaitable[tuple[bytes, Peer | None]]]


_NAMES = {int(state): state.name for state in LoopState}


def is_shown(command: Command, reply: Reply, seen: set[tuple[int, int]]) -> bool:
    """Whether states and phases of frames since `command` was given show what `reply` says was done."""
    if isinstance(command, Stop):
        return any(shows_stop(phase) for _, phase in seen)
    return reply.state in names_of(seen)


def names_of(seen: set[tuple[int, int]]) -> list[str]:
    """The states among them, by name."""
    return sorted({_NAMES.get(state, "UNKNOWN") for state, _ in seen})


async def _unrecorded(_what: dict[str, object], _left_out: int) -> None:
    """Until there is an audit."""


@dataclass
class _Stranger:
    """A process that publishes and has not been shown to be the loop."""

    since_s: float
    waiting: deque[tuple[Deliver, bytes]] = field(default_factory=deque[tuple[Deliver, bytes]])
    size_bytes: int = 0  #: of what waits

    def put(self, deliver: Deliver, payload: bytes) -> int:
        """The newest waits, and as many before it as there is room for. Returns how many have lost their place."""
        self.waiting.append((deliver, payload))
        self.size_bytes += len(payload)
        lost = 0
        while len(self.waiting) > MOST_WAITING or self.size_bytes > MOST_WAITING_BYTES:
            self.size_bytes -= len(self.waiting.popleft()[1])
            lost += 1
        return lost


class TrueLoop:
    """`prove` in turns. `taken` wraps the handlers of what the loop publishes."""

    def __init__(
        self, run_folder: Path, ask: Ask, clock: Callable[[], float], note: Callable[..., None],
        begins: Callable[[], None],
    ) -> None:  # fmt: skip
        """`begins` is called before anything of a loop that was not known before is delivered."""
        self.known: LoopShown | None = None
        self.uid: int | None = None  #: of the known loop's process
        self.record: Callable[[dict[str, object], int], Awaitable[object]] = _unrecorded
        self.untaken = 0  #: messages of processes that are not the loop
        self._run_folder = run_folder
        self._ask = ask
        self._clock = clock
        self._note = note
        self._begins = begins
        self._strangers: dict[Peer, _Stranger] = {}
        self._false: Finding | None = None
        self._false_s = float("-inf")
        self._noted: Finding | None = None
        self._no_key = ""  #: code of why there is no key to ask by, as it was told
        self._unrecorded: list[Finding] = []  #: to be put on record with the next turn
        self._on_record = Bounded(clock)
        self._asked_s = float("-inf")
        self._asking: asyncio.Task[None] | None = None

    def taken(self, deliver: Deliver) -> Deliver:
        """A handler that hands on what the line's loop publishes, and nothing else."""

        def take(payload: bytes) -> None:
            peer = PEER.get()
            if peer is None or self.is_loop(peer):
                deliver(payload)
            else:
                self._hold(peer, deliver, payload)

        return take

    @property
    def waiting_bytes(self) -> int:
        """Of all that waits for its process to show who it is."""
        return sum(stranger.size_bytes for stranger in self._strangers.values())

    def is_loop(self, peer: Peer | None) -> bool:
        """Whether the kernel names the known loop's process."""
        return self.known is not None and peer is not None and (peer.pid, peer.uid) == (self.known.pid, self.uid)

    def false_loop(self) -> list[Finding]:
        """What was found of a loop that is none, lately; empty: nothing."""
        return [self._false] if self._false is not None and self._clock() - self._false_s < TOLD_FOR_S else []

    def found_false(self, found: Finding) -> None:
        """Tell of it: in the status, and as an event, where it is another than the one before or that one is over."""
        anew = not self.false_loop() or self._noted is None or found.code != self._noted.code
        self._false, self._false_s = found, self._clock()
        if anew:
            self._noted = found
            self._note("false-loop", sentence(found), findings=[found])
            self._unrecorded = [*self._unrecorded, found][-MOST_UNRECORDED:]

    async def has_answered(self) -> bool:
        """Whether the last request of this task was answered by the loop; where it is not known yet, it is asked."""
        answered = ANSWERED.get()
        if not self.is_loop(answered):
            await self._prove()
        return self.is_loop(answered)

    async def prove(self) -> None:
        """Ask who the loop is, where it is time to. Raises nothing for what is answered."""
        if self._clock() - self._asked_s >= ASK_EVERY_S:
            await self._prove()
        self._give_up_strangers()
        while self._unrecorded:
            found = self._unrecorded[0]
            if (left_out := self._on_record.left_out(found.code)) is not None:
                try:
                    await self.record({**found.model_dump(), "because": sentence(found)}, left_out)
                except AuditUnavailable:
                    self._on_record.undo(found.code, left_out)
                    return  # with a later turn
            self._unrecorded.pop(0)

    async def close(self) -> None:
        if self._asking is not None:
            self._asking.cancel()
            await asyncio.gather(self._asking, return_exceptions=True)

    async def _prove(self) -> None:
        self._asked_s = self._clock()
        challenge = new_challenge()
        try:
            answer, peer = await self._ask(AskShown(challenge=challenge).model_dump_json().encode())
            # Only now: a loop that is asked has put its key back where it was damaged.
            shown = proven(read_key(self._run_folder), challenge, answer, peer)
        except RemoteError as error:
            self.found_false(finding("false-loop-mute", error=str(error)))
        except ServedByStranger as error:
            self.found_false(error.found)
        except Unreachable:
            return  # nobody is there: the age of its frames says so
        except NotTheLoop as error:
            self.found_false(error.found)
        except NoKey as error:  # which says nothing against the loop
            self._tell_no_key(error.found)
        else:
            self._no_key = ""
            self._know(shown, peer)

    def _tell_no_key(self, found: Finding) -> None:
        if self._no_key != found.code:
            self._no_key = found.code
            self._note("loop-key", sentence(found), findings=[found])

    def _know(self, shown: LoopShown, peer: Peer | None) -> None:
        if self.known is None or self.known.start != shown.start:
            self._begins()
        self.known, self.uid = shown, None if peer is None else peer.uid
        if peer is not None and (stranger := self._strangers.pop(peer, None)) is not None:
            for deliver, payload in stranger.waiting:
                deliver(payload)

    def _hold(self, peer: Peer, deliver: Deliver, payload: bytes) -> None:
        stranger = self._strangers.get(peer)
        if stranger is None:
            if len(self._strangers) >= MOST_STRANGERS:
                self.untaken += 1
                return
            stranger = self._strangers[peer] = _Stranger(self._clock())
        self.untaken += stranger.put(deliver, payload)
        now_s = self._clock()
        idle = self._asking is None or self._asking.done()
        if idle and now_s - self._asked_s >= ASK_AT_MOST_EVERY_S:
            self._asking = asyncio.get_running_loop().create_task(self._prove())

    def _give_up_strangers(self) -> None:
        now_s = self._clock()
        for peer, stranger in list(self._strangers.items()):
            if now_s - stranger.since_s < WAITS_S:
                continue
            del self._strangers[peer]
            self.untaken += len(stranger.waiting)
            loop_pid = 0 if self.known is None else self.known.pid
            self.found_false(
                finding("false-loop-speaks", process_pid=peer.pid, process_uid=peer.uid, loop_pid=loop_pid)
            )
