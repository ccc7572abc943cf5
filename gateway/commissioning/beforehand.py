"""What the gate says of a design before it is proposed: the judge's own rules, in the context of the line as known.

Left out are the rules that speak of the moment, of who proposes, and of the model and its data: they are the same for
every design.
"""

from dataclasses import dataclass
from datetime import datetime, timedelta
from math import inf

from gateway.commissioning.decisions import RULES
from gateway.core.controller import Controller, config_hash
from gateway.core.judge_context import JudgeContext
from gateway.core.line import Line, Strict
from gateway.core.line_model import model_hash
from gateway.core.proposal import GainsChange, Proposal
from gateway.core.verdict import RuleFinding
from safety.findings import share_of
from safety.judge import findings_on_design

STANDS = timedelta(hours=1)
SHORT = 18  #: letters of a rule's name in a table


class GateAnswer(Strict):
    """Of one design."""

    passed: bool
    rule: str  #: the nearest to its limit, or of those that refuse the farthest beyond
    margin: float | None = None  #: of that rule, as a share of value or limit; None: it has no number
    text: str  #: what it found
    refusals: list[str] = []  #: of all rules that refuse
    calmer: int = 0  #: times that the design was made calmer until the gate let it through

    @property
    def short(self) -> str:
        """For a table: the rule, and its margin."""
        name = self.rule.removeprefix("corners: ").removeprefix("improvement: ").split(",")[0][:SHORT]
        margin = "" if self.margin is None else f" {100.0 * self.margin:+.0f}%"
        return f"{name}{margin}" if self.passed else f"no: {name}{margin}"


@dataclass(frozen=True)
class Beforehand:
    """What designs of a line are judged against."""

    line: Line
    context: JudgeContext
    seed: int

    def answer(self, controller: Controller) -> GateAnswer:
        """Takes seconds, of predictive control a minute where it is near a limit."""
        found = findings_on_design(self._proposed(controller), self.context, self.line, self.seed)
        refusing = [one for one in found if not one.passed]
        nearest = min(refusing or found, key=self._share)
        share = self._share(nearest)
        return GateAnswer(
            passed=not refusing, rule=nearest.rule, margin=None if abs(share) == inf else share, text=nearest.text,
            refusals=[one.text for one in refusing],
        )  # fmt: skip

    def _share(self, found: RuleFinding) -> float:
        """What passes without a number is far from any limit, what refuses without one is farthest beyond."""
        share = share_of(found, self.line.limits.tension_step_max_n)
        return (inf if found.passed else -inf) if share is None else share

    def _proposed(self, controller: Controller) -> Proposal:
        context, at = self.context, datetime.fromisoformat(self.context.now)
        return Proposal(
            format=1,
            site=self.line.site,
            line=self.line.line,
            change=GainsChange(controller=controller),
            base=config_hash(context.in_service),
            model=None if context.model is None else model_hash(context.model),
            reason="to see beforehand what the gate says",
            evidence=[],
            author=RULES,
            created=context.now,
            expires=(at + STANDS).isoformat(timespec="milliseconds"),
        )
