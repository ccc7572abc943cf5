"""Proposals that wait for a person, as plain variables: all on which they decide, and nothing that they must not read
as the gateway's own words. Many panels cannot show conditions; variables they all can.
"""

from collections.abc import Iterator, Sequence
from math import nan

from gateway.core.decisions import ProposalShown
from gateway.core.line_problem import quoted
from gateway.core.verdict import RuleFinding
from gateway.operator.opcua.line_nodes import ROOT
from gateway.operator.opcua.space import BOOLEAN, DOUBLE, NO_DATA, STRING, UINT32, Row, Space, Value

FOLDER = f"{ROOT}.Proposals"
CURRENT = f"{FOLDER}.Current"
MOST_WAITING = 20  #: that have nodes, the newest

ROWS = (
    Row("Id", STRING, "SHA-256 of the proposal; empty: none waits"),
    Row("ShownHash", STRING, "SHA-256 of all that is shown here; for Decide"),
    Row("BaseRevision", UINT32, "Of the configuration that it would change; for Decide"),
    Row("Kind", STRING, "gains, experiment or model"),
    Row("Author", STRING, "Who proposes"),
    Row("Stage", STRING, "waiting"),
    Row("Why", STRING, "What the gateway says of that stage, as who has approved already where two must"),
    Row("Created", STRING, "RFC 3339"),
    Row("Expires", STRING, "RFC 3339; later it cannot be approved"),
    Row("Reason", STRING, "Quoted: the words of its author, possibly a language model, which nobody has checked"),
    Row("Difference", STRING, "What would change, as the gateway computes it", array=True),
    Row("Promised", STRING, "What its author predicts, by scenario", array=True),
    Row("FigureScenario", STRING, "Of what the gateway has simulated: the scenario of each figure", array=True),
    Row("FigureConfiguration", STRING, "in service (before), proposed (after), or baseline", array=True),
    Row("FigureRmse", DOUBLE, "N; NaN: the line ran away", array=True),
    Row("FigureOvershoot", DOUBLE, "%; NaN as above", array=True),
    Row("FigureSettling", DOUBLE, "s; NaN: not settled", array=True),
    Row("FigureEffort", DOUBLE, "N2 m2 s; NaN as above", array=True),
    Row("Accepted", BOOLEAN, "By every rule of the gate"),
    Row("Rule", STRING, "Every rule of the gate", array=True),
    Row("RulePassed", BOOLEAN, "By rule", array=True),
    Row("RuleValue", DOUBLE, "By rule; NaN: it has no number", array=True),
    Row("RuleLimit", DOUBLE, "By rule", array=True),
    Row("RuleMargin", DOUBLE, "By rule: the distance to the limit, above 0 where it passes", array=True),
    Row("RuleUnit", STRING, "By rule", array=True),
    Row("RuleText", STRING, "By rule: what was found, where, what is allowed", array=True),
)


class ProposalNodes:
    def __init__(self, space: Space) -> None:
        self._space = space
        self._type = ""
        self._there: set[str] = set()
        self._current: ProposalShown | None = None

    async def make(self) -> None:
        self._type = await self._space.type("ProposalType", "A change that waits for a person's word", ROWS)
        await self._space.object(FOLDER, ROOT, "Those that wait, by their ids; and the one to look at")
        await self._make(CURRENT, "One that waits, the same as long as it waits unchanged; then the newest")

    async def show(self, waiting: Sequence[ProposalShown]) -> None:
        """Those that wait, the newest first."""
        self._current = _kept(self._current, waiting)
        for name, value in _values(self._current):
            await self._space.tell(f"{CURRENT}.{name}", value, None)
        wanted = {f"{FOLDER}.{one.proposal_hash}": one for one in waiting}
        for path in self._there - wanted.keys():
            await self._nothing(path, NO_DATA)  # whoever watches it shall not go on seeing it wait
            await self._space.remove(path)
        for path in wanted.keys() - self._there:
            await self._make(path, "A proposal that waits")
        self._there = set(wanted)
        for path, one in wanted.items():
            for name, value in _values(one):
                await self._space.tell(f"{path}.{name}", value, None)

    async def unsure(self, code: int) -> None:
        """Whether they still wait is not known: nothing is shown that could be decided on."""
        for path in (CURRENT, *sorted(self._there)):
            await self._nothing(path, code)

    async def _nothing(self, path: str, code: int) -> None:
        for row in ROWS:
            await self._space.tell(f"{path}.{row.name}", None, None, code)

    async def _make(self, path: str, tells: str) -> None:
        await self._space.object(path, FOLDER, tells, self._type)
        await self._space.variables(path, ROWS)


def _kept(current: ProposalShown | None, waiting: Sequence[ProposalShown]) -> ProposalShown | None:
    """What a person looks at does not change under their finger because something newer has come."""
    if current is not None:
        for one in waiting:
            if (one.proposal_hash, one.shown) == (current.proposal_hash, current.shown):
                return one
    return waiting[0] if waiting else None


def _values(shown: ProposalShown | None) -> Iterator[tuple[str, Value]]:
    if shown is None:
        empty: dict[object, Value] = {BOOLEAN: False, UINT32: 0, STRING: "", DOUBLE: nan}
        yield from ((row.name, [] if row.array else empty[row.kind]) for row in ROWS)
        return
    proposal, verdict = shown.proposal, shown.verdict
    figures = [] if verdict is None else verdict.figures
    yield from {
        "Id": shown.proposal_hash, "ShownHash": shown.shown or "", "BaseRevision": shown.epoch, "Kind": proposal.kind,
        "Author": proposal.author, "Stage": shown.stage, "Why": shown.why,
        "Created": proposal.created, "Expires": proposal.expires,
        "Reason": quoted(proposal.reason), "Difference": shown.difference,
        "Promised": [_promise(one.scenario, one.rmse_n, one.overshoot_pct, one.settling_s)
                     for one in proposal.predicted],
        "FigureScenario": [one.scenario for one in figures],
        "FigureConfiguration": [one.configuration for one in figures],
        "FigureRmse": [_number(one.rmse_n) for one in figures],
        "FigureOvershoot": [_number(one.overshoot_pct) for one in figures],
        "FigureSettling": [_number(one.settling_s) for one in figures],
        "FigureEffort": [_number(one.effort_n2m2s) for one in figures],
        "Accepted": verdict is not None and verdict.accepted,
    }.items()  # fmt: skip
    yield from _rules([] if verdict is None else verdict.findings)


def _rules(findings: Sequence[RuleFinding]) -> Iterator[tuple[str, Value]]:
    yield "Rule", [one.rule for one in findings]
    yield "RulePassed", [one.passed for one in findings]
    yield "RuleValue", [_number(one.value) for one in findings]
    yield "RuleLimit", [_number(one.limit) for one in findings]
    yield "RuleMargin", [_number(one.margin) for one in findings]
    yield "RuleUnit", [one.unit for one in findings]
    yield "RuleText", [one.text for one in findings]


def _number(value: float | None) -> float:
    return nan if value is None else value


def _promise(scenario: str, rmse_n: float | None, overshoot_pct: float | None, settling_s: float | None) -> str:
    parts = (("RMSE", rmse_n, "N"), ("overshoot", overshoot_pct, "%"), ("settling", settling_s, "s"))
    told = ", ".join(f"{name} {value:g} {unit}" for name, value, unit in parts if value is not None)
    return f"{scenario}: {told or 'nothing'}"
