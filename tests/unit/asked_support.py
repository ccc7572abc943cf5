"""Deciders for tests of what phases ask: by chance, by a list, by a language model's persona with the real client."""

import asyncio
import random
from collections.abc import Callable
from dataclasses import dataclass, field

from agents.answering import Agent
from agents.language_model.budget import Budget
from agents.language_model.client import LanguageModel
from agents.rag.stages import Asked, Retrieval
from gateway.commissioning.decisions import Decided
from gateway.core.interactions import Interaction
from gateway.core.questions import Choice, Question, question_json
from tests.stand_in.engine import Engine
from tests.stand_in.in_process import InProcess
from tests.stand_in.personas import PERSONAS
from tests.unit.language_model_support import SETTINGS, virtually

AGENT = "initial-control"


@dataclass
class ByChance:
    """Any option, any factors within their bounds; the same for the same question."""

    seed: int
    asked: list[Question] = field(default_factory=list)

    def decide(self, question: Question) -> Decided:
        self.asked.append(question)
        rng = random.Random(f"{self.seed} {question_json(question)}")
        option = rng.choice(question.options).id
        knobs = [one for one in question.knobs if (option in one.of or not one.of) and rng.random() < 0.7]
        factors = {one.name: rng.choice([one.least, one.most, rng.uniform(one.least, one.most)]) for one in knobs}
        return Decided(Choice(option=option, factors=factors, reason="by chance"), AGENT)


@dataclass
class Says:
    """What `choose` says: an option, and factors; None: as the rules."""

    choose: Callable[[Question], tuple[str, dict[str, float]] | None]
    asked: list[Question] = field(default_factory=list)

    def decide(self, question: Question) -> Decided:
        self.asked.append(question)
        option, factors = self.choose(question) or (question.usual, {})
        return Decided(Choice(option=option, factors=factors, reason=f"I say {option}."), AGENT)


@dataclass
class Persona:
    """The real agent and the real client, and a persona in place of a language model, in virtual time."""

    name: str
    kept: list[Interaction] = field(default_factory=list)

    def decide(self, question: Question) -> Decided:
        return virtually(self._decided(question))

    async def _decided(self, question: Question) -> Decided:
        async def nothing(_: Asked) -> Retrieval:
            raise OSError("nothing is known here")

        async def keep(one: Interaction) -> None:
            self.kept.append(one)

        clock, transport = asyncio.get_running_loop().time, InProcess(Engine(PERSONAS[self.name]))
        async with LanguageModel(SETTINGS, clock, transport) as model:
            agent = Agent(question.agent, nothing, keep, model, lambda _: Budget(10**9))
            answer = await agent.answer(question)
        return Decided(answer.choice, answer.by, answer.instead)
