"""A line in its processes with `r2rgate operator` in front of it, set up with the commands as somebody would do it."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from gateway.core.line import Operator
from gateway.core.messages import Arm, Start
from gateway.mailbox.paths import OPERATOR_DATA
from gateway.supervisor.audit_file import AuditFile
from gateway.supervisor.peers import GATEWAY
from tests.closed_loop.gate_line import GateLine
from tests.closed_loop.wire import at_rest, settled
from tests.operator.names import PANEL, PASSWORD, STRANGER, USERS
from tests.support.patience import PATIENCE_S
from tests.support.ports import free_port

LOOK_S = 0.05
DOOR = ("logged-in", "wrong-logins", "users")  #: records of who comes in


class OperatorLine(GateLine):
    """`pki` and users are made when it is; `operate` starts the operator's process."""

    def __init__(
        self, folder: Path, spans: int = 6, users: Mapping[str, str] = USERS, probation_s: float = 5.5
    ) -> None:
        """`users`: the role of each, by name."""
        super().__init__(folder, spans=spans, probation_s=probation_s)
        self.endpoint, self.page = f"opc.tcp://127.0.0.1:{free_port()}", f"http://127.0.0.1:{free_port()}"
        usually, text = Operator(), (folder / "line.toml").read_text(encoding="utf-8")
        for key, usual, free in (("opc_ua", usually.opc_ua, self.endpoint), ("page", usually.page, self.page)):
            row = f'# {key} = "{usual}"'
            assert row in text, f"the template has no {row} any more"
            text = text.replace(row, f'{key} = "{free}"')
        (folder / "line.toml").write_text(text, encoding="utf-8")
        self.make_certificate(PANEL, self.data)
        for name, role in users.items():
            self._said("users", "add", folder / "line.toml", name, "--role", role, "--data-dir", self.data)

    def __exit__(self, *error: object) -> None:
        self.children.end("operator")
        super().__exit__(*error)

    @property
    def pki(self) -> Path:
        return self.data / OPERATOR_DATA / "pki"

    def make_certificate(self, client: str, data: Path) -> None:
        """Of a client, trusted by the server whose data these are."""
        file, bus = self.folder / "line.toml", self.folder / f"{client}-bus"
        self._said("pki", "init", "--line", file, "--client", client, "--data-dir", data, "--out", bus)

    def make_stranger(self) -> None:
        """Certificate and key of a client like the other, beside it, that nobody has trusted."""
        elsewhere = self.folder / "elsewhere"
        self.make_certificate(STRANGER, elsewhere)
        for ending in ("pem", "key.pem"):
            name = f"opcua-client-{STRANGER}.{ending}"
            (self.pki / name).write_bytes((elsewhere / OPERATOR_DATA / "pki" / name).read_bytes())

    def fingerprint(self, client: str) -> str:
        """SHA-256 of the certificate's DER bytes."""
        pem = (self.pki / f"opcua-client-{client}.pem").read_bytes()
        return sha256(x509.load_pem_x509_certificate(pem).public_bytes(Encoding.DER)).hexdigest()

    def operate(self) -> None:
        """Start the operator's process, and wait until it serves."""
        self.children.start("operator", self.folder / "line.toml", *self.folders)
        deadline_s = time.monotonic() + 60.0
        while f"OPC UA at {self.endpoint}" not in self.children.log("operator").read_text(encoding="utf-8"):
            self.children.check()
            assert time.monotonic() < deadline_s, self.children.log("operator").read_text(encoding="utf-8")
            time.sleep(LOOK_S)

    def run_again(self) -> None:
        """It runs at its first recipe, also where this machine has stalled since, and it has stopped as it must."""
        for _ in range(3):
            if settled(self.wait(lambda status: settled(status) or at_rest(status))):
                return
            assert self.order(Arm()).ok
            assert self.order(Start()).ok
        raise AssertionError("this machine stalls too often for a line in real time")

    def records(self) -> list[Any]:
        """Of the audit."""
        with AuditFile(self.gateway_data) as file:
            return [row.record() for row in file.rows()]

    @contextmanager
    def unchanged(self, *kinds: str) -> Iterator[None]:
        """Nothing happens to the line within, and of what people have asked for the audit gets `kinds` alone."""
        before, records = self._as_it_is(), len(self.records())
        yield
        assert (now := self._as_it_is()) == before, (before, now)
        told = [one.kind for one in self.records()[records:] if one.who.name != GATEWAY.name and one.kind not in DOOR]
        assert sorted(told) == sorted(kinds), told

    def _as_it_is(self) -> tuple[object, ...]:
        status, runs = self.status(), self.configuration()
        assert status is not None
        setpoints = [span.setpoint_n for span in status.spans]
        return runs.hash, runs.epoch, status.loop.state, setpoints, status.speed_setpoint_m_per_s

    @staticmethod
    def _said(*words: str | Path) -> None:
        """A command of `r2rgate`, with a password for whoever asks for one."""
        done = subprocess.run(
            [sys.executable, "-m", "gateway.cli", *words], input=f"{PASSWORD}\n", capture_output=True, text=True,
            timeout=60, check=False,
        )  # fmt: skip
        assert done.returncode == 0, (done.stdout, done.stderr)


def until(look: Callable[[], Any], enough: Callable[[Any], object], within_s: float = PATIENCE_S) -> Any:
    deadline_s = time.monotonic() + within_s
    while not enough(found := look()):
        assert time.monotonic() < deadline_s, str(found)[:2000]
        time.sleep(LOOK_S)
    return found
