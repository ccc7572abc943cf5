"""Who may come in through OPC UA and the page: names, roles, and what proves a password without telling it.

One file in the operator's data, for its owner's eyes only; `r2rgate users` writes it. Passwords are salted and
hashed with scrypt, which takes 32 MB and some 50 ms for a guess, and as long for a name that nobody has.
"""

import fcntl
import hashlib
import hmac
import os
import secrets
import stat
import tomllib
import unicodedata
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import Field, ValidationError
from pydantic_core import ErrorDetails

from gateway.core.line import Strict
from gateway.core.line_problem import key_in_words
from gateway.core.nearest import nearest
from gateway.core.people import Role, UserName
from gateway.core.toml_places import Path as Place
from gateway.core.toml_places import line_of, places
from gateway.core.toml_syntax import syntax_problem
from gateway.core.topics import AGENT_NAMES
from gateway.files import read_bytes

FILE_NAME, LOCK = "users.toml", "users.lock"
#: Names by which the audit calls what is no person.
RESERVED = frozenset(("anonymous", "gateway", "r2rgate", "rules", "agents", "root", "system", "nobody", *AGENT_NAMES))
MOST_USERS = 200
MOST_BYTES = 65_536  #: of the file
LEAST_LETTERS, MOST_LETTERS, LEAST_DIFFERENT = 10, 128, 5
#: What everybody tries first: no password has one of these as half of it or more.
TRIED_FIRST = (
    "password", "passwort", "kennwort", "geheim", "secret", "123456", "abcdef", "qwert", "asdf", "letmein", "welcome",
    "willkommen", "admin", "operator", "engineer", "viewer", "r2rgate",
)  # fmt: skip

_LOG2_N, _R, _P, _SALT_BYTES, _HASH_BYTES = 15, 8, 1, 16, 32
_HEX = r"^[0-9a-f]*$"


RoleOf = Callable[[str], Role | None]  #: of a name as of now; None: there is no such user, or no more


class UsersRefused(Exception):
    """The file cannot be used, or what was asked for cannot be; the text says why and what is allowed."""


class _Entry(Strict):
    name: UserName
    role: Role
    salt: Annotated[str, Field(pattern=_HEX, min_length=2 * _SALT_BYTES, max_length=2 * _SALT_BYTES)]
    scrypt: Annotated[str, Field(pattern=_HEX, min_length=2 * _HASH_BYTES, max_length=2 * _HASH_BYTES)]


class _File(Strict):
    format: Annotated[int, Field(ge=1, le=1)]
    users: Annotated[list[_Entry], Field(max_length=MOST_USERS)] = []


class User(NamedTuple):
    name: str
    role: Role


@dataclass(frozen=True)
class Users:
    """Never changed: `with_user` and `without` give others."""

    _by_name: Mapping[str, _Entry]
    digest: str | None = None  #: SHA-256 of the file they were read from; None: of none

    @classmethod
    def nobody(cls) -> "Users":
        return cls({})

    @classmethod
    def read(cls, path: Path) -> "Users":
        """Raises UsersRefused, also where others than its owner may read or write it."""
        try:
            content = read_bytes(path, MOST_BYTES)
            others = stat.S_IMODE(path.stat().st_mode) & 0o077
        except OSError as error:
            raise UsersRefused(f"{path} cannot be read: {error.strerror}") from error
        if others:
            raise UsersRefused(f"{path} is open to others than its owner: `chmod 600 {path}` mends it")
        found = _parsed(content, path)
        by_name = {one.name: one for one in found.users}
        if len(by_name) < len(found.users):
            raise UsersRefused(f"{path} has a name twice; allowed: each once")
        return cls(by_name, hashlib.sha256(content).hexdigest())

    def check(self, name: str, password: str) -> Role | None:
        """The role of who proves so to be `name`; None: nobody does. Takes some 50 ms: call it in a thread."""
        entry = self._by_name.get(name)
        salt = _NOBODYS_SALT if entry is None else entry.salt
        found = _hashed(password[:MOST_LETTERS], bytes.fromhex(salt)).hex()
        same = hmac.compare_digest(found, "" if entry is None else entry.scrypt)
        return entry.role if entry is not None and same and len(password) <= MOST_LETTERS else None

    def role_of(self, name: str) -> Role | None:
        """None: there is no such user. No proof that somebody is `name`."""
        entry = self._by_name.get(name)
        return None if entry is None else entry.role

    def entries(self) -> list[User]:
        """By name."""
        return [User(one.name, one.role) for one in sorted(self._by_name.values(), key=lambda one: one.name)]

    def with_user(self, name: str, password: str, role: Role) -> "Users":
        """With this one more, or with another password or role. Raises UsersRefused."""
        if name in RESERVED and name not in self._by_name:
            raise UsersRefused(f"{name} is what the audit calls something else; allowed: any name but "
                               f"{', '.join(sorted(RESERVED))}")  # fmt: skip
        if reason := why_weak(name, password):
            raise UsersRefused(reason)
        salt = secrets.token_bytes(_SALT_BYTES)
        try:
            entry = _Entry(name=name, role=role, salt=salt.hex(), scrypt=_hashed(password, salt).hex())
        except ValidationError:
            raise UsersRefused(
                f"{name!r} with role {role!r}: allowed are names of 1 to 32 of a-z, 0-9, dot, underscore and hyphen "
                "that begin with a letter, and the roles viewer, operator, engineer"
            ) from None
        if len(self._by_name) >= MOST_USERS and name not in self._by_name:
            raise UsersRefused(f"there are {MOST_USERS} users, which is all that is allowed: remove one first")
        return Users({**self._by_name, name: entry})

    def without(self, name: str) -> "Users":
        """Raises UsersRefused where there is no such user."""
        if name not in self._by_name:
            raise UsersRefused(f"there is no user {name}; users are: {', '.join(sorted(self._by_name)) or 'none'}")
        return Users({one: entry for one, entry in self._by_name.items() if one != name})

    def write(self, path: Path) -> None:
        """All of it or nothing, for its owner only. Raises OSError."""
        lines = ["# Written by `r2rgate users`. No password is in here, only what proves one.", "format = 1"]
        for name, entry in sorted(self._by_name.items()):
            values = {"name": name, "role": entry.role, "salt": entry.salt, "scrypt": entry.scrypt}
            lines += ["", "[[users]]", *(f'{key} = "{value}"' for key, value in values.items())]
        part = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            with os.fdopen(descriptor, "w", encoding="ascii") as stream:
                stream.write("\n".join(lines) + "\n")
                stream.flush()
                os.fsync(stream.fileno())
            part.replace(path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise


def change(path: Path, how: Callable[[Users], Users]) -> None:
    """Write what `how` makes of the users as they are now. Nobody else changes them in between.

    Raises UsersRefused, OSError, and what `how` raises; then nothing is changed.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    lock = os.open(path.with_name(LOCK), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        how(UsersFile(path).current()).write(path)  # of the last user who is removed an empty file stays
    finally:
        os.close(lock)


def _parsed(content: bytes, path: Path) -> _File:
    """Raises UsersRefused with the line of what is wrong, and never with what was entered there."""
    try:
        text = content.decode().replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise UsersRefused(f"{path}:{line}: is not UTF-8 here: save the file as UTF-8") from None
    try:
        document = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise UsersRefused(str(syntax_problem(error, text, str(path)))) from None
    try:
        return _File.model_validate(document)
    except ValidationError as error:
        where = places(text)
        raise UsersRefused("; ".join(_mistake(one, where, path) for one in error.errors()[:5])) from None


def _mistake(error: ErrorDetails, where: dict[Place, int], path: Path) -> str:
    """Where, what, and the nearest key; without the value."""
    place: Place = error["loc"]
    said = f"{path}:{line_of(where, place)}: {key_in_words(place)}: {error['msg']}"
    key = next(reversed(place), None)
    if error["type"] != "extra_forbidden" or key is None:
        return said
    known = list((_Entry if len(place) > 1 else _File).model_fields)
    near = nearest(str(key), known)
    return f"{said}; allowed: {', '.join(known)}" + (f"; did you mean {near!r}?" if near else "")


class UsersFile:
    """The users of a file, and what it said when it was looked at last, which no question about a role waits for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.known = Users.nobody()
        self.was_there = False  #: when it was looked at; from then on a file that is gone is a fault

    def current(self) -> Users:
        """As the file has them now; nobody, where there never was one. Waits for the disk; for any thread.

        Raises UsersRefused.
        """
        try:
            return Users.read(self.path)
        except UsersRefused as refused:
            if isinstance(refused.__cause__, FileNotFoundError) and not self.was_there:
                return Users.nobody()
            raise

    def keep(self, found: Users) -> None:
        """What `role_of` tells from now on: what `current` has told. For one writer, on the event loop."""
        self.known = found
        self.was_there = self.was_there or found.digest is not None

    def role_of(self, name: str) -> Role | None:
        """As the file had it when it was looked at last; None: there was no such user. Waits for nothing.

        For whoever has come in before. While the file cannot be read, or is gone as with a disk that is not mounted,
        what it said last holds: nobody new comes in then, but those at work can still stop the line.
        """
        return self.known.role_of(name)


def why_weak(name: str, password: str) -> str:
    """What is wrong with a new password, and what is allowed; empty: nothing. It never tells the password."""
    plain = password.casefold()
    allowed = f"{LEAST_LETTERS} to {MOST_LETTERS} characters; a few words in a row are good"
    if len(password) < LEAST_LETTERS:
        return f"the password has {len(password)} characters; allowed: {allowed}"
    if len(password) > MOST_LETTERS:
        return f"the password has more than {MOST_LETTERS} characters; allowed: {allowed}"
    if any(unicodedata.category(letter) == "Cc" for letter in password):
        return f"the password has control characters; allowed: {allowed}"
    if len(set(plain)) < LEAST_DIFFERENT:
        return f"the password has fewer than {LEAST_DIFFERENT} different characters; allowed: {allowed}"
    common = next((one for one in (name.casefold(), *TRIED_FIRST) if one in plain and 2 * len(one) >= len(plain)), "")
    if common:
        return f"half of the password or more is what is tried first ({common}); allowed: {allowed}"
    return ""


def _hashed(password: str, salt: bytes) -> bytes:
    """The same whether letters were typed as one character or composed of two."""
    same = unicodedata.normalize("NFC", password).encode("utf-8", "replace")
    memory = 2 * 128 * _R * 2**_LOG2_N
    return hashlib.scrypt(same, salt=salt, n=2**_LOG2_N, r=_R, p=_P, maxmem=memory, dklen=_HASH_BYTES)


_NOBODYS_SALT = bytes(_SALT_BYTES).hex()
