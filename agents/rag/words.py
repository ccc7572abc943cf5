"""Words as they are searched: stems, compounds in either spelling, and what is left out of a question.

The stems are those of SQLite's own Porter tokenizer, so that what is indexed and what is asked are cut alike.
"""

import re
from functools import cache
from typing import cast

import apsw

#: Words of a question that are in every text, or ask rather than say.
_LEFT_OUT = """
a about after again all am an and any anybody are as at be because been before being best but by can cause could cure
did do does doing done each else ever every exactly explain few for from further get gets getting give gives go goes
going gone got had happen happens has have having he help helps her here him his how i if in into is it its itself
just keep keeps kind know let like ll long look looks make makes many matter matters may me mean means might more most
much must my need needs never no nobody nor normally not now of off often ok on once one only or ought our out over
own per please possible put question quite rather re really reason right rule same say see set shall she should since
so some somebody something still such take tell than that the their them then there these they thing things think this
those through thumb till to too toward typical typically under until up upon us use used using usual usually ve very
want wanted was way we well were what whatever when whenever where whether which while who whose why will with within
without won worry would yes yet you your
"""
_HYPHENS = re.compile(r"\b(\w+)-(\w+)\b")


@cache
def _tokenizer() -> apsw.FTS5Tokenizer:
    return apsw.Connection(":memory:").fts5_tokenizer("porter", ["unicode61", "remove_diacritics", "2"])


def stems(text: str) -> list[str]:
    """In order, lower case; `feed-forward` gives feed, forward and feedforward."""
    spread = _HYPHENS.sub(r"\1 \2 \1\2", text)
    found = _tokenizer()(
        spread.encode(errors="replace"),
        apsw.FTS5_TOKENIZE_DOCUMENT,
        None,
        include_offsets=False,
        include_colocated=False,
    )
    return cast(list[str], found)


@cache
def left_out() -> frozenset[str]:
    """Stems that say nothing about what is asked for."""
    return frozenset(stems(_LEFT_OUT))
