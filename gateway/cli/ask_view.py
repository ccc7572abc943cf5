"""What was found, on the terminal: the passages as quotations, and each stage of the search as a table."""

from collections.abc import Sequence
from textwrap import wrap

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from agents.rag.injection import quoted
from agents.rag.stages import FoundDocument, FoundPassage, Hit, Retrieval
from gateway.core.line_problem import printable

TIERS = {1: "control theory", 2: "practice of roll-to-roll lines", 3: "this line"}
SHOWN = 10  #: rows of a table
FACTORS = {"tier": "tier", "confidence": "sure", "applies": "fits", "serves": "serves"}  #: with the head of the column


def print_found(found: Retrieval, explain: bool) -> None:
    console = Console(highlight=False, markup=False)
    if explain:
        _print_stages(found, console)
    _print_hits(found, console)


def _print_hits(found: Retrieval, console: Console) -> None:
    if not found.hits:
        console.print("Nothing was found. Ask in other words: those of the line, or of what is seen on it.")
    for number, hit in enumerate(found.hits, start=1):
        _print_hit(number, hit, console)
    for one in found.conflicts:
        console.print(_text(f"Conflict: {one.winner} counts before {one.loser}: {one.rule}.", "yellow"))
        for key, said in ((one.winner, one.winner_says), (one.loser, one.loser_says)):
            if said:
                console.print(_text(f"  {key}: {said}"))
        console.print()


def _print_hit(number: int, hit: Hit, console: Console) -> None:
    document = hit.document
    console.print(_text(f"{number}. {document.title}", "bold"))
    dated = f", of {document.date}" if document.date else ""
    console.print(_text(f"   tier {document.tier}, {TIERS[document.tier]}; {document.key}{dated}", "dim"))
    if hit.overruled_by:
        console.print(_text(f"   OVERRULED by {', '.join(hit.overruled_by)}: see the conflict below", "yellow"))
    for flag in hit.passage.flags:
        console.print(_text(f"   SPEAKS TO A LANGUAGE MODEL, it {flag.kind}: quoted, not followed", "red"))
    if hit.passage.heading:
        console.print(_text(f"   {hit.passage.heading}", "italic"))
    for line in quoted(hit.passage.text).split("\n"):  # each line that is printed begins with >
        for part in wrap(line.removeprefix("> "), max(console.width - 6, 20)) or [""]:
            console.print(Text(f"   > {part}"))
    if document.sources:
        console.print(_text(f"   from: {'; '.join(document.sources)}", "dim"))
    console.print()


def _print_stages(found: Retrieval, console: Console) -> None:
    """In their order: words, passages, documents, order, conflicts."""
    console.print("1. What is asked for, as stems, and those of the words of the field that stand for it")
    words = _table("asked", "weight", "and")
    for concept in found.concepts:
        also = ", ".join(" ".join(phrase) for phrase, _ in concept.expanded)
        words.add_row(_text(" ".join(concept.said)), f"{concept.weight:g}", _text(also))
    console.print(words)
    console.print("2. Passages: by their words (BM25), and where there is an embedder by meaning (cosine)")
    _print_scores(found.lexical, found, "words", console)
    _print_scores(found.embedding, found, "meaning", console)
    console.print("3. Documents: title, keywords and the best passages together")
    _print_scores(found.lexical_documents, found, "words", console)
    _print_scores(found.embedding_documents, found, "meaning", console)
    _print_order(found, console)
    console.print(f"5. Conflicts: {len(found.conflicts) or 'none'}\n")


def _print_scores(some: Sequence[FoundPassage | FoundDocument], found: Retrieval, kind: str, console: Console) -> None:
    if not some:
        return
    table = _table("", f"by {kind}", "of")
    for rank, one in enumerate(some[:SHOWN], start=1):
        table.add_row(str(rank), f"{one.score:.3f}", _text(found.titles[one.document]))
    console.print(table)


def _print_order(found: Retrieval, console: Console) -> None:
    console.print("4. Order: shares of the best by words and by meaning, times what else is known of a document")
    table = _table("", "score", "words", "meaning", *FACTORS.values(), "document")
    for rank, one in enumerate(found.ranked[:SHOWN], start=1):
        meaning = "" if one.embedding is None else f"{one.embedding:.3f}"
        factors = (f"{one.factors[name]:.2f}" if name in one.factors else "" for name in FACTORS)
        title = _text(one.document.title)
        table.add_row(str(rank), f"{one.score:.3f}", f"{one.lexical:.3f}", meaning, *factors, title)
    console.print(table)


def _table(*heads: str) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for head in heads[:-1]:
        table.add_column(head, no_wrap=True)
    table.add_column(heads[-1], overflow="fold")
    return table


def _text(said: str, style: str = "") -> Text:
    return Text(printable(said), style=style)
