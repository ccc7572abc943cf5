"""What the tests of the language model share: a question, settings for a stand-in, and stories in virtual time."""

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

from agents.language_model.budget import Budget
from agents.language_model.client import LanguageModel
from agents.language_model.deciding import Answered, Unanswered, decide
from gateway.core.line import Agents
from gateway.core.questions import Figure, Knob, Option, Question
from tests.stand_in.engine import Engine
from tests.stand_in.in_process import InProcess
from tests.stand_in.personas import PERSONAS
from tests.stand_in.spoken import Persona, Spoken
from tests.support.virtual_time import VirtualTimeLoop

T = TypeVar("T")
PROMPT = "You choose among designs for a line that moves a web."


def _option(name: str, error_n: float | None) -> Option:
    return Option(
        id=name, title=f"design {name}", figures=[Figure(name="predicted tracking error", value=error_n, unit="N")]
    )


QUESTION = Question(
    format=1, site="hall", line="coater", decision="adapt.change", task="Which design is proposed next?",
    facts=["Span 3 swings at 0.8 Hz."], options=[_option("lqi", 1.5), _option("pid-calm", 2.5), _option("mpc", 0.75)],
    usual="lqi", why="It has served before.",
    knobs=[
        Knob(name="torque", meaning="calmer drives", least=0.5, most=2.0),
        Knob(name="integral", meaning="steadier tension", least=0.25, most=4.0),
    ],
)  # fmt: skip
SETTINGS = Agents(llm="ollama", url="http://stand-in", answer_max_s=60.0, load_max_s=120.0)


def says(text: str, **how: Any) -> Persona:
    """A persona that says `text` to everything."""
    return lambda messages, form, rng: Spoken(text, **how)


def virtually(story: Coroutine[Any, Any, T]) -> T:
    """The result of `story`, in virtual time."""
    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        return runner.run(story)


async def decided(
    engine: Engine, settings: Agents = SETTINGS, budget: Budget | None = None, question: Question = QUESTION
) -> Answered | Unanswered:
    """What comes of a question to the real client, whose requests reach `engine` without a socket."""
    clock = asyncio.get_running_loop().time
    async with LanguageModel(settings, clock, InProcess(engine)) as model:
        return await decide(model, PROMPT, question, budget=budget or Budget(settings.task_max_tokens))


def asked_of(persona: str | Persona, settings: Agents = SETTINGS, **engine: Any) -> Answered | Unanswered:
    """The same in virtual time, of a persona or the name of one."""
    chosen = PERSONAS[persona] if isinstance(persona, str) else persona
    return virtually(decided(Engine(chosen, **engine), settings))
