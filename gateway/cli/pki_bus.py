"""The certificates of a line's bus in a folder: of authority, gateway, agents. Nothing is overwritten.

What is there stays as it is, so that the same command adds an agent, or signs anew what was moved away.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from gateway.cli.certificates import Authority, NoCertificate, Pair, Purpose
from gateway.files import MOST_BYTES, read_bytes

AUTHORITY, GATEWAY = "authority", "gateway"  #: names of files


class PkiRefused(Exception):
    """Nothing was written; the text says why, and what to do."""


@dataclass(frozen=True)
class Kept:
    """A pair of files."""

    name: str
    pair: Pair
    made: bool  #: now; False: it was there


def keep_bus_pki(
    folder: Path, line_name: str, hosts: Sequence[str], agents: Sequence[str], now: datetime
) -> list[Kept]:
    """Make what is missing; all that there is then, the authority first. Raises PkiRefused, OSError.

    `hosts`: by which agents reach the gateway. `agents`: common names, one for each agents' process.
    """
    wanted: list[tuple[str, Purpose, Sequence[str]]] = [(GATEWAY, "server", hosts)]
    for name in agents:
        wanted.append((name, "client", ()))
    there = {name: pair_there(folder, name) for name in (AUTHORITY, *(name for name, _, _ in wanted))}
    if all(there.values()):
        names = ", ".join(f"{name}.pem" for name in there)
        raise PkiRefused(f"{folder} has {names} already, which were left as they are: {how_to_renew()}")
    authority = _authority(folder, there[AUTHORITY], line_name, now)
    if authority.pair.until <= now:
        raise PkiRefused(
            f"the authority {folder / AUTHORITY}.pem ended on {authority.pair.until:%Y-%m-%d}: choose another --out, "
            "and give every machine of the bus its new files"
        )
    found = [Kept(AUTHORITY, authority.pair, there[AUTHORITY] is None)]
    for name, purpose, reached in wanted:
        pair = there[name]
        found.append(Kept(name, pair or authority.sign(name, purpose, reached, now), pair is None))
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    for one in found:
        if one.made:
            keep_pair(folder, one.name, one.pair)
    return found


def how_to_renew() -> str:
    return (
        "to renew one, move NAME.pem and NAME.key.pem away and run the same command again: the same authority signs "
        "it, and nothing else changes"
    )


def keep_pair(folder: Path, name: str, pair: Pair) -> None:
    """Raises OSError, also where one of the files is there."""
    _write(folder / f"{name}.key.pem", pair.private_key)
    _write(folder / f"{name}.pem", pair.certificate)


def pair_there(folder: Path, name: str) -> Pair | None:
    """None: neither file is there. Raises PkiRefused where only one is, or what is there is no pair."""
    certificate, key = folder / f"{name}.pem", folder / f"{name}.key.pem"
    found = [path for path in (certificate, key) if path.exists()]
    if not found:
        return None
    if len(found) == 1:
        raise PkiRefused(f"{found[0]} is there without the other of its pair: bring that back, or move it away")
    pair = Pair(read_bytes(certificate, MOST_BYTES), read_bytes(key, MOST_BYTES))
    try:
        _ = pair.until
    except NoCertificate as error:
        raise PkiRefused(f"{certificate} is no certificate, and was left as it is: {error}") from error
    return pair


def _authority(folder: Path, pair: Pair | None, line_name: str, now: datetime) -> Authority:
    if pair is None:
        return Authority.begin(f"r2rgate {line_name}"[:64], now)
    try:
        return Authority(pair)
    except NoCertificate as error:
        raise PkiRefused(f"{folder / AUTHORITY}.pem cannot sign: {error}") from error


def _write(path: Path, content: bytes) -> None:
    """For its owner alone; never over anything."""
    number = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    with os.fdopen(number, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
