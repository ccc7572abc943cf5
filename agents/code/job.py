"""What goes to a worker and what comes back: a call with all that it names, and its outcome."""

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from agents.code.calls import AnyCall
from gateway.core.computations import MOST_FIGURES, MOST_WORDS
from gateway.core.controller import Controller, ControllerConfig
from gateway.core.line import Line, Strict
from gateway.core.line_model import LineModel
from gateway.core.questions import Figure, Sentence
from gateway.core.recording import Recording


@dataclass(frozen=True)
class Believed:
    """A model that a call names."""

    name: str  #: in words
    model: LineModel | None  #: None: the nominal one, of the line's file


@dataclass(frozen=True)
class Named:
    """A controller that a call names."""

    name: str
    config: Controller


@dataclass(frozen=True)
class Job:
    """Lists stand in the order in which the call names things."""

    call: AnyCall
    line: Line
    models: tuple[Believed, ...] = ()
    controllers: tuple[Named, ...] = ()
    recordings: tuple[Recording, ...] = ()


class Outcome(Strict):
    """Of a job: figures, or why there are none."""

    figures: Annotated[list[Figure], Field(max_length=MOST_FIGURES)] = []
    words: Annotated[list[Sentence], Field(max_length=MOST_WORDS)] = []
    controller: ControllerConfig | None = None  #: that was designed; it goes to no line from here
    refused: Annotated[list[str], Field(max_length=MOST_WORDS)] = []
    failed: Annotated[str, Field(max_length=600)] = ""
