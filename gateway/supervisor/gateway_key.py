"""The gateway's key as this process has it, and what is wrong with it."""

from hashlib import sha256
from pathlib import Path
from secrets import token_bytes

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from gateway.core.finding import Finding, finding
from gateway.mailbox.keys import KeyUnusable, private_key, public_bytes, public_key


def seeds_secret(folder: Path, of: str = "verdicts") -> bytes:
    """From which the seeds of verdicts follow, as long as the gateway has its key: nobody else knows them.

    `of` something else: others, from which nobody learns how a verdict will come out.
    """
    try:
        return sha256(f"seeds of {of}".encode() + private_key(folder).private_bytes_raw()).digest()
    except KeyUnusable:
        return token_bytes()  # by which nothing is put on the line anyway


def gateway_key(site: str, line: str, folder: Path) -> tuple[Ed25519PrivateKey, Finding | None]:
    """The key, and why the loop takes nothing by it; None: it does.

    A gateway without a usable key still shows the line and stops it: it signs with one that no loop knows.
    """
    try:
        key = private_key(folder)
    except KeyUnusable as error:
        return Ed25519PrivateKey.generate(), finding("gateway-key-unusable", because=str(error))
    try:
        known = public_key(site, line, folder)
    except KeyUnusable as error:
        return key, finding("gateway-key-unusable", because=str(error))
    if known is not None and known.key.public_bytes_raw() != public_bytes(key):
        return key, finding("gateway-key-unknown", path=str(known.path))
    return key, None
