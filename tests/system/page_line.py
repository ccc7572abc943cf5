"""A real line with a page, and somebody at it in a real browser."""

import shutil
from pathlib import Path
from typing import Any, Self

from gateway.control.design import design_lqg, task_of
from gateway.core.controller import Controller, config_hash
from gateway.core.people import ROLES
from tests.operator.names import PASSWORD
from tests.operator.real_line import OperatorLine
from tests.system.peer import PeerFailed, Spoken

PARTS = ("line", "change", "history", "health")
#: Of the page's, the name that a visitor of each language would choose.
LANGUAGES = {"en": "en-GB", "de": "de-DE"}


class PageLine(OperatorLine):
    """Its users are called as their roles."""

    def __init__(self, folder: Path, spans: int = 3) -> None:
        super().__init__(folder, spans, {role: role for role in ROLES}, probation_s=30.0)

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
        """Raises PeerFailed where it cannot be done, within 40 s."""
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
        self.fill_in(name, password)
        self("press", "Enter")

    def fill_in(self, name: str, password: str) -> None:
        self("fill", "#login [name=name]", name)
        self("fill", "#login [name=password]", password)

    def part(self, name: str) -> None:
        """Line, change, history or health, and wait until it is seen."""
        self("part", name)
