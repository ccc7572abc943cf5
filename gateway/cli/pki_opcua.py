"""The certificates of a line's OPC UA server and its clients: RSA, signed by themselves, trusted one by one.

Nothing is overwritten: what is there stays, and what is missing is made.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from gateway.cli.certificates import CERTIFICATE_DAYS, EARLIER, Pair
from gateway.cli.pki_bus import keep_pair, pair_there
from gateway.operator.opcua.trust import CERTIFICATE, REJECTED, TRUSTED, file_of, from_file

KEY_BITS = 2048  #: what both security policies take, and every client
SERVER = CERTIFICATE.removesuffix(".pem")  #: name of the files


@dataclass(frozen=True)
class KeptOpcUa:
    """A pair of files."""

    name: str
    pair: Pair
    uri: str  #: ApplicationUri
    made: bool  #: now; False: it was there


def keep_opcua_pki(
    folder: Path, site: str, line: str, hosts: Sequence[str], clients: Sequence[str], now: datetime
) -> list[KeptOpcUa]:
    """Make what is missing; all that there is then, the server's first. Clients made here are trusted at once.

    `hosts`: by which clients reach the server. `clients`: names, one for each. Raises PkiRefused, OSError.
    """
    kept: list[KeptOpcUa] = []
    for name, of_client in ((SERVER, False), *((f"opcua-client-{one}", True) for one in clients)):
        uri = f"urn:r2rgate:{site}:{line}" + (f":{name.removeprefix('opcua-client-')}" if of_client else "")
        there = pair_there(folder, name)
        pair = there or self_signed(name, uri, () if of_client else hosts, now)
        if there is None:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            keep_pair(folder, name, pair)
        if of_client:
            trust(folder, pair.certificate)
        kept.append(KeptOpcUa(name, pair, uri, there is None))
    (folder / TRUSTED).mkdir(parents=True, exist_ok=True, mode=0o700)
    return kept


def trust(pki: Path, content: bytes) -> Path:
    """Let a client's certificate in; `content`: DER or PEM. Raises NotUsable, OSError."""
    der = from_file(content)
    folder = pki / TRUSTED
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    path = file_of(folder, der)
    path.write_bytes(der)
    file_of(pki / REJECTED, der).unlink(missing_ok=True)
    return path


def self_signed(name: str, uri: str, hosts: Sequence[str], now: datetime) -> Pair:
    """An application's certificate as OPC 10000-6, 6.2.2 asks for."""
    key = rsa.generate_private_key(65537, KEY_BITS)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    alternatives = [x509.UniformResourceIdentifier(uri), *(_general(host) for host in hosts)]
    usages = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
    builder = (
        x509.CertificateBuilder().subject_name(subject).issuer_name(subject).public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - EARLIER).not_valid_after(now + timedelta(days=CERTIFICATE_DAYS))
        .add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_USAGE, critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )  # fmt: skip
    certificate = builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return Pair(certificate, private)


_USAGE = x509.KeyUsage(
    digital_signature=True, content_commitment=True, key_encipherment=True, data_encipherment=True,
    key_agreement=False, key_cert_sign=True, crl_sign=False, encipher_only=False, decipher_only=False,
)  # fmt: skip


def _general(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)
