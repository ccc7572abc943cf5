"""What the Code agent is asked to compute, and what it answers. JSON. Which calls there are stands in agents/code."""

from typing import Annotated, Any, cast

from pydantic import Field

from gateway.core.line import NonNegative, Strict
from gateway.core.questions import Figure, Sentence

MOST_CALLS = 8  #: of one request
MOST_FIGURES, MOST_WORDS = 64, 40  #: of one result
By = Annotated[str, Field(min_length=1, max_length=64)]


class Computed(Strict):
    """A call, and what came of it: figures, or why there are none."""

    call: Any  #: as it was asked; of one that is too large only its beginning, as text
    number: Annotated[int, Field(ge=1, le=99)]  #: by which a later call of the same task may name it
    figures: Annotated[list[Figure], Field(max_length=MOST_FIGURES)] = []
    words: Annotated[list[Sentence], Field(max_length=MOST_WORDS)] = []  #: what was computed on what, and what it says
    refused: Annotated[list[str], Field(max_length=MOST_WORDS)] = []  #: why it was not carried out
    failed: Annotated[str, Field(max_length=600)] = ""  #: why it came to no end
    seconds: NonNegative

    @property
    def done(self) -> bool:
        return not self.refused and not self.failed

    @property
    def kind(self) -> str:
        """Which call it was, in its own words."""
        call = cast(dict[str, Any], self.call).get("call") if isinstance(self.call, dict) else None
        return call[:40] if isinstance(call, str) else "no call"


class ComputeRequest(Strict):
    """Calls, one after another; a later one may name an earlier one's controller."""

    format: Annotated[int, Field(ge=1, le=1)]
    asked_by: By
    task: Sentence  #: what it is computed for
    calls: Annotated[list[Any], Field(min_length=1, max_length=MOST_CALLS)]


class ComputeReply(Strict):
    results: list[Computed]  #: one for each call, in their order
    interaction: str = ""  #: its number in the log
