"""What the demonstration tells its OPC UA client, and is told by it: JSON, a line each way."""

from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from gateway.core.line import Strict


class Access(Strict):
    """Where the server is, and as whom the client comes: the first line of its input."""

    url: str
    uri: str  #: ApplicationUri of the client's certificate
    certificate: str  #: file
    private_key: str  #: file
    server_certificate: str  #: file: no other server is talked to
    user: str
    password: str


class Call(Strict):
    """A method of the line without arguments."""

    do: Literal["call"] = "call"
    method: Literal["Arm", "Start"]


class Approve(Strict):
    do: Literal["approve"] = "approve"
    proposal: str  #: hash
    comment: str


Order = Annotated[Call | Approve, Field(discriminator="do")]
ORDER: TypeAdapter[Call | Approve] = TypeAdapter(Order)


class Told(Strict):
    """What came of an order: one line of output each."""

    ok: bool
    sentence: str
    seen: str = ""  #: of a proposal: what the word was given on
