"""Why a language model gave no answer: whatever goes wrong on the way becomes this one exception."""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Literal

import httpx
import ollama

from gateway.core.line_problem import printable

Kind = Literal[
    "absent",  # nobody listens there
    "no-model",  # the server does not have it, or would ask somebody else's
    "refused",  # the server answered with an error before it began
    "late",  # no answer, or no end of it, in time
    "broken",  # what came is no answer as the protocol has it, or ended in the middle
    "length",  # stopped at the most tokens that an answer may have
    "empty",  # it ended without a word
    "too-long",  # the question does not fit into the context; it was not sent
    "cut",  # the server read less than it was sent
    "spent",  # the task's tokens are used up; it was not sent
    "no-choice",  # every try was refused
]
MOST_QUOTED = 300  #: letters of what a server says of its error

_NOT_FOUND = 404
_FOREIGN = (httpx.HTTPError, httpx.InvalidURL, httpx.StreamError, ollama.RequestError, OSError)
#: What the client and the libraries under it raise on JSON that is none, or is of another shape than an answer.
_SHAPELESS = (ValueError, TypeError, AttributeError, KeyError, RecursionError)


class NoAnswer(Exception):
    """`so_far`: what of an answer had come until then."""

    def __init__(self, kind: Kind, text: str, so_far: str = "") -> None:
        super().__init__(text)
        self.kind: Kind = kind
        self.text = text
        self.so_far = so_far


@contextmanager
def told_as_no_answer(url: str, so_far: Callable[[], str] = lambda: "") -> Generator[None]:
    """What the client raises inside becomes NoAnswer. `so_far` is called then."""
    try:
        yield
    except NoAnswer:
        raise
    except (ollama.ResponseError, *_FOREIGN, *_SHAPELESS) as error:
        kind, text = _kind(error), _text(error)
        raise NoAnswer(kind, f"{url}: {text}", so_far()) from error


def _kind(error: Exception) -> Kind:
    if isinstance(error, ollama.ResponseError):  # status -1: an error object in the middle of a stream
        return "no-model" if error.status_code == _NOT_FOUND else "broken" if error.status_code < 0 else "refused"
    if isinstance(error, TimeoutError | httpx.TimeoutException) and not isinstance(error, httpx.ConnectTimeout):
        return "late"
    if isinstance(error, ConnectionError | httpx.ConnectError | httpx.ConnectTimeout | httpx.InvalidURL):
        return "absent"
    return "broken"


def _text(error: Exception) -> str:
    kind = _kind(error)
    if kind == "absent":
        return "nobody answers there; is Ollama running, and is agents.url right?"
    if kind == "late":
        return "no answer in time"
    said = printable(str(error))[:MOST_QUOTED] or type(error).__name__
    if isinstance(error, ollama.ResponseError):
        return f"the server says: {said}"
    return f"what came is no answer: {said}"
