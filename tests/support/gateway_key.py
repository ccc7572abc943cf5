"""A gateway's key for tests, the same in every process, and proofs by it; they are made as a gateway makes them."""

import time
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from gateway.core.controller import Controller, config_hash
from gateway.core.deployment import Deployment, Region
from gateway.core.line import Line
from gateway.core.messages import Command, Deploy, Reply, WatchGood, command_bytes
from gateway.core.proof import Grounds, Proof
from gateway.core.topics import LOOP_COMMAND, LOOP_HELLO
from gateway.loop.door import Behind, Door
from gateway.loop.kept import Durable, Store
from gateway.mailbox.keys import PublicKey, private_key
from gateway.mailbox.paths import GATEWAY_DATA
from gateway.mailbox.port import Mailbox
from gateway.mailbox.seal import LineName, Signer
from gateway.mailbox.to_loop import ToLoop
from gateway.mailbox.unix import UnixMailbox

KEY = Ed25519PrivateKey.from_private_bytes(sha256(b"the gateway of a test").digest())
PUBLIC = PublicKey(KEY.public_key(), Path("made by a test"))
GROUNDS = Grounds(proposal="a" * 64, verdict="b" * 64, approval="c" * 64)  #: as of one that was judged and approved
LOOP = "5" * 32  #: of a loop that is no more


def name_of(line: Line) -> LineName:
    return LineName(line.site, line.line)


def proof_of(command: Command, line: Line, key: Ed25519PrivateKey = KEY) -> Proof:
    """That the gateway has once asked for it."""
    return Signer(key, name_of(line)).proof(command, command_bytes(command), LOOP)


def door_of(runner: Behind, line: Line, clock: Callable[[], float], tell: Callable[..., None] | None = None) -> Door:
    """Of a loop that knows this gateway. To be closed."""
    return Door(runner, name_of(line), lambda: PUBLIC, clock, tell)


def signer_of(line: Line, clock: Callable[[], float], key: Ed25519PrivateKey = KEY) -> Signer:
    return Signer(key, name_of(line), clock)


def to_loop_over(mailbox: Mailbox, line: Line, clock: Callable[[], float] = time.monotonic) -> ToLoop:
    """A gateway's way to the loop that answers there."""
    return ToLoop(mailbox, signer_of(line, clock))


async def as_gateway(socket: Path, line: Line, data: Path, command: Command, timeout_s: float = 20.0) -> Reply:
    """The loop's answer to a command that is signed by the key of the line's own gateway, which lies in `data`."""
    mailbox = UnixMailbox()
    mailbox.connect({LOOP_COMMAND, LOOP_HELLO}, socket)
    try:
        return await ToLoop(mailbox, Signer(private_key(data / GATEWAY_DATA), name_of(line))).tell(
            command, timeout_s, GROUNDS
        )
    finally:
        await mailbox.close()


def store_of(folder: Path, given: Controller) -> Store:
    """Of a loop that knows this gateway."""
    return Store(folder, given, PUBLIC)


def proven(durable: Durable, line: Line) -> Durable:
    """`durable`, as it is where the gateway has brought all of it."""
    top, watch = durable.on_top, durable.watch
    return replace(
        durable,
        proof=_deployed(durable.controller, durable.region, line),
        on_top=None if top is None else top.model_copy(update={"proof": _deployed(top.controller, top.region, line)}),
        watch_proof=None if watch is None else proof_of(WatchGood(watch=watch), line),
    )


def _deployed(controller: Controller, region: Region, line: Line) -> Proof:
    hash_ = config_hash(controller)
    return proof_of(
        Deploy(deployment=Deployment(controller=controller, hash=hash_, epoch=1, lease_s=5.0, region=region)), line
    )
