"""What the gateway signs before the loop changes anything for it, and how it travels with the command. Pure.

A statement says what is asked for, of which line, and of which start of its loop: so that a command that was seen once
is good for nothing, neither a second time nor at another loop. It is kept beside a configuration that the loop keeps:
what the statement says of that configuration holds for as long as there is the key.

On the wire, an envelope around the command's bytes:

octet 0      `MARK`; no command begins so
octets 1-2   length of the proof, u16 little-endian
then         the proof as JSON, then the command as `messages.command_bytes` gives it
"""

import hashlib
import struct
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, ValidationError

from gateway.core.canonical import hash_of
from gateway.core.deployment import Epoch, Hash, RecoveryPrediction, Region
from gateway.core.experiment import experiment_hash
from gateway.core.line import Strict
from gateway.core.messages import (
    Command,
    Confirmed,
    Deploy,
    Keep,
    MalformedMessage,
    Narrow,
    Renew,
    RunExperiment,
    WatchGood,
)

MARK = b"\x01"
LONGEST_PROOF = 4096  #: bytes
DOMAIN = b"r2rgate: a command to the loop, 1\n"  #: before what is signed: no other use of the key looks like it
_HEADER = struct.Struct("<BH")

Nonce = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]
Name = Annotated[str, Field(min_length=1, max_length=100)]


class Claim(Strict):
    """What a command asks for, as far as it concerns the configuration."""

    configuration: Hash | None = None  #: that is deployed
    epoch: Epoch | None = None
    region: Region | None = None  #: as far as it was judged, or goes from now on
    watch: Hash | None = None  #: of the recovery prediction (`watch_hash`)
    experiment: Hash | None = None


class Grounds(Strict):
    """By what it was allowed: hashes of the audit. A command that a person gives at a terminal has none."""

    proposal: Hash | None = None
    verdict: Hash | None = None
    approval: Hash | None = None  #: of what the record of the approval says

    @property
    def are_complete(self) -> bool:
        """Whether it was proposed, judged and approved, as far as the gateway says."""
        return None not in (self.proposal, self.verdict, self.approval)


class Statement(Strict):
    """What is signed."""

    format: Annotated[int, Field(ge=1, le=1)] = 1
    site: Name
    line: Name
    loop: Nonce  #: of its start
    number: Annotated[int, Field(ge=1, lt=2**63)]  #: once for each command; monotonic nanoseconds at which it was made
    command: Annotated[str, Field(max_length=40)]  #: its name
    content: Hash  #: SHA-256 of the command's bytes
    claim: Claim = Claim()
    grounds: Grounds = Grounds()

    def signed_bytes(self) -> bytes:
        """What the signature is of."""
        return DOMAIN + self.model_dump_json().encode()


class Proof(Strict):
    """A statement with its signature."""

    statement: Statement
    signature: Annotated[str, Field(pattern=r"^[0-9a-f]{128}$")]  #: Ed25519, in hexadecimal


class Sealed(NamedTuple):
    """An envelope that was opened; nothing of it has been verified."""

    proof: Proof
    command: bytes


class Introduction(Strict):
    """What a loop says of itself to whoever asks: a statement must name its nonce."""

    format: Literal[1] = 1
    loop: Nonce
    pid: int


def claim_of(command: Command) -> Claim:
    """What `command` asks for. Of a prediction of many spans it takes milliseconds."""
    match command:
        case Deploy():
            one = command.deployment
            watch = None if one.watch is None else watch_hash(one.watch)
            return Claim(configuration=one.hash, epoch=one.epoch, region=one.region, watch=watch)
        case Keep():
            watch = None if command.watch is None else watch_hash(command.watch)
            return Claim(epoch=command.epoch, watch=watch)
        case Renew():
            return Claim(epoch=command.epoch)
        case WatchGood():
            return Claim(watch=watch_hash(command.watch))
        case Narrow():
            return Claim(region=command.region)
        case Confirmed():
            return Claim(configuration=command.configuration)
        case RunExperiment():
            return Claim(experiment=experiment_hash(command.experiment))
        case _:
            return Claim()


def watch_hash(watch: RecoveryPrediction) -> str:
    """Of a recovery prediction: all that the loop computes it from."""
    return hash_of(watch)


def content_hash(command: bytes) -> str:
    """Of a command's bytes."""
    return hashlib.sha256(command).hexdigest()


def sealed(proof: Proof, command: bytes) -> bytes:
    """The envelope."""
    proven = proof.model_dump_json().encode()
    return _HEADER.pack(MARK[0], len(proven)) + proven + command


def is_sealed(payload: bytes) -> bool:
    """Whether `payload` says that it is an envelope."""
    return payload[:1] == MARK


def opened(payload: bytes) -> Sealed:
    """What is in an envelope. Raises MalformedMessage where it is none, or not as `sealed` writes it."""
    if len(payload) < _HEADER.size or not is_sealed(payload):
        raise MalformedMessage("an envelope is cut off")
    _, length = _HEADER.unpack_from(payload)
    proven = payload[_HEADER.size : _HEADER.size + length]
    if length > LONGEST_PROOF or len(proven) != length:
        raise MalformedMessage(f"a proof has at most {LONGEST_PROOF} bytes, this one says {length}")
    try:
        proof = Proof.model_validate_json(proven)
    except ValidationError as error:
        reasons = "; ".join(f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors())
        raise MalformedMessage(f"no proof: {reasons}"[:LONGEST_PROOF]) from error
    if proof.model_dump_json().encode() != proven:  # one way to write it, so that every byte counts
        raise MalformedMessage("a proof that is not written as this program writes it")
    return Sealed(proof, payload[_HEADER.size + length :])
