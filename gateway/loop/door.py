"""The loop's door: what comes over its socket, and who may say it (`gateway.mailbox.rights`).

What takes the line to the safe side is taken from any local process. Everything else needs a proof that the gateway
has made, for this line, this start of the loop, this command, and one use. What is turned away is told: somebody tries.

Proofs are verified aside, in a thread that nothing else is done in, and of a process that has shown none yet only some
a second: neither a period nor the gateway waits for strangers.
"""

import os
import secrets
from collections import OrderedDict
from collections.abc import Callable, Sequence
from math import inf
from typing import Protocol

from gateway.core.finding import Finding, finding
from gateway.core.messages import (
    MAX_COMMAND,
    PACKED,
    Command,
    Deploy,
    Keep,
    MalformedMessage,
    Reply,
    RunExperiment,
    Stop,
    parse_command,
)
from gateway.core.proof import Grounds, Introduction, Proof, is_sealed, opened
from gateway.loop.aside import Aside
from gateway.mailbox.allowance import Allowance
from gateway.mailbox.keys import PublicKey
from gateway.mailbox.port import PEER, Peer
from gateway.mailbox.rights import OVERTAKES, may_be_said_by_anybody
from gateway.mailbox.seal import LineName, Numbers, why_not_addressed, why_not_claimed, why_not_signed
from gateway.wording.catalogue import sentence
from safety import actions

REFUSED = "refused-at-the-door"  #: kind of event
TRIES_PER_S = 1.0  #: proofs of one process that are looked at, until it has shown one that holds
TOLD_PER_S = 1.0  #: refusals that are told; the others are counted
MOST_PROCESSES = 256  #: that are counted apart; the one that was quiet for longest is forgotten first
UNDER_WAY_S = 1.0  #: what a stop overtakes on its way is no attempt; what comes so late after it was held back
NOBODY = Peer(-1, 0)  #: where the transport does not tell


class Behind(Protocol):
    """What is behind the door."""

    async def submit(self, command: Command, proof: Proof | None = None) -> Reply: ...

    def refused(self, text: str, reasons: Sequence[str | Finding] = ()) -> Reply: ...


class Door:
    """Of one start of a loop. `key` gives the gateway's public key; None: no gateway has made one yet."""

    def __init__(
        self,
        behind: Behind,
        of: LineName,
        key: Callable[[], PublicKey | None],
        clock: Callable[[], float],
        tell: Callable[..., None] | None = None,
        *,
        is_open: bool = True,
        period_s: float = inf,
    ) -> None:
        """`is_open`: whether the loop has started; until `open` only what anybody may say is taken. `period_s`: of the
        loop, which goes on beside whatever is read here."""
        self.nonce = secrets.token_hex(16)
        self.stopper: Peer | None = None  #: who asks for the stop that is being carried out
        self._behind = behind
        self._of = of
        self._find_key = key
        self._key: PublicKey | None = None
        self._clock = clock
        self._tell = tell
        self._numbers = Numbers()
        self._aside = Aside()
        self._gateway: Peer | None = None  #: that has shown the last proof that held
        self._tries: OrderedDict[Peer, Allowance] = OrderedDict()
        self._told = Allowance(TOLD_PER_S)
        self._untold = 0
        self._is_open = is_open
        self._period_s = period_s

    def open(self) -> None:
        """The loop has started: from now on its gateway's commands are taken."""
        self._is_open = True

    def close(self) -> None:
        """What is still being verified ends by itself."""
        self._aside.close()

    async def introduce(self, _: bytes) -> bytes:
        """To whoever asks: what a proof for this loop must name."""
        return Introduction(loop=self.nonce, pid=os.getpid()).model_dump_json().encode()

    async def command(self, payload: bytes) -> bytes:
        """Answer a command from outside. Never raises for what is in `payload`."""
        try:
            reply = await (self._of_gateway(payload) if is_sealed(payload) else self._of_anybody(payload))
        except MalformedMessage as error:
            reply = self._behind.refused(f"not a command: {error}", error.findings)
        return reply.model_dump_json().encode()

    async def _of_anybody(self, payload: bytes) -> Reply:
        if len(payload) > MAX_COMMAND or payload[:1] == PACKED:  # packed: nothing that anybody may say is so long
            return self._turn_away("what is packed", finding("no-proof", command="a packed command"))
        command = parse_command(payload)
        if not may_be_said_by_anybody(command.command):
            return self._turn_away(command.command, finding("no-proof", command=command.command))
        if command.command in OVERTAKES:
            self._numbers.note_stop(self._clock())
        return await self._submit(command, None)

    async def _submit(self, command: Command, proof: Proof | None) -> Reply:
        if not isinstance(command, Stop):
            return await self._behind.submit(command, proof)
        peer = PEER.get()
        if self.stopper is None:  # of several at once the first one stops the line
            self.stopper = peer
        try:
            return await self._behind.submit(command, proof)
        finally:
            if self.stopper is peer:
                self.stopper = None

    async def _of_gateway(self, payload: bytes) -> Reply:
        if not self._is_open:  # its devices may not be there yet; nobody has done anything wrong
            starting = finding("loop-starting")
            return self._behind.refused(sentence(starting), [starting])
        proof, content = opened(payload)
        said = proof.statement.command
        if against := self._why_not_now(proof):
            return against
        if not self._may_try():
            return self._turn_away(said, finding("too-many-proofs", most_per_s=TRIES_PER_S))
        self._key = self._key or self._find_key()
        found = await self._aside.do(lambda: self._verified(proof, content))
        if isinstance(found, Finding):
            return self._turn_away(said, found)
        # Once more: the same may have come twice while it was verified, or a stop.
        if against := self._why_not_now(proof):
            return against
        self._numbers.use(proof.statement.number)
        self._gateway = PEER.get()
        return await self._submit(found, proof)

    def _why_not_now(self, proof: Proof) -> Reply | None:
        """The refusal of a number that was used, is of another time, or was made before a stop; None: it is good."""
        said, number, now_s = proof.statement.command, proof.statement.number, self._clock()
        against = self._numbers.why_not(said, number, now_s)
        if against is None:
            return None
        if against.code == "proof-before-stop" and now_s - number * 1e-9 < UNDER_WAY_S:  # nobody has tried anything
            return self._behind.refused(sentence(against), [against])
        return self._turn_away(said, against)

    def _verified(self, proof: Proof, content: bytes) -> Finding | Command:
        """Aside. Raises MalformedMessage."""
        statement = proof.statement
        if against := why_not_addressed(statement, content, self._of, self.nonce) or why_not_signed(proof, self._key):
            return against
        command = parse_command(content, self._period_s)
        if not _is_grounded(command, statement.grounds):
            return finding("no-grounds", command=command.command)
        return why_not_claimed(statement, command) or command

    def _may_try(self) -> bool:
        peer = PEER.get() or NOBODY
        if peer in (self._gateway, NOBODY):
            return True
        allowance = self._tries.pop(peer, None) or Allowance(TRIES_PER_S)
        self._tries[peer] = allowance
        while len(self._tries) > MOST_PROCESSES:
            self._tries.popitem(last=False)
        return allowance.take(self._clock())

    def _turn_away(self, command: str, against: Finding) -> Reply:
        peer = PEER.get() or NOBODY
        if self._tell is not None:
            if self._told.take(self._clock()):
                self._say(command, against, peer)
            else:
                self._untold += 1
        return self._behind.refused(sentence(against), [against])

    def _say(self, command: str, against: Finding, peer: Peer) -> None:
        assert self._tell is not None
        untold, self._untold = self._untold, 0
        told = actions.found(
            REFUSED, actions.Action.NONE, command=command, uid=peer.uid, pid=peer.pid, because=against.code,
            left_out=untold,
        )  # fmt: skip
        self._tell(REFUSED, told.text, findings=[told], command=command, uid=peer.uid, pid=peer.pid)


def _is_grounded(command: Command, grounds: Grounds) -> bool:
    """Whether what needs a proposal, a verdict and an approval has them.

    An experiment that names no proposal is for a simulated line; any other refuses it (`Experiments.why_not`).
    """
    match command:
        case Deploy() | Keep():
            return grounds.are_complete
        case RunExperiment(proposal=str() as proposal):
            return grounds.are_complete and grounds.proposal == proposal
        case _:
            return True
