"""The page's own words, in every language that it speaks: one catalogue, words.toml.

Alarms, what rules and courses are called, and the sentences of sentences.toml are told in each language. What else the
gateway says stays as it says it, in English, and the page marks it as that.
"""

import json
import tomllib
from functools import cache
from importlib.resources import files

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from gateway.core.alarms import ALARMS
from gateway.wording.catalogue import templates

LANGUAGES = ("en", "de")
NAMED = "gate."  #: before each part of what the gate calls a rule or a course
ALARM_PARTS = ("means", "cause", "consequence", "action")


@cache
def catalogue() -> dict[str, dict[str, str]]:
    """By key, then by language. English are the table of alarms, and what the gate calls its rules."""
    said: dict[str, dict[str, str]] = tomllib.loads(
        (files("gateway.operator.page") / "words.toml").read_text(encoding="utf-8")
    )
    for alarm in ALARMS:
        for part in ALARM_PARTS:
            said.setdefault(f"alarm.{alarm.name}.{part}", {})["en"] = getattr(alarm, part)
    for key, words in said.items():
        if key.startswith(NAMED):
            words["en"] = key.removeprefix(NAMED)
    return said


@cache
def sentences() -> dict[str, dict[str, str]]:
    """ "sentences" and, found only within others, "parts": from English, with names in braces for what differs."""
    return tomllib.loads((files("gateway.operator.page") / "sentences.toml").read_text(encoding="utf-8"))


def words_of(language: str) -> dict[str, str]:
    """By key; but for English also sentences, by the English ones with "sentence." or "part." before."""
    said = {key: said[language] for key, said in catalogue().items()}
    if language == "en":
        return said
    known = templates(language) | sentences()["sentences"]
    for family, some in (("sentence.", known), ("part.", sentences()["parts"])):
        said |= {family + english: there for english, there in some.items()}
    return said


def words_routes() -> list[Route]:
    """Anybody may read them: whoever logs in needs them, too."""
    return [Route(f"/words/{language}.json", _answer(language)) for language in LANGUAGES]


def _answer(language: str):
    text = json.dumps(words_of(language), ensure_ascii=False, separators=(",", ":"))

    async def answer(_: Request) -> Response:
        return Response(text, media_type="application/json", headers={"cache-control": "no-cache"})

    return answer
