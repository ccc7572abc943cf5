"""Who a client's user is: by name and password, or nobody in particular where the line's file lets such look."""

import asyncio
from collections import Counter, OrderedDict
from collections.abc import Awaitable, Callable
from typing import Any

from asyncua import ua as asyncua_ua
from asyncua.common.utils import ServiceError
from asyncua.server.internal_server import InternalServer
from pydantic import ValidationError

from gateway.core.people import Person, Role
from gateway.operator.access import Access
from gateway.operator.users import RoleOf

Check = Callable[[str, str], Awaitable[Role | None]]

ANONYMOUS = "anonymous"  #: as the audit names whoever has no name
FIRST_DELAY_S, LAST_DELAY_S = 0.25, 3.0  #: after the first wrong password of a client, and after many
MOST_CLIENTS = 500  #: whose wrong passwords are counted
MOST_NAMES = 50  #: of one client; those of further names are counted together
CHECKS = 2  #: passwords that are looked at at a time, of all clients
LONGEST = 1024  #: bytes of a password as it comes
#: How a password may be encrypted inside the channel, which is encrypted. Not with RSA 1.5, which can be made to tell.
ENCRYPTIONS = (
    None, "", "http://www.w3.org/2001/04/xmlenc#rsa-oaep", "http://opcfoundation.org/UA/security/rsa-oaep-sha2-256",
)  # fmt: skip

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ


class _Guesser:
    """A client, known by its certificate, as long as it waits for an answer."""

    def __init__(self) -> None:
        self.turn = asyncio.Lock()
        self.waiting = 0  #: those that hold it or wait for it


class Logins:
    """Each client guesses one password after the other, and ever more slowly."""

    def __init__(self, check: Check, role_of: RoleOf, anonymous_may_read: bool, access: Access | None = None) -> None:
        """`access`: is told who comes in, and who does not."""
        self._check = check
        self._access = access
        self._role_of = role_of
        self._anonymous_may_read = anonymous_may_read
        self._wrong: OrderedDict[str, Counter[str]] = OrderedDict()  #: passwords by certificate, then by name
        self._guessing: dict[str, _Guesser] = {}
        self._checks = asyncio.Semaphore(CHECKS)

    async def person(self, server: InternalServer, session: Any, token: Any, certificate: str, address: str) -> Person:
        """Raises ServiceError."""
        if isinstance(token, ua.UserNameIdentityToken):
            name, password = _plain(server, session, token)
            try:
                return await self.by_password(name, password, certificate)
            except ServiceError:
                if self._access is not None:
                    self._access.refused("opc-ua", address, certificate, name)
                raise
        if _is_nobody(token) and self._anonymous_may_read:
            return Person(name=ANONYMOUS, role="viewer", through="opc-ua", certificate=certificate)
        raise ServiceError(ua.StatusCodes.BadIdentityTokenRejected)

    def came_in(self, person: Person, address: str) -> None:
        """A session has begun."""
        if self._access is not None:
            self._access.came_in(person, address)

    def now(self, person: Person) -> Person | None:
        """Somebody who has logged in, with the role that they have now; None: they are no user any more."""
        if person.name == ANONYMOUS:
            return person if self._anonymous_may_read else None
        role = self._role_of(person.name)
        return None if role is None else person.model_copy(update={"role": role})

    async def by_password(self, name: str, password: str, certificate: str) -> Person:
        """Raises ServiceError, after a while. A client's guesses wait for each other."""
        guesser = self._guessing.setdefault(certificate, _Guesser())
        guesser.waiting += 1
        try:
            async with guesser.turn:
                async with self._checks:
                    role = await self._check(name, password)
                if role is not None:
                    self._forget(certificate, name)
                    return Person(name=name, role=role, through="opc-ua", certificate=certificate)
                await asyncio.sleep(self._delay_s(certificate, name))
        except ValidationError:  # a name that no user can have
            pass
        finally:
            guesser.waiting -= 1
            if not guesser.waiting:
                del self._guessing[certificate]
        raise ServiceError(ua.StatusCodes.BadUserAccessDenied)

    def _forget(self, certificate: str, name: str) -> None:
        """Wrong passwords of that name; those of others still count for the client."""
        found = self._wrong.get(certificate)
        if found is not None:
            del found[name]
            if not found:
                del self._wrong[certificate]

    def _delay_s(self, certificate: str, name: str) -> float:
        """After one more wrong password: by all of this client's, for whatever names."""
        found = self._wrong[certificate] = self._wrong.pop(certificate, Counter())
        found[name if name in found or len(found) < MOST_NAMES else ""] += 1
        while len(self._wrong) > MOST_CLIENTS:
            self._wrong.popitem(last=False)
        return min(FIRST_DELAY_S * 2.0 ** min(found.total() - 1, 16), LAST_DELAY_S)


def _plain(server: InternalServer, session: Any, token: Any) -> tuple[str, str]:
    """Name and password of a token. Raises ServiceError."""
    password = token.Password or b""
    if token.EncryptionAlgorithm not in ENCRYPTIONS or len(password) > LONGEST or len(token.UserName or "") > LONGEST:
        raise ServiceError(ua.StatusCodes.BadIdentityTokenInvalid)
    token.Password = password
    try:
        name, plain = server.decrypt_user_token(session, token)
    except Exception as error:  # whatever asyncua and its cryptography make of bytes that are no password
        raise ServiceError(ua.StatusCodes.BadIdentityTokenInvalid) from error
    return name or "", plain


def _is_nobody(token: Any) -> bool:
    """A token that is left out stands for no name, too (OPC 10000-4, 5.7.3)."""
    left_out = isinstance(token, ua.ExtensionObject) and token.TypeId == ua.NodeId(ua.ObjectIds.Null)
    return token is None or left_out or isinstance(token, ua.AnonymousIdentityToken)
