"""The gateway's key as this process has it, and what is wrong with it."""

from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from gateway.core.finding import Finding, finding
from gateway.mailbox.keys import KeyUnusable, private_key, public_bytes, public_key


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
