"""Whether the certificates of the agents' bus and of OPC UA can be read, fit together, and are good for a while."""

import stat
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta
from pathlib import Path

from cryptography import x509

from gateway.cli.certificates import NoCertificate, Pair, belongs, certificates_of, issued
from gateway.cli.doctor_check import Check
from gateway.core.line import Network
from gateway.files import MOST_BYTES, read_bytes
from gateway.operator.opcua.trust import CERTIFICATE, PRIVATE_KEY, TRUSTED, NotUsable, certificate_of

GROUP = "certificates"
SOON = timedelta(days=30)
_MEND = "make them with `r2rgate pki init`; until then the bus stays on this machine, and the rest runs"


def certificates(network: Network | None, now: datetime) -> Iterator[Check]:
    """Warnings at most: a line runs without agents of other machines."""
    if network is None:
        yield Check(GROUP, "network", "", "OK", "no table [network]: the agents' bus stays on this machine")
        return
    for name in ("certificate", "authority"):
        yield _certificate(name, Path(getattr(network, name)), now)
    yield from _issuer(Path(network.certificate), Path(network.authority))
    yield _private_key(Path(network.certificate), Path(network.private_key))


def opcua_certificates(pki: Path, now: datetime) -> Iterator[Check]:
    """Of the operator's OPC UA server and its clients. Warnings at most: a line runs without."""
    own = pki / CERTIFICATE
    if not own.exists():
        todo = "`r2rgate pki init` makes it; until then `r2rgate operator` does not start, and the rest runs"
        yield Check(GROUP, "OPC UA server", "", "warning", f"there is no {own}", "one", todo)
        return
    yield _certificate("OPC UA server", own, now)
    yield _private_key(own, pki / PRIVATE_KEY)
    for path in sorted((pki / TRUSTED).glob("*.der")):
        yield _certificate("OPC UA client", path, now, _of_client)


def _of_client(content: bytes) -> list[x509.Certificate]:
    """Raises NoCertificate."""
    try:
        return [certificate_of(content)]
    except NotUsable as error:
        raise NoCertificate(str(error)) from error


def _certificate(
    name: str, path: Path, now: datetime, read: Callable[[bytes], list[x509.Certificate]] = certificates_of
) -> Check:
    """The one of a file that ends first."""
    wanted = f"good for {SOON.days} days or longer"
    try:
        found = read(read_bytes(path, MOST_BYTES))
    except OSError as error:
        return Check(GROUP, name, "", "warning", f"{path} cannot be read: {error.strerror}", wanted, _MEND)
    except NoCertificate as error:
        return Check(GROUP, name, "", "warning", f"{path}: {error}", wanted, _MEND)
    until = min(one.not_valid_after_utc for one in found)
    begins = max(one.not_valid_before_utc for one in found)
    days = (until - now) / timedelta(days=1)
    if begins > now:
        measured = f"{path} is good only from {begins:%Y-%m-%d %H:%M} UTC"
        return Check(GROUP, name, "", "warning", measured, wanted, "is this computer's clock right?")
    ends = f"ended {-days:.0f} days ago" if days < 0 else f"ends in {days:.0f} days"
    measured = f"{path} {ends}, on {until:%Y-%m-%d}"
    if until - now >= SOON:
        return Check(GROUP, name, "", "OK", measured, wanted)
    todo = "move it and its key away and run `r2rgate pki init` again; then start what uses it again"
    if read is _of_client:
        todo = "make its client a new one, then `r2rgate pki trust FILE`, and remove this one"
    return Check(GROUP, name, "", "warning", measured, wanted, todo)


def _issuer(certificate: Path, authority: Path) -> Iterator[Check]:
    """Nothing where one of them cannot be read: that is told already."""
    wanted = "the authority has signed the certificate"
    try:
        fits = issued(read_bytes(certificate, MOST_BYTES), read_bytes(authority, MOST_BYTES))
    except (OSError, NoCertificate):
        return
    if fits:
        yield Check(GROUP, "issuer", "", "OK", f"{authority} has signed {certificate}", wanted)
        return
    measured = f"{certificate} is not signed by {authority}: no agent of another machine is let in"
    yield Check(GROUP, "issuer", "", "warning", measured, wanted, "name files of one `r2rgate pki init`")


def _private_key(certificate: Path, path: Path) -> Check:
    """It is the certificate's, and nobody else may read it."""
    wanted = "the certificate's, for its owner alone"
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
        fits = belongs(Pair(read_bytes(certificate, MOST_BYTES), read_bytes(path, MOST_BYTES)))
    except OSError as error:
        measured = f"{error.filename} cannot be read: {error.strerror}"
        return Check(GROUP, "private key", "", "warning", measured, wanted, _MEND)
    except NoCertificate as error:
        return Check(GROUP, "private key", "", "warning", f"{path}: {error}", wanted, _MEND)
    if not fits:
        return Check(GROUP, "private key", "", "warning", f"{path} is another certificate's", wanted, _MEND)
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        return Check(GROUP, "private key", "", "warning", f"{path} has mode {mode:o}", wanted, f"`chmod 600 {path}`")
    return Check(GROUP, "private key", "", "OK", f"{path}, mode {mode:o}", wanted)
