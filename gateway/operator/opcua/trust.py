"""Whose certificates are let in: those in a folder of the line's, and no others.

trusted/   one file (DER) for each client
rejected/  the newest of those that were turned away, to be looked at and trusted by a person
"""

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from stat import S_ISREG

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.rsa import RSAPublicKey
from cryptography.hazmat.primitives.serialization import Encoding

from gateway.core.line import Line
from gateway.files import read_bytes

CERTIFICATE, PRIVATE_KEY = "opcua-server.pem", "opcua-server.key.pem"  #: files
TRUSTED, REJECTED = "trusted", "rejected"  #: folders
MOST_TRUSTED, MOST_REJECTED = 500, 20  #: files
MOST_BYTES = 8192  #: of a certificate
KEEP_S = 1.0  #: at most one certificate is kept, and told of, in this time: they are made in no time
LEAST_BITS, MOST_BITS = 2048, 4096  #: of its key; what the offered security policies allow


class NotUsable(Exception):
    """Bytes that are no certificate of an OPC UA application; the text says why."""


def pki_folder(line: Line, own: Path) -> Path:
    return own / "pki" if line.operator.pki is None else Path(line.operator.pki)


def fingerprint(der: bytes) -> str:
    """SHA-256, as the audit names a certificate."""
    return hashlib.sha256(der).hexdigest()


def first_of(chain: bytes) -> bytes:
    """The client's own of certificates that stand one behind the other. Raises NotUsable."""
    if len(chain) < 4 or chain[0] != 0x30 or chain[1] != 0x82:  # all of a sensible size begin so
        raise NotUsable("it is no certificate in DER")
    end = 4 + int.from_bytes(chain[2:4], "big")
    if end > min(len(chain), MOST_BYTES):
        raise NotUsable(f"it is cut off, or has more than {MOST_BYTES} bytes")
    return chain[:end]


def certificate_of(der: bytes) -> x509.Certificate:
    """Raises NotUsable, also for a key that the security policies do not allow."""
    try:
        found = x509.load_der_x509_certificate(der)
        key = found.public_key()
    except (ValueError, TypeError) as error:
        raise NotUsable(f"it is no certificate in DER: {error}") from error
    if not isinstance(key, RSAPublicKey) or not LEAST_BITS <= key.key_size <= MOST_BITS:
        raise NotUsable(f"its key is none of RSA with {LEAST_BITS} to {MOST_BITS} bits")
    application_uri(found)
    return found


def application_uri(certificate: x509.Certificate) -> str:
    """By which an application calls itself. Raises NotUsable."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        uris = names.get_values_for_type(x509.UniformResourceIdentifier)
    except (x509.ExtensionNotFound, ValueError):
        uris = []
    if not uris:
        raise NotUsable("it has no ApplicationUri among its subject's alternative names")
    return uris[0]


def from_file(content: bytes) -> bytes:
    """DER of a certificate, given a file in DER or PEM. Raises NotUsable."""
    if content.lstrip().startswith(b"-----BEGIN"):
        try:
            content = x509.load_pem_x509_certificate(content).public_bytes(Encoding.DER)
        except ValueError as error:
            raise NotUsable(f"it is no certificate in PEM: {error}") from error
    der = first_of(content)
    certificate_of(der)
    return der


def file_of(folder: Path, der: bytes) -> Path:
    return folder / f"{fingerprint(der)[:32]}.der"


@dataclass(frozen=True)
class _File:
    stamp: tuple[int, int, int]  #: another one: it has to be read anew
    der: bytes  #: empty: it lets nobody in
    unreadable: bool = False


_NOTHING = _File((0, 0, 0), b"")


class TrustList:
    """Certificates are held against what `look` has read last: nobody waits for a disk because a client comes."""

    def __init__(self, pki: Path, tell: Callable[[str], None], now: Callable[[], datetime]) -> None:
        self._trusted, self._rejected = pki / TRUSTED, pki / REJECTED
        self._tell = tell
        self._now = now
        self._next_s = time.monotonic()
        self._files: dict[Path, _File] = {}
        self._trouble = ""  #: why the folder cannot be listed, as it was told
        self._held: frozenset[bytes] = frozenset()  #: by content: a file's name proves nothing
        self._stranger: bytes | None = None  #: to be kept in the folder of the rejected

    def holds(self, der: bytes) -> bool:
        """It is trusted, whether it is good now or not."""
        return der in self._held

    def why_not(self, der: bytes) -> str:
        """Empty: the certificate is trusted, and good now."""
        try:
            certificate = certificate_of(der)
        except NotUsable as error:
            return str(error)
        if not self.holds(der):
            if self._stranger is None and self._may_say():
                self._stranger = der
            return "it is not trusted"
        now = self._now()
        if not certificate.not_valid_before_utc <= now <= certificate.not_valid_after_utc:
            if self._may_say():  # anybody can show somebody's certificate, though only they can use it
                self._tell(
                    f"the trusted certificate {_told(der, certificate)} is out of date: its client stays outside"
                )
            return "it is out of date"
        return ""

    def look(self) -> None:
        """Read what is trusted now, and keep who was turned away. Waits for the disk; one at a time.

        While the folder cannot be listed, what it held last holds. Raises OSError where who was turned away cannot be
        kept; the next one is tried again.
        """
        try:
            paths = sorted(one for one in self._trusted.iterdir() if one.suffix == ".der")[:MOST_TRUSTED]
        except OSError as error:
            if not isinstance(error, FileNotFoundError) or self._files:
                self._cannot_list(error)
                return
            paths = []  # nobody was ever trusted
        self._trouble = ""
        before = self._files
        self._files = {path: self._read(path, before.get(path, _NOTHING)) for path in paths}
        self._held = frozenset(one.der for one in self._files.values() if one.der)
        self._keep_stranger()

    def _cannot_list(self, error: OSError) -> None:
        if self._trouble != str(error):
            self._tell(
                f"{self._trusted} cannot be listed: {error.strerror}. Whoever was trusted stays so, and nobody can be "
                "let in or out until it can: is its disk there, and may this user read it?"
            )
        self._trouble = str(error)

    def _keep_stranger(self) -> None:
        stranger, self._stranger = self._stranger, None
        if stranger is not None and stranger not in self._held:  # somebody may have trusted it meanwhile
            self._keep(stranger)

    def _may_say(self) -> bool:
        """Now and then: neither the disk nor the log is for strangers to fill."""
        if time.monotonic() < self._next_s:
            return False
        self._next_s = time.monotonic() + KEEP_S
        return True

    def _read(self, path: Path, before: _File) -> _File:
        """While a file cannot be read, what it held last holds; it keeps nobody else out."""
        try:
            found = path.stat()
            stamp = found.st_ino, found.st_size, found.st_ctime_ns
            if before.stamp == stamp:
                return before
            usable = S_ISREG(found.st_mode) and found.st_size <= MOST_BYTES
            der = read_bytes(path, MOST_BYTES) if usable else b""
            self._say_whether_good(path, der)
            return _File(stamp, der)
        except OSError as error:
            if isinstance(error, FileNotFoundError) and not path.is_symlink():
                return _NOTHING
            if not before.unreadable:
                holds = "what it held last holds" if before.der else "it lets nobody in"
                self._tell(f"{path} cannot be read, and {holds}: {error.strerror}")
            return _File((0, 0, 0), before.der, unreadable=True)

    def _say_whether_good(self, path: Path, der: bytes) -> None:
        """Once, when it is new: a file that is no certificate lets nobody in, and keeps nobody else out."""
        try:
            certificate_of(der)
        except NotUsable as error:
            why = str(error) if der else f"it is no file of 1 to {MOST_BYTES} bytes"
            self._tell(f"{path} lets nobody in: {why}")

    def _keep(self, der: bytes) -> None:
        """Beside the newest others; told once as long as it lies there."""
        path = file_of(self._rejected, der)
        if path.exists():
            return
        self._rejected.mkdir(mode=0o700, parents=True, exist_ok=True)
        older = sorted(self._rejected.glob("*.der"), key=lambda one: one.stat().st_mtime)
        for one in older[: max(0, len(older) + 1 - MOST_REJECTED)]:
            one.unlink(missing_ok=True)
        path.write_bytes(der)
        self._tell(
            f"the unknown certificate {_told(der, certificate_of(der))} was turned away; if it is who it says it is: "
            f"r2rgate pki trust {path} --line LINE.toml"
        )


def _told(der: bytes, certificate: x509.Certificate) -> str:
    return f"{application_uri(certificate)[:120]!r} (SHA-256 {fingerprint(der)[:16]}...)"
