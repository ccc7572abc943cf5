"""Where the gateway's key lies: the private one for its user alone, the public one for the loop.

The private key is made at the gateway's first start, in the folder of the line's data. The loop goes by the public key
in `/etc/r2rgate/keys` where there is one, which only root can write; else by the one beside the private key, which is
worth as much as the rights of that folder (docs/security.md).
"""

import os
import stat
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from gateway.files import read_bytes, written_beside

FOLDER = "keys"
PRIVATE = "gateway.key"
PUBLIC = "gateway.pub"
INSTALLED = Path("/etc/r2rgate/keys")  #: SITE_LINE.pub in it, by root; no name has an underscore
_HEX = 64


class KeyUnusable(Exception):
    """A key that is not used; the text says why and what to do."""


@dataclass(frozen=True)
class PublicKey:
    """By which the loop knows its gateway."""

    key: Ed25519PublicKey
    path: Path

    def verifies(self, signature: str, signed: bytes) -> bool:
        """Whether `signature`, in hexadecimal, is of `signed` and by this key. Takes about 0.1 ms."""
        try:
            self.key.verify(bytes.fromhex(signature), signed)
        except (InvalidSignature, ValueError):
            return False
        return True


def private_key(folder: Path) -> Ed25519PrivateKey:
    """The gateway's key in the data folder, made where there is none yet. Raises KeyUnusable."""
    path = folder / FOLDER / PRIVATE
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not path.exists():
            _begin(path)
        key = Ed25519PrivateKey.from_private_bytes(_read(path, _why_not_private))
        _tell_public(path.with_name(PUBLIC), key)
    except OSError as error:
        raise KeyUnusable(f"the gateway's key {path} cannot be used: {error.strerror or error}") from error
    return key


def existing_private_key(folder: Path) -> Ed25519PrivateKey | None:
    """The gateway's key where there is one that this user may read; nothing is made. Raises KeyUnusable."""
    try:
        return Ed25519PrivateKey.from_private_bytes(_read(folder / FOLDER / PRIVATE, _why_not_private))
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return None
    except OSError as error:
        raise KeyUnusable(f"the gateway's key cannot be read: {error.strerror or error}") from error


def public_key(site: str, line: str, folder: Path, installed: Path = INSTALLED) -> PublicKey | None:
    """By what the loop of a line knows its gateway; None: no gateway has made a key yet. Raises KeyUnusable.

    One that root has installed goes before the one in the data folder, and is never passed over for it.
    """
    first = installed / f"{site}_{line}.pub"
    for path, why_not in ((first, _why_not_installed), (folder / FOLDER / PUBLIC, _why_not_public)):
        try:
            return PublicKey(Ed25519PublicKey.from_public_bytes(_read(path, why_not)), path)
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError as error:
            raise KeyUnusable(f"the gateway's public key {path} cannot be read: {error.strerror or error}") from error
    return None


def public_bytes(key: Ed25519PrivateKey) -> bytes:
    """What a public key is known by."""
    return key.public_key().public_bytes_raw()


def _begin(path: Path) -> None:
    """All of it or nothing, and the first of two that try it at once."""
    beside = written_beside(path, Ed25519PrivateKey.generate().private_bytes_raw().hex().encode() + b"\n", 0o600)
    try:
        with suppress(FileExistsError):
            os.link(beside, path)
    finally:
        beside.unlink()


def _tell_public(path: Path, key: Ed25519PrivateKey) -> None:
    content = public_bytes(key).hex().encode() + b"\n"
    with suppress(OSError):  # what is no file there is replaced by one
        if read_bytes(path, len(content)) == content:
            return
    written_beside(path, content, 0o644).replace(path)


def _read(path: Path, why_not: Callable[[os.stat_result], str]) -> bytes:
    """The 32 bytes of a key. Raises KeyUnusable and OSError."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        found = os.fstat(descriptor)
        if reason := why_not(found) if stat.S_ISREG(found.st_mode) else "it is no file":
            raise KeyUnusable(f"{path} is not used: {reason}")
        content = os.read(descriptor, _HEX + 2).strip()
    finally:
        os.close(descriptor)
    try:
        if len(content) != _HEX:
            raise ValueError
        return bytes.fromhex(content.decode("ascii"))
    except ValueError:
        raise KeyUnusable(
            f"{path} is no key of 32 bytes in hexadecimal: move it away, and the gateway makes one anew"
        ) from None


def _why_not_private(found: os.stat_result) -> str:
    if found.st_uid not in (os.geteuid(), 0):
        return f"it belongs to user {found.st_uid}; allowed: the gateway's own user"
    if found.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        return f"others may read or write it (mode {stat.S_IMODE(found.st_mode):o}): `chmod 600` it"
    return ""


def _why_not_public(found: os.stat_result) -> str:
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"others may write it (mode {stat.S_IMODE(found.st_mode):o}): `chmod 644` it"
    return ""


def _why_not_installed(found: os.stat_result) -> str:
    if found.st_uid != 0:
        return f"it belongs to user {found.st_uid}; allowed: root alone"
    return _why_not_public(found)
