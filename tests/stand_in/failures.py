"""Servers that do not work, in the place of a persona."""

import json
import random
from collections.abc import Sequence
from pathlib import Path

from tests.stand_in.spoken import Form, Message, Persona, Spoken

RECORDED = Path(__file__).parent / "recorded"


def http_500(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """The model does not run."""
    return Spoken("model runner has unexpectedly stopped, this may be due to resource limitations", status=500)


def error_mid_stream(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """An error object among the tokens: status -1 in the client."""
    return Spoken("The first words were still", end="error", after_tokens=3)


def hung(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """Takes the question and says nothing."""
    return Spoken("", end="hang", after_tokens=0)


def hung_mid_stream(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """Says some words and no more."""
    return Spoken("The first words come and then", end="hang", after_tokens=3)


def silent_cut(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """Reads a quarter of the question and does not say so but in its counts."""
    return Spoken("Fine.", read_share=0.25)


def nothing(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """Ends without a word."""
    return Spoken("")


def garbage(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """Bytes that are no lines of JSON."""
    return Spoken("", raw=rng.randbytes(200) + b"\n")


def flood(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """A line that does not end."""
    return Spoken("", raw=b'{"message": {"role": "assistant", "content": "' + b"a" * 20_000_000)


def talkative(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """400,000 letters that mean nothing, in lines as they should be, whatever it was told to be its most."""
    words = [rng.randbytes(50).hex() + "\n" for _ in range(4_000)]
    lines = [{"message": {"role": "assistant", "content": word}, "done": False} for word in words]
    counts = {"prompt_eval_count": 5_000, "eval_count": 100}
    end = {"message": {"role": "assistant", "content": ""}, "done": True, "done_reason": "stop"} | counts
    return Spoken("", raw=b"".join(json.dumps(line).encode() + b"\n" for line in [*lines, end]))


def recorded(name: str) -> Persona:
    """The stream in the file `name` of `recorded/`, byte for byte."""
    content = (RECORDED / name).read_bytes()

    def replay(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
        return Spoken("", raw=content)

    return replay


FAILURES: dict[str, Persona] = {
    "http_500": http_500,
    "error_mid_stream": error_mid_stream,
    "hung": hung,
    "hung_mid_stream": hung_mid_stream,
    "silent_cut": silent_cut,
    "nothing": nothing,
    "garbage": garbage,
    "flood": flood,
    "talkative": talkative,
}
