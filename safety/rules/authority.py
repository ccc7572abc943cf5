"""Who proposes may, and the line is open to changes at all."""

from gateway.core.nearest import nearest
from gateway.core.verdict import RuleFinding
from safety.case import Case
from safety.findings import told

RULE = "authority"


def check(case: Case) -> list[RuleFinding]:
    """Author against gate.authors, and gate.autonomy."""
    gate, author = case.line.gate, case.proposal.author
    found: list[RuleFinding] = []
    if author not in gate.authors:
        like = nearest(author, gate.authors)
        hint = f"; did you mean {like}?" if like else ""
        found.append(
            told(RULE, False, f"author is {author}; allowed: gate.authors, which are {', '.join(gate.authors)}{hint}")
        )
    if gate.autonomy == "closed":
        found.append(told(RULE, False, "gate.autonomy of the line's file is closed: nothing is changed on this line"))
    return found or [told(RULE, True, f"{author} may propose")]
