"""A change of how a line is controlled, as a reader follows it: in the demonstration's report and in that of a line."""

from collections.abc import Sequence
from dataclasses import dataclass

from gateway.cli.report import Story
from gateway.core.verdict import Verdict


@dataclass(frozen=True)
class Adaptation:
    """Each part is a sentence or several; what there is nothing to say of is left out."""

    title: str
    diagnosis: Sequence[str] = ()  #: what led to it
    tried: Sequence[str] = ()  #: before it
    change: Sequence[str] = ()  #: in words and numbers
    verdict: Sequence[str] = ()
    decision: Sequence[str] = ()  #: who, when, over what
    on_the_line: Sequence[str] = ()
    result: Sequence[str] = ()
    lead: str = ""  #: whose words follow
    quote: str = ""  #: the reason, in somebody's own words
    judged: Verdict | None = None


PARTS = (
    ("Diagnosis", "diagnosis"), ("Tried before", "tried"), ("Change", "change"), ("Verdict", "verdict"),
    ("Decision", "decision"), ("On the line", "on_the_line"), ("Result", "result"),
)  # fmt: skip


def adaptation_story(one: Adaptation) -> Story:
    """The parts that there are, then the words of who chose it, then the verdict with every rule."""
    facts = tuple((name, tuple(texts)) for name, part in PARTS if (texts := getattr(one, part)))
    return Story(one.title, facts=facts, lead=one.lead, quote=one.quote, verdict=one.judged)
