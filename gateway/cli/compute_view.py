"""What was computed, for a person to read."""

import json

from gateway.core.computations import Computed
from gateway.core.line_problem import printable
from gateway.core.questions import Figure


def as_text(one: Computed) -> str:
    """The call, its figures, what it says, or why there are none."""
    lines = [
        f"call {one.number}: {json.dumps(one.call)} ({one.seconds:.1f} s)",
        *(f"  refused: {reason}" for reason in one.refused),
        *([f"  failed: {one.failed}"] if one.failed else []),
        *(f"  {figure_text(figure)}" for figure in one.figures),
        *(f"  - {words}" for words in one.words),
    ]
    return "\n".join(map(printable, lines))


def figure_text(figure: Figure) -> str:
    value = "not known" if figure.value is None else f"{figure.value:g} {figure.unit}".rstrip()
    return f"{figure.name} {value}"
