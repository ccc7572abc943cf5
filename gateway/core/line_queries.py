"""What agents may ask of the line, and what they are told: models, controllers, recordings, knowledge. JSON, strict.

They look; nothing here changes anything. What is refused comes back as a `Reply` in the place of what was asked for.
"""

from typing import Annotated, Any, TypeVar

from pydantic import Field, ValidationError

from gateway.core.controller import ControllerConfig
from gateway.core.json_problems import NotJson, document_of, problems
from gateway.core.line import Positive, Strict
from gateway.core.line_model import Digest, Instant, LineModel
from gateway.core.questions import DECISIONS, Decision

MOST_BYTES = 4096  #: of an ask
Format = Annotated[int, Field(ge=1, le=1)]
Count = Annotated[int, Field(ge=1)]
Part = Annotated[int, Field(ge=0, le=1_000_000)]  #: from 0


class AskRefused(Exception):
    """It asks for nothing that there is; `reasons` are all of them."""

    def __init__(self, reasons: list[str]) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = reasons


class AskMalformed(AskRefused):
    """It is no ask of its kind at all."""


class Generated(Strict):
    """A document that the program makes of the line's own state: its configuration, a model, a deployment ..."""

    name: Annotated[str, Field(max_length=120)]  #: of one thing for ever, so that a newer one replaces it: "model-3"
    title: Annotated[str, Field(max_length=300)]
    text: Annotated[str, Field(max_length=100_000)]  #: Markdown
    date: str  #: ISO 8601, of the day or the moment from which it is; empty: nobody has noted it
    keywords: list[str] = []
    serves: list[Decision] = list(DECISIONS)


class OfHash(Strict):
    """A model, or a controller configuration."""

    format: Format = 1
    hash: Digest | None = None  #: null: the one in service


class ModelTold(Strict):
    """null: no model has been accepted yet, and the line's file is what is known."""

    format: Format = 1
    hash: Digest | None
    model: LineModel | None


class ControllerTold(Strict):
    format: Format = 1
    hash: Digest
    controller: ControllerConfig


class RecordingLine(Strict):
    """An experiment's recording in a list."""

    digest: Digest
    source: str
    ended: Instant
    samples: Count
    spans: Count
    period_s: Positive
    parts: Count  #: in which it is handed out


class RecordingList(Strict):
    format: Format = 1
    recordings: Annotated[list[RecordingLine], Field(max_length=64)]  #: the newest first


class OfRecording(Strict):
    """A part of a recording of the list. The answer is `packed` (gateway/core/packed_recording.py), and no JSON."""

    format: Format = 1
    digest: Digest
    part: Part


class OfKnowledge(Strict):
    """`revision`: of what whoever asks has already; for a further part, the one that it is a part of."""

    format: Format = 1
    revision: Digest | None = None
    part: Part = 0


class KnowledgePart(Strict):
    """What is known of the line, in `parts`; 0 of them: `revision` is what whoever asks has already."""

    format: Format = 1
    revision: Digest
    part: Part
    parts: Annotated[int, Field(ge=0)]
    documents: list[Generated]
    left_out: list[str]  #: in words; with the first part


Ask = TypeVar("Ask", bound=Strict)


def parse_ask(payload: bytes, kind: type[Ask]) -> Ask:
    """The ask in `payload` (JSON). Raises AskMalformed with every reason."""
    if len(payload) > MOST_BYTES:
        raise AskMalformed([f"it has {len(payload)} bytes; allowed: {MOST_BYTES}"])
    try:
        document: dict[str, Any] = document_of(payload)
        return kind.model_validate(document)
    except NotJson as error:
        raise AskMalformed([str(error)]) from error
    except ValidationError as error:
        raise AskMalformed(problems(error, kind)) from error
