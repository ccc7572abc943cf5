"""Interactions of agents for a person to read: a table of many, one as a story."""

from collections.abc import Sequence
from textwrap import indent
from typing import Any

from rich.console import Console
from rich.table import Table

from gateway.cli.compute_view import as_text, figure_text
from gateway.core.computations import Computed
from gateway.core.interactions import Answer, Interaction, Note
from gateway.core.line_problem import printable
from gateway.core.questions import Option, Question
from gateway.supervisor.interactions import Row

WIDTH = 120


def as_table(rows: Sequence[Row]) -> str:
    """The newest first."""
    if not rows:
        return "nothing was asked"
    table = Table(box=None, pad_edge=False)
    for head in ("number", "at", "agent", "decision", "chosen", "by", "why the rules"):
        table.add_column(head, overflow="fold")
    for one in rows:
        cells = (str(one.number), one.at[:19], one.agent, one.decision, one.chosen, one.decided_by, one.instead)
        table.add_row(*map(printable, cells))
    console = Console(width=WIDTH, color_system=None)
    with console.capture() as captured:
        console.print(table, markup=False)
    return captured.get().rstrip()


def as_story(one: Interaction) -> str:
    """Question, options, what was looked up, every word of the model, the answer: in the order in which it happened."""
    if one.question is not None and one.answer is not None:
        parts = _of_question(one, one.question, one.answer)
    else:
        parts = [
            f"{one.agent} was asked by {one.asked_by} at {one.at} to compute for: {one.task}",
            *map(as_text, one.computations),
            f"({one.seconds:.1f} s)",
        ]
    lines = "\n\n".join(part for part in parts if part).splitlines()
    return "\n".join(map(printable, lines))


def _of_question(one: Interaction, question: Question, answer: Answer) -> list[str]:
    parts = [
        f"{one.agent} was asked at {one.at}: {question.task} ({question.decision})",
        _listed("known", question.facts),
        _listed("figures", [figure_text(figure) for figure in question.figures]),
        _listed("offered", [_option(option) for option in question.options]),
        f"the rules would choose {question.usual}: {question.why}",
        _listed("looked up", [_note(note) for note in one.notes]),
        _listed("conflicts among it", one.conflicts),
        *(_exchange(number, exchange) for number, exchange in enumerate(one.exchanges, 1)),
        _answer(one, answer),
    ]
    return [*parts, f"the rules, because {answer.instead}"] if answer.instead else parts


def _answer(one: Interaction, answer: Answer) -> str:
    choice = answer.choice
    turned = ", ".join(f"{name} times {factor:g}" for name, factor in choice.factors.items())
    tokens = f", {one.tokens_in} tokens read and {one.tokens_out} written" if one.exchanges else ""
    return (
        f"chosen by {answer.by}: {choice.option}{f', {turned}' if turned else ''}\n"
        f"{indent(choice.reason, '  > ', lambda _: True)}\n({one.seconds:.1f} s{tokens})"
    )


def _exchange(number: int, exchange: dict[str, Any]) -> str:
    said, thought = exchange.get("raw") or "(nothing)", exchange.get("thinking")
    refused = exchange.get("refused") or []
    named = f"{exchange.get('model')} {str(exchange.get('digest'))[:12]}"
    head = f"call {number} of {named}, to {exchange.get('purpose')}:"
    messages: list[dict[str, Any]] = exchange.get("messages") or []
    return "\n".join([
        head,
        *(indent(f"{message.get('role')}: {message.get('content')}", "  | ") for message in messages),
        *([indent(f"thought: {thought}", "  | ")] if thought else []),
        indent(f"said: {said}", "  | "),
        *(f"  refused: {reason}" for reason in refused),
        *(indent(as_text(Computed.model_validate(row)), "  ") for row in exchange.get("computed") or []),
    ])  # fmt: skip


def _listed(head: str, rows: Sequence[str]) -> str:
    return "\n".join([f"{head}:", *(f"  - {row}" for row in rows)]) if rows else ""


def _option(option: Option) -> str:
    figures = "; ".join(figure_text(figure) for figure in option.figures)
    return f"{option.id}: {option.title}{f' ({figures})' if figures else ''}"


def _note(note: Note) -> str:
    marks = [f"overruled by {key}" for key in note.overruled_by] + note.speaks_to_a_model
    return f"{note.title} (tier {note.tier}, {note.score:.2f}){'; '.join(['', *marks]) if marks else ''}"
