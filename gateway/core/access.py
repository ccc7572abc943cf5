"""What happens at the door by which people come in, told to the gateway, which alone writes the audit. JSON, strict."""

from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from gateway.core.audit_record import Digest
from gateway.core.line import Strict
from gateway.core.people import Person, Role, UserName

MOST_USERS = 200
MOST_PLACES = 50  #: of one report of wrong logins
MOST_NAMES = 10  #: of one place

Address = Annotated[str, Field(max_length=64)]  #: of the network; empty: it is not known
Count = Annotated[int, Field(ge=1, le=10**9)]


class CameIn(Strict):
    """Somebody has proved who they are, and has a session from now on."""

    happened: Literal["came-in"] = "came-in"
    person: Person
    address: Address
    before: Annotated[int, Field(ge=0, le=10**9)] = 0  #: others who came in before, and of whom nothing more is known


class WrongPlace(Strict):
    """From where names and passwords came that let nobody in."""

    through: Literal["opc-ua", "page"]
    address: Address
    certificate: Digest | None = None
    count: Count
    users: Annotated[list[UserName], Field(max_length=MOST_NAMES)]  #: whose names were tried, of those that there are


class WrongLogins(Strict):
    """Of about a minute."""

    happened: Literal["wrong-logins"] = "wrong-logins"
    places: Annotated[list[WrongPlace], Field(min_length=1, max_length=MOST_PLACES)]
    elsewhere: Annotated[int, Field(ge=0)]  #: further ones, from further places


class UsersNow(Strict):
    """Who may come in, and as what; told again from time to time."""

    happened: Literal["users-now"] = "users-now"
    roles: Annotated[dict[UserName, Role], Field(max_length=MOST_USERS)]
    file: Digest | None  #: SHA-256 of the users' file; null: there is none


AtTheDoor = CameIn | WrongLogins | UsersNow
AT_THE_DOOR: TypeAdapter[AtTheDoor] = TypeAdapter(Annotated[AtTheDoor, Field(discriminator="happened")])
