"""Who comes in to the demonstration's line: the scripted operator with its certificate, and people, where they may."""

import secrets
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from gateway.cli.demo_orders import Access
from gateway.cli.pki_opcua import keep_opcua_pki
from gateway.core.line import Line
from gateway.core.people import ROLES, SCRIPTS
from gateway.mailbox.paths import OPERATOR_DATA
from gateway.operator.opcua.trust import pki_folder
from gateway.operator.users import FILE_NAME, Users

SCRIPT = f"{SCRIPTS}operator"  #: as the audit has it: nobody shall take its word for a person's
CLIENT = "script"  #: name of its certificate
HOSTS = ("127.0.0.1", "localhost")
#: A password that is read from a terminal and typed on a page, for a line that nobody else reaches and that ends soon.
WORDS = (
    "amber", "apple", "birch", "brook", "cedar", "chalk", "cliff", "cloud", "coral", "daisy", "eagle", "ember", "fern",
    "field", "flint", "grove", "hazel", "heron", "ivory", "lemon", "linen", "maple", "moss", "north", "ocean", "olive",
    "pearl", "plum", "quartz", "raven", "river", "robin",
)  # fmt: skip


@dataclass(frozen=True)
class LetIn:
    script: Access  #: of the scripted operator
    password: str  #: of people, who come in by the names of their roles; empty: none do


def let_in(line: Line, data: Path, people: bool) -> LetIn:
    """Make certificates and users, as `r2rgate pki init` and `r2rgate users` do. Takes a second or two.

    `people`: viewer, operator and engineer, too.
    """
    own = data / OPERATOR_DATA
    pki = pki_folder(line, own)
    server, client = keep_opcua_pki(pki, line.site, line.line, HOSTS, [CLIENT], datetime.now(UTC))
    secret, password = secrets.token_urlsafe(24), "-".join(secrets.choice(WORDS) for _ in range(4)) if people else ""
    users = Users.nobody().with_user(SCRIPT, secret, "operator")
    for role in ROLES if people else ():
        users = users.with_user(role, password, role)
    users.write(own / FILE_NAME)
    access = Access(
        url=line.operator.opc_ua,
        uri=client.uri,
        certificate=str(pki / f"{client.name}.pem"),
        private_key=str(pki / f"{client.name}.key.pem"),
        server_certificate=str(pki / f"{server.name}.pem"),
        user=SCRIPT,
        password=secret,
    )
    return LetIn(access, password)
