"""Who the agents are: the decisions of each, and the prompt under which a language model takes its part."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from gateway.core.questions import DECISIONS, Decision
from gateway.core.topics import AgentName

_HERE = Path(__file__).parent


@dataclass(frozen=True)
class Role:
    name: AgentName
    folder: str
    decides: tuple[Decision, ...]

    @property
    def prompt(self) -> str:
        """Its part, then the rules that all share."""
        return f"{self.own_words}\n{_read('.', 'rules.md')}"

    @property
    def own_words(self) -> str:
        """Its part alone."""
        return _read(self.folder, "prompt.md")


def _of(phase: str) -> tuple[Decision, ...]:
    return tuple(one for one in DECISIONS if one.startswith(f"{phase}."))


ROLES: dict[AgentName, Role] = {
    one.name: one
    for one in (
        Role("sysid", "sysid", _of("identify")),
        Role("initial-control", "initial_control", _of("design")),
        Role("adaptation", "adaptation", _of("adapt")),
        Role("monitoring", "monitoring", (*_of("monitor"), *_of("run"))),
        Role("code", "code", ()),  # it computes for the others
    )
}


@cache
def _read(folder: str, name: str) -> str:
    return (_HERE / folder / name).read_text(encoding="utf-8")
