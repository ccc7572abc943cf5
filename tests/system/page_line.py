"""A real line with a page, and somebody at it in a real browser."""

import shutil
from pathlib import Path
from typing import Any, Self

import httpx

from gateway.control.design import design_lqg, task_of
from gateway.core.controller import Controller, config_hash
from gateway.core.line_file import load_line
from gateway.core.people import ROLES
from gateway.operator.users import FILE_NAME, Users
from tests.closed_loop.gate_line import GateLine
from tests.protocol.bus_support import free_port
from tests.system.peer import PeerFailed, Spoken

PASSWORD = "three old rollers"
PARTS = ("line", "change", "history", "health")
#: Of the page's, the name that a visitor of each language would choose.
LANGUAGES = {"en": "en-GB", "de": "de-DE"}


class PageLine(GateLine):
    """Its users are called as their roles."""

    def __init__(self, folder: Path, spans: int = 3) -> None:
        super().__init__(folder, spans=spans, probation_s=30.0)
        self.page = f"http://127.0.0.1:{free_port()}"
        file = folder / "line.toml"
        keys = {"page": self.page, "opc_ua": f"opc.tcp://127.0.0.1:{free_port()}"}
        rows = "".join(f'{key} = "{value}"\n' for key, value in keys.items())
        text = file.read_text(encoding="utf-8").replace("\n# opc_ua = ", f"\n{rows}# opc_ua = ")
        self.line = load_line(text, "line.toml")
        assert self.line.operator.page == self.page
        file.write_text(text, encoding="utf-8")
        self.data.mkdir(exist_ok=True)
        users = Users.nobody()
        for role in ROLES:
            users = users.with_user(role, PASSWORD, role)
        users.write(self.data / FILE_NAME)

    def __exit__(self, *error: object) -> None:
        self.children.end("operator")
        super().__exit__(*error)

    def start_operator(self) -> None:
        """And wait until the page is there."""
        self.children.start("operator", self.folder / "line.toml", *self.folders)
        self.look_on(self._there, bool, 30.0)

    @property
    def other(self) -> Controller:
        """Than the first, and as good."""
        return design_lqg(task_of(self.line))

    def waiting(self) -> str:
        """A proposal that waits; a new one, where none does."""
        listed = self.listed()
        assert listed is not None
        for one in listed.proposals:
            if one.stage == "waiting":
                return one.proposal
        runs_first = self.in_service() == config_hash(self.first)
        proposal = self.propose(self.other if runs_first else self.first, "the web is softer than it was")
        self.until(proposal, "waiting", 150.0)  # the judge has what the line and a browser leave of the processors
        return proposal

    def _there(self) -> bool:
        self.children.check()
        try:
            return httpx.get(self.page).status_code == 200
        except httpx.TransportError:
            return False


class AtPage(Spoken):
    """Somebody at a page, in Chromium: see the deeds of page_operator.js."""

    def __init__(self, log: Path) -> None:
        chromium = shutil.which("chromium")
        assert chromium is not None, "there is no chromium: `python -m tests.system.needs` installs it"
        super().__init__("page_operator.js", chromium, log=log)

    def __enter__(self) -> Self:
        super().__enter__()
        return self

    def __call__(self, deed: str, *arguments: object) -> Any:
        """Raises PeerFailed where it cannot be done, within 20 s."""
        answer = super().__call__(deed, *arguments)
        if "failed" in answer:
            raise PeerFailed(f"{deed} {arguments}: {answer['failed']}")
        return answer["came"]

    def open(self, page: str, language: str = "en", **window: Any) -> None:
        self("open", page, {"language": LANGUAGES[language], **window})

    def log_in(self, name: str, password: str = PASSWORD) -> None:
        """And wait until the line is seen."""
        self.try_log_in(name, password)
        self("see", "#picture svg")

    def try_log_in(self, name: str, password: str) -> None:
        self("fill", "#login [name=name]", name)
        self("fill", "#login [name=password]", password)
        self("press", "Enter")

    def part(self, name: str) -> None:
        """Line, change, history or health, and wait until it is seen."""
        self("part", name)
