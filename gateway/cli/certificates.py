"""Certificates by which the machines of a line know each other: an authority of the line's own, and what it signs.

Elliptic keys (P-256), PEM. Nothing here reads or writes files.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from ipaddress import ip_address
from typing import Literal

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

AUTHORITY_DAYS, CERTIFICATE_DAYS = 3650, 730  #: how long they are good
EARLIER = timedelta(hours=1)  #: they are good from then on: clocks of other machines may be behind

Purpose = Literal["server", "client"]


class NoCertificate(Exception):
    """Bytes that are none, or a key that is not its own; the text says which."""


@dataclass(frozen=True)
class Pair:
    """A certificate and its private key, PEM both."""

    certificate: bytes
    private_key: bytes

    @property
    def until(self) -> datetime:
        return certificate_of(self.certificate).not_valid_after_utc


class Authority:
    """Signs. `pair` is its own; raises NoCertificate where that cannot sign."""

    def __init__(self, pair: Pair) -> None:
        self.pair = pair
        self._certificate = certificate_of(pair.certificate)
        key = _key_of(pair.private_key)
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise NoCertificate(f"it has a key of another kind ({type(key).__name__}); allowed: an elliptic one")
        self._key = key
        if not belongs(pair):
            raise NoCertificate("the authority's private key is not that of its certificate")
        try:
            constraints = self._certificate.extensions.get_extension_for_class(x509.BasicConstraints).value
        except x509.ExtensionNotFound:
            raise NoCertificate("it is the certificate of no authority") from None
        if not constraints.ca:
            raise NoCertificate("it is the certificate of no authority")

    @classmethod
    def begin(cls, name: str, now: datetime) -> "Authority":
        """A new one. `name`: its common name, for people."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = _named(name)
        builder = _builder(subject, subject, key, now, AUTHORITY_DAYS)
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        builder = builder.add_extension(_usage(signs_certificates=True), critical=True)
        return cls(Pair(_pem(builder.sign(key, hashes.SHA256())), _key_pem(key)))

    def sign(self, name: str, purpose: Purpose, hosts: Sequence[str], now: datetime) -> Pair:
        """A certificate with `name` as its common name; `hosts`: names and addresses by which a server is reached."""
        key = ec.generate_private_key(ec.SECP256R1())
        usage = ExtendedKeyUsageOID.SERVER_AUTH if purpose == "server" else ExtendedKeyUsageOID.CLIENT_AUTH
        builder = _builder(_named(name), self._certificate.subject, key, now, CERTIFICATE_DAYS)
        builder = (
            builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage([usage]), critical=False)
            .add_extension(x509.SubjectAlternativeName([_general(host) for host in hosts or [name]]), critical=False)
            .add_extension(
                x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()), critical=False
            )
        )  # fmt: skip
        return Pair(_pem(builder.sign(self._key, hashes.SHA256())), _key_pem(key))


def certificate_of(pem: bytes) -> x509.Certificate:
    """The first of a file. Raises NoCertificate."""
    return certificates_of(pem)[0]


def certificates_of(pem: bytes) -> list[x509.Certificate]:
    """All of a file, at least one. Raises NoCertificate."""
    try:
        return x509.load_pem_x509_certificates(pem)
    except ValueError as error:
        raise NoCertificate(f"it holds no certificate in PEM: {error}") from error


def belongs(pair: Pair) -> bool:
    """Whether the key is that of the certificate. Raises NoCertificate."""
    return certificate_of(pair.certificate).public_key() == _key_of(pair.private_key).public_key()


def issued(certificate: bytes, authority: bytes) -> bool:
    """Whether one of the authorities has signed the certificate, by way of those that stand behind it in its file.

    Raises NoCertificate.
    """
    own, *between = certificates_of(certificate)
    for above in between:
        if _signed(own, above):
            own = above
    return any(own == one or _signed(own, one) for one in certificates_of(authority))


def _signed(certificate: x509.Certificate, issuer: x509.Certificate) -> bool:
    try:
        certificate.verify_directly_issued_by(issuer)
    except (ValueError, TypeError, InvalidSignature):  # another name; a key that signs nothing; another key
        return False
    return True


def _key_of(pem: bytes) -> PrivateKeyTypes:
    try:
        return serialization.load_pem_private_key(pem, password=None)
    except (ValueError, TypeError) as error:  # TypeError: it is locked by a password
        raise NoCertificate(f"it holds no private key in PEM that opens without a password: {error}") from error


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, now: datetime, days: int
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - EARLIER)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates, key_cert_sign=signs_certificates, crl_sign=signs_certificates,
        content_commitment=False, key_encipherment=False, data_encipherment=False, key_agreement=False,
        encipher_only=False, decipher_only=False,
    )  # fmt: skip


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _general(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
