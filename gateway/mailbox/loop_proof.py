"""How a loop shows that it is the line's loop: an answer to a challenge, made with a key that lies in the run folder.

Whoever takes the loop's socket, or speaks telemetry, looks like a loop to everybody who does not ask. So gateway and
command line ask: 32 random bytes, and the answer is good only where it was made with the key, for this challenge, by
the process that the kernel names at the other end (`SO_PEERCRED`): an answer that another process has fetched from the
true loop names that one's process. The answer has the nonce of this start of the loop, and what the loop is doing.

The loop makes the key, and puts it back where it was damaged or deleted; everybody else only reads it. It is its user's
alone: whoever reads that file can pass for the loop. The scheme is HMAC-SHA-256 over the answer without its proof.
"""

import hmac
import json
import os
import secrets
import stat
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from gateway.core.canonical import canonical_bytes
from gateway.core.finding import Finding, finding
from gateway.core.line import Strict
from gateway.files import written_beside
from gateway.mailbox.port import Peer
from gateway.mailbox.who_serves import may_serve
from gateway.wording.catalogue import sentence

KEY_FILE = "loop.key"
KEY_BYTES = 32
_CONTEXT = b"r2rgate loop, shown by 1\n"  #: no proof for one purpose is one for another

Hex = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Word = Annotated[str, Field(pattern=r"^[A-Z_]{1,20}$")]


class Unproven(Exception):
    """What `found` says, as an exception whose text is its sentence."""

    def __init__(self, found: Finding) -> None:
        super().__init__(sentence(found))
        self.found = found


class NoKey(Unproven):
    """There is no key to ask by."""


class NotTheLoop(Unproven):
    """What has answered is not the line's loop."""


class AskShown(Strict):
    """The challenge."""

    challenge: Hex


class LoopShown(Strict):
    """What the loop says of itself."""

    format: Literal[1] = 1
    challenge: Hex
    start: Hex  #: the nonce of its start: another one is another life of the loop
    pid: Annotated[int, Field(ge=1)]
    sequence: Annotated[int, Field(ge=0)]  #: of its last period
    time_s: float  #: monotonic, at which it answered
    state: Word  #: a name of LoopState
    phase: Word  #: a name of Phase
    proof: Hex


def read_key(run_folder: Path) -> bytes:
    """The key of the line's loop. Raises NoKey."""
    path = run_folder / KEY_FILE
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)  # it may be a pipe
    except OSError as error:
        raise NoKey(finding("loop-key-unreadable", path=str(path), error=str(error.strerror))) from error
    try:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode) or not may_serve(found.st_uid, run_folder) or found.st_mode & 0o077:
            mode = f"{stat.S_IMODE(found.st_mode):o}"
            raise NoKey(finding("loop-key-not-private", path=str(path), owner_uid=found.st_uid, mode=mode))
        key = os.read(descriptor, KEY_BYTES + 1)
    finally:
        os.close(descriptor)
    if len(key) != KEY_BYTES:
        raise NoKey(finding("loop-key-damaged", path=str(path), allowed_bytes=KEY_BYTES))
    return key


def make_key(run_folder: Path) -> bytes:
    """The key, made where there is none that can be used. For the loop alone, which holds its lock. Raises NoKey."""
    try:
        return read_key(run_folder)
    except NoKey:
        key = new_key()
        keep_key(run_folder, key)
        return key


def new_key() -> bytes:
    return secrets.token_bytes(KEY_BYTES)


def keep_key(run_folder: Path, key: bytes) -> None:
    """Have `key` in the run folder, where it is not: whole from its first instant. Raises NoKey."""
    with suppress(NoKey):
        if read_key(run_folder) == key:
            return
    path = run_folder / KEY_FILE
    try:
        written_beside(path, key, 0o600).replace(path)
    except OSError as error:
        raise NoKey(finding("loop-key-unreadable", path=str(path), error=str(error.strerror))) from error


def new_challenge() -> str:
    return secrets.token_hex(32)


def shown(
    key: bytes, challenge: str, start: str, pid: int, sequence: int, time_s: float, state: str, phase: str
) -> bytes:
    """The loop's answer, as bytes."""
    said: dict[str, Any] = {
        "format": 1, "challenge": challenge, "start": start, "pid": pid, "sequence": sequence, "time_s": time_s,
        "state": state, "phase": phase,
    }  # fmt: skip
    return json.dumps(said | {"proof": _proof(key, said)}).encode()


def proven(key: bytes, challenge: str, answer: bytes, peer: Peer | None) -> LoopShown:
    """What the loop has answered. `peer`: who the kernel says has answered. Raises NotTheLoop."""
    try:
        found = LoopShown.model_validate_json(answer)
    except ValidationError as error:
        raise NotTheLoop(_false("false-loop-unreadable", peer)) from error
    said = found.model_dump(exclude={"proof"})
    if not hmac.compare_digest(_proof(key, said), found.proof):
        raise NotTheLoop(_false("false-loop-key", peer))
    if not hmac.compare_digest(found.challenge, challenge):
        raise NotTheLoop(_false("false-loop-replay", peer))
    if peer is not None and peer.pid != found.pid:
        raise NotTheLoop(finding("false-loop-relay", process_pid=peer.pid, process_uid=peer.uid, loop_pid=found.pid))
    return found


def _proof(key: bytes, said: dict[str, Any]) -> str:
    return hmac.new(key, _CONTEXT + canonical_bytes(said), "sha256").hexdigest()


def _false(code: str, peer: Peer | None) -> Finding:
    pid, uid = (0, 0) if peer is None else (peer.pid, peer.uid)
    return Finding(code=code, parameters={"process_pid": pid, "process_uid": uid})
