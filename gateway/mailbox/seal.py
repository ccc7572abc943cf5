"""Commands of the gateway, signed for one loop and one use; and what the loop finds of a proof that comes to it."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from gateway.core.finding import Finding, finding
from gateway.core.messages import Command, command_bytes
from gateway.core.proof import Grounds, Proof, Statement, claim_of, content_hash, sealed
from gateway.mailbox.keys import PublicKey
from gateway.mailbox.rights import OVERTAKEN

STALE_S = 10.0  #: a command that has been under way for longer is not carried out any more
#: The same of what sets the line in motion: whoever gave it looks at the line now, not at what it will be. Beside the
#: worst flood that was tried one is under way for 0.4 s; this leaves as much again for a computer that is busy.
MOTION_STALE_S = 1.0
AHEAD_S = 1.0  #: nor one from the future: two clocks of one machine are the same
REMEMBERED = 4096  #: numbers that were used; what is older than all of them counts as used


@dataclass(frozen=True)
class LineName:
    """Which line."""

    site: str
    line: str


class Signer:
    """Of one gateway process, from any of its threads."""

    def __init__(self, key: Ed25519PrivateKey, of: LineName, clock: Callable[[], float] = time.monotonic) -> None:
        self._key = key
        self._of = of
        self._clock = clock
        self._last = 0
        self._numbering = Lock()  #: what is long is signed in a thread

    def sealed(self, command: Command, loop: str, grounds: Grounds | None = None) -> bytes:
        """`command` for the start of a loop that has the nonce `loop`."""
        content = command_bytes(command)
        return sealed(self.proof(command, content, loop, grounds), content)

    def proof(self, command: Command, content: bytes, loop: str, grounds: Grounds | None = None) -> Proof:
        """That the gateway asks for `command`, whose bytes are `content`."""
        with self._numbering:
            number = self._last = max(self._last + 1, round(self._clock() * 1e9))
        statement = Statement(
            site=self._of.site, line=self._of.line, loop=loop, number=number, command=command.command,
            content=content_hash(content), claim=claim_of(command), grounds=grounds or Grounds(),
        )  # fmt: skip
        return Proof(statement=statement, signature=self._key.sign(statement.signed_bytes()).hex())


class Numbers:
    """Those that were used, so that none is used twice. Pure, time passed in."""

    def __init__(self) -> None:
        self._used: set[int] = set()
        self._least = 0  #: this and what is less counts as used
        self._stopped = 0  #: when the line was stopped or held last, as a number

    def note_stop(self, now_s: float) -> None:
        """The line is stopped or held now (monotonic): what was signed before sets it in motion no more."""
        self._stopped = max(self._stopped, round(now_s * 1e9))

    def why_not(self, command: str, number: int, now_s: float) -> Finding | None:
        """What speaks against `command` with this number now (monotonic); None: nothing."""
        age_s = now_s - number * 1e-9
        if command in OVERTAKEN and number < self._stopped:
            return finding("proof-before-stop", command=command, age_s=age_s)
        if number <= self._least or number in self._used:
            return finding("proof-used-before", age_s=age_s)
        most_s = MOTION_STALE_S if command in OVERTAKEN else STALE_S
        if not -AHEAD_S <= age_s <= most_s:
            return finding("proof-of-another-time", age_s=age_s, most_s=most_s)
        return None

    def use(self, number: int) -> None:
        self._used.add(number)
        if len(self._used) > REMEMBERED:
            self._least = sorted(self._used)[REMEMBERED // 2]
            self._used = {one for one in self._used if one > self._least}


def why_not_addressed(statement: Statement, content: bytes, of: LineName, loop: str) -> Finding | None:
    """What speaks against a statement before its signature is looked at; None: nothing."""
    if (statement.site, statement.line) != (of.site, of.line):
        return finding("proof-of-another-line", line=f"{statement.site}/{statement.line}", here=f"{of.site}/{of.line}")
    if statement.loop != loop:
        return finding("proof-of-another-loop", loop=statement.loop[:12], here=loop[:12])
    if statement.content != content_hash(content):
        return finding("proof-of-another-command", command=statement.command)
    return None


def why_not_signed(proof: Proof, key: PublicKey | None) -> Finding | None:
    """What speaks against the signature; None: the gateway has made it."""
    if key is None:
        return finding("no-gateway-key")
    if not key.verifies(proof.signature, proof.statement.signed_bytes()):
        return finding("proof-not-signed", line=f"{proof.statement.site}/{proof.statement.line}")
    return None


def why_not_claimed(statement: Statement, command: Command) -> Finding | None:
    """What speaks against a statement beside the command that it came with; None: it says what the command does."""
    if statement.command != command.command or statement.claim != claim_of(command):
        return finding("proof-of-another-command", command=command.command)
    return None
