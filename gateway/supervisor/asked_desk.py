"""What was asked before a proposal was made, and the notes it was decided with, for whoever decides on it.

It only reads, in a thread, one question at a time; an answer always fits a message.
"""

import asyncio
import re
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence

from pydantic import ValidationError

from gateway.core.asked_before import (
    MOST_ASKED,
    MOST_NOTES,
    MOST_PASSAGE,
    MOST_TITLE,
    AskedTold,
    Before,
    NoteBefore,
    ShowAsked,
    interactions_of,
)
from gateway.core.interactions import Answer, Interaction, Note
from gateway.core.json_problems import NotJson, document_of, problems
from gateway.core.proposal import Evidence
from gateway.core.questions import Question
from gateway.core.topics import GATEWAY_ASKED
from gateway.mailbox.port import Mailbox
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.deployer import Deployer
from gateway.supervisor.deployer_sides import NotKnown
from gateway.supervisor.interactions import Interactions, InteractionsError
from gateway.supervisor.proposal_records import refused

MOST_KEPT = 8  #: answers
RULES = "rules"  #: as agents say it of a choice that no language model has made

_ID = re.compile("[0-9a-f]{16}")  #: of an interaction


class AskedDesk:
    """A handler on a mailbox."""

    def __init__(self, mailbox: Mailbox, deployer: Callable[[], Deployer | None], log: Interactions) -> None:
        """`deployer`: None while the gate is shut."""
        self._deployer = deployer
        self._log = log
        self._reading = asyncio.Lock()
        #: By proposal. What an agent writes into its log later changes nothing of what was told before.
        self._kept: OrderedDict[str, AskedTold] = OrderedDict()
        mailbox.serve(GATEWAY_ASKED, self._answer)

    async def _answer(self, payload: bytes) -> bytes:
        try:
            wanted = ShowAsked.model_validate(document_of(payload))
        except NotJson as error:
            return _refused("not understood", [str(error)])
        except ValidationError as error:
            return _refused("not understood", problems(error, ShowAsked))
        deployer = self._deployer()
        if deployer is None:
            return _refused("the gate is shut", ["ask again once it is open"])
        try:
            await deployer.at_hand(wanted.proposal)
            shown = deployer.shown(wanted.proposal)
        except (NotKnown, AuditUnavailable) as error:
            return _refused("it is not told", [str(error)])
        if isinstance(shown, str):
            return _refused("it is not told", [shown])
        async with self._reading:
            if wanted.proposal not in self._kept:
                self._keep(await asyncio.to_thread(self._told, wanted.proposal, shown.proposal.evidence))
            return self._kept[wanted.proposal].model_dump_json().encode()

    def _keep(self, told: AskedTold) -> None:
        self._kept[told.proposal] = told
        while len(self._kept) > MOST_KEPT:
            self._kept.popitem(last=False)

    def _told(self, proposal: str, evidence: Sequence[Evidence]) -> AskedTold:
        asked, found, missing = list[Before](), list[Note](), list[str]()
        named = list(dict.fromkeys(_named(evidence)))
        try:
            there = self._log.several(named[:MOST_ASKED])
        except InteractionsError as error:
            there, missing = {}, [str(error)]
        for one in named[:MOST_ASKED]:
            if (interaction := there.get(one)) is None:
                missing += [f"{one} is in the agents' log nowhere"]
                continue
            found += interaction.notes
            if interaction.question is None or interaction.answer is None:
                missing += [f"{one} is no question, but something computed: `r2rgate log {one}` tells it"]
            else:
                asked.append(_before(interaction, interaction.question, interaction.answer))
        if len(named) > MOST_ASKED:
            missing.append(f"{len(named) - MOST_ASKED} more questions are not told here; `r2rgate log` has them")
        return AskedTold(format=1, proposal=proposal, asked=asked, notes=_notes(found), missing=missing)


def _named(evidence: Sequence[Evidence]) -> list[str]:
    """Ids of interactions; what has a number or a hash beside it speaks for itself."""
    plain = [one for one in evidence if one.value is None and one.digest is None]
    return [one for one in interactions_of(plain) if _ID.fullmatch(one)]


def _before(one: Interaction, question: Question, answer: Answer) -> Before:
    chosen = next((option.title for option in question.options if option.id == answer.choice.option), "")
    return Before(
        interaction=one.id, agent=one.agent, task=question.task, chosen=chosen or answer.choice.option,
        by_rules=answer.by == RULES, instead=answer.instead[:MOST_PASSAGE],
    )  # fmt: skip


def _notes(found: Iterable[Note]) -> list[NoteBefore]:
    """Each document once, with the passage that fitted best."""
    best: dict[str, Note] = {}
    for note in sorted(found, key=lambda note: -note.score):
        best.setdefault(note.key, note)
    return [
        NoteBefore(
            key=note.key[:MOST_TITLE], title=note.title[:MOST_TITLE], tier=note.tier, passage=_cut(note.passage),
            overruled_by=[key[:MOST_TITLE] for key in note.overruled_by[:3]],
            speaks_to_a_model=bool(note.speaks_to_a_model),
        )
        for note in list(best.values())[:MOST_NOTES]
    ]  # fmt: skip


def _cut(passage: str) -> str:
    return passage if len(passage) <= MOST_PASSAGE else f"{passage[:MOST_PASSAGE].rstrip()} ..."


def _refused(text: str, reasons: list[str]) -> bytes:
    return refused(text, reasons[:20]).model_dump_json().encode()
