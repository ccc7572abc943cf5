"""What a persona says, and how it comes over the wire."""

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

Message = Mapping[str, Any]  #: role and content, as the request has them
Form = Mapping[str, Any] | None  #: the request's format: a JSON schema


@dataclass(frozen=True)
class Spoken:
    """`end`: what comes after the text, or after its first `after_tokens` tokens."""

    text: str
    thinking: str = ""
    token_s: float = 0.0  #: from one token to the next
    end: Literal["stop", "length", "hang-up", "error", "hang"] = "stop"
    after_tokens: int | None = None
    status: int = 200  #: else it is an error from the beginning, and `text` its message
    read_share: float = 1.0  #: of the prompt, that was read
    raw: bytes | None = None  #: of a stream, sent instead of all this


#: The same messages, form and random numbers: the same answer.
Persona = Callable[[Sequence[Message], Form, random.Random], Spoken]
