"""What was asked of the agents, as their log and the proposals that followed tell it."""

from collections.abc import Sequence
from pathlib import Path

from gateway.cli.demo_result import AskedResult, FigureResult, NoteResult, OptionResult
from gateway.core.asked_before import interactions_of
from gateway.core.decisions import ProposalShown
from gateway.core.interactions import Answer, Interaction
from gateway.core.questions import Option, Question
from gateway.supervisor.interactions import FILE_NAME, Interactions

MOST = 1000


def interactions_in(folder: Path) -> list[Interaction]:
    """The oldest first; without a log nothing was asked. Raises InteractionsError where it cannot be read."""
    log = Interactions(folder)
    if not (folder / FILE_NAME).exists():
        return []
    return [log.find(row.id) for row in reversed(log.newest(MOST))]


def asked_result(interactions: Sequence[Interaction], shown: Sequence[ProposalShown]) -> list[AskedResult]:
    followed = {
        interaction: one.proposal_hash for one in shown for interaction in interactions_of(one.proposal.evidence)
    }
    return [
        _asked(one, one.question, one.answer, followed.get(one.id, ""))
        for one in interactions
        if one.question is not None and one.answer is not None  # what was computed stands with the question it was for
    ]


def _asked(one: Interaction, question: Question, answer: Answer, proposal: str) -> AskedResult:
    return AskedResult(
        interaction=one.id, at=one.at, agent=one.agent, decision=question.decision, task=question.task,
        options=[_option(option) for option in question.options], usual=question.usual,
        notes=[NoteResult(title=note.title, tier=note.tier, score=note.score) for note in one.notes],
        chosen=answer.choice.option, factors=answer.choice.factors, by=answer.by, instead=answer.instead,
        reason=answer.choice.reason, model=one.model, tokens=one.tokens_in + one.tokens_out, seconds=one.seconds,
        proposal=proposal,
    )  # fmt: skip


def _option(one: Option) -> OptionResult:
    figures = [FigureResult(name=figure.name, value=figure.value, unit=figure.unit) for figure in one.figures]
    return OptionResult(id=one.id, title=one.title, figures=figures)
