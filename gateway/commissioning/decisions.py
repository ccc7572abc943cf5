"""Who decides what the phases leave to judgement. One interface, for the rules and for agents.

A decision is made by whoever is asked, within what the question offers; what comes of it is proposed under their name
and judged like anything else. Blocking: the phases ask from a thread that may wait.
"""

from dataclasses import dataclass
from typing import Protocol

from gateway.core.questions import Choice, Question, usual_choice

RULES, AGENTS = "rules", "agents"  #: authors of proposals


@dataclass(frozen=True)
class Decided:
    choice: Choice
    by: str  #: "rules", or the agent's name
    instead: str = ""  #: why the rules have decided though somebody else was asked; empty: nobody was
    interaction: str = ""  #: its id in the agents' log; empty: there is none

    @property
    def author(self) -> str:
        """Of the proposal that follows."""
        return RULES if self.by == RULES else AGENTS


class Decider(Protocol):
    def decide(self, question: Question) -> Decided:
        """Always a choice that answers the question; an agent that fails is the decider's own to deal with."""
        ...


class Rules:
    """`Decider`: what the rules choose."""

    def decide(self, question: Question) -> Decided:
        return Decided(usual_choice(question), RULES)
