"""People at a line: who they are, which role they have, what each role may do, and what is said in their name.

The process that people reach (OPC UA, page) knows who they are and says so; the gateway holds what is said against the
same table again, and the audit names the person, from which certificate, through which process.
"""

from typing import Annotated, Literal, get_args

from pydantic import Field, TypeAdapter

from gateway.core.alarms import AcknowledgeAlarm, ShelveAlarm
from gateway.core.audit_record import Digest
from gateway.core.decisions import Archive, Confirm, Decide, LineChanged, RollBackNow
from gateway.core.line import Strict
from gateway.core.messages import (
    AbortExperiment,
    Arm,
    Hold,
    RunExperiment,
    SelectRecipe,
    SetSpeed,
    SetTension,
    Start,
    Stop,
)

Role = Literal["viewer", "operator", "engineer"]  #: each may do all that the one before may
ROLES: tuple[Role, ...] = get_args(Role)
UserName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9._-]{0,31}$")]
SCRIPTS = "script-"  #: so begin the names of programs: nobody takes their word for a person's

Said = (
    Arm | Start | Hold | Stop | SetTension | SetSpeed | SelectRecipe | RunExperiment | AbortExperiment
    | Decide | RollBackNow | Archive | LineChanged | Confirm | AcknowledgeAlarm | ShelveAlarm
)  # fmt: skip

#: By command the least role that may say it. What is no row here nobody may say through OPC UA or the page.
LEAST: dict[str, Role] = {
    "arm": "operator",
    "start": "operator",
    "hold": "operator",
    "stop": "operator",
    "set": "operator",
    "speed": "operator",
    "recipe": "operator",
    "experiment-abort": "operator",
    "decide": "operator",
    "roll-back": "operator",
    "confirm": "operator",
    "acknowledge": "operator",
    "shelve": "operator",
    "experiment": "engineer",
    "archive": "engineer",
    "line-changed": "engineer",
}


class Person(Strict):
    """Somebody who has proved who they are."""

    name: UserName
    role: Role
    through: Literal["opc-ua", "page"]
    certificate: Digest | None = None  #: SHA-256 of the DER bytes of the client's; null: it had none

    @property
    def is_script(self) -> bool:
        return self.name.startswith(SCRIPTS)


class ForPerson(Strict):
    """What a person says, handed on by the process that has let them in."""

    person: Person
    said: Annotated[Said, Field(discriminator="command")]


FOR_PERSON: TypeAdapter[ForPerson] = TypeAdapter(ForPerson)


def may(role: Role, command: str) -> bool:
    least = LEAST.get(command)
    return least is not None and ROLES.index(role) >= ROLES.index(least)


def why_may_not(person: Person, command: str) -> str:
    """Empty: they may."""
    if may(person.role, command):
        return ""
    least = LEAST.get(command)
    if least is None:
        return f"{command} is nothing that is said through {person.through}"
    return f"{person.name} is {_a(person.role)}; {command} takes {_a(least)}"


def _a(role: Role) -> str:
    return f"an {role}" if role[0] in "aeiou" else f"a {role}"
