"""What luck has to do with a verdict: the seed of a proposal, and further draws where a finding is near its limit.

Noise, the corners of what is believed, and the angles of rollers out of round are drawn; a finding near its limit would
come out otherwise under another seed, and whoever proposes often enough would get through. So the seed follows from
what is proposed and what it is judged against, and a finding near its limit is drawn anew until the 99 % interval of
its mean margin (Student's t) leaves out 0; where it does not, the worse of what was drawn holds. How far a tension or
a roller goes is a limit of each draw.
"""

import hmac
from collections.abc import Callable, Sequence
from dataclasses import replace
from hashlib import sha256
from itertools import pairwise
from math import inf, sqrt
from statistics import fmean, stdev

from gateway.core.controller import config_hash
from gateway.core.controller_laws import MpcConfig
from gateway.core.experiment import experiment_hash
from gateway.core.judge_context import JudgeContext
from gateway.core.line import Line
from gateway.core.line_model import model_hash
from gateway.core.proposal import ExperimentChange, GainsChange, parse_proposal
from gateway.core.verdict import RuleFinding, line_hash
from safety.case import Case
from safety.findings import share_of, told
from safety.rules.table import Rule

#: Draws after which a finding is looked at; of a programme, which takes seconds for each. Few looks: at each one in a
#: hundred is wrong.
LOOKS, LOOKS_SLOW = (1, 4, 8, 16), (1, 3, 6)
RULE = "draws"
T_99 = {3: 9.925, 4: 5.841, 6: 4.032, 8: 3.499, 16: 2.947}  #: Student's t, two-sided 99 %, by the number of draws
#: How far a tension or a roller goes is a limit of each draw, not of the mean: one that fails refuses.
OF_EACH = (" tension", "roller speed", ": deviation")
SEED_BYTES = 6

Check = Callable[[Rule, Case], Sequence[RuleFinding]]
Found = Sequence[tuple[Rule, list[RuleFinding]]]  #: of each rule
GoesOn = Callable[[], None]


def seed_of(secret: bytes, payload: bytes, context: JudgeContext, line: Line) -> int:
    """Of a proposal's verdict: the same for the same change of the same line, as often as it is proposed.

    Nobody without `secret` knows it, and could prepare a proposal for it. 0 of what is no proposal: nothing is drawn.
    """
    try:
        change = parse_proposal(payload, line.gate.proposal_max_bytes).change
    except Exception:  # whatever the parser stumbles over
        return 0
    if isinstance(change, GainsChange):
        brings = config_hash(change.controller)
    else:
        brings = (
            experiment_hash(change.experiment) if isinstance(change, ExperimentChange) else model_hash(change.model)
        )
    model = "" if context.model is None else model_hash(context.model)
    what = " ".join((brings, line_hash(line), model, config_hash(context.in_service)))
    return int.from_bytes(hmac.digest(secret, what.encode(), "sha256")[:SEED_BYTES])


def drawn_again(case: Case, found: Found, check: Check, goes_on: GoesOn) -> list[RuleFinding]:
    """Of each rule what it found under the case's seed; where that is near its limit, what further draws decide.

    `check`: what a rule finds of a case. `goes_on` is called before each further draw. Where one refuses beyond any
    luck, nothing is drawn.
    """
    every = [(rule, k, one) for rule, some in found for k, one in enumerate(some)]
    drawn = [[one] if _is_near(one, rule, case) else None for rule, _, one in every]
    if any(not one.passed for (_, _, one), draws in zip(every, drawn, strict=True) if draws is None):
        return [one for _, _, one in every]
    slow = case.proposal.kind == "gains" and isinstance(case.controller, MpcConfig)
    looks = LOOKS_SLOW if slow else LOOKS
    for before, number in pairwise(looks):
        if not (open_ := [i for i, draws in enumerate(drawn) if draws is not None and _decided(draws) is None]):
            break
        for draw in range(before, number):
            goes_on()
            other = replace(case, seed=_further(case.seed, draw))
            again = {
                rule.name: list(check(rule, other)) for rule in {every[i][0].name: every[i][0] for i in open_}.values()
            }
            for i in open_:
                rule, k, one = every[i]
                draws = drawn[i]
                assert draws is not None  # it is open
                draws.append(_same(again[rule.name], k, one.rule))
    settled = zip(every, drawn, strict=True)
    return [one if draws is None else _settled(draws) for (_, _, one), draws in settled]


def words_on(before: Sequence[RuleFinding], after: Sequence[RuleFinding]) -> list[RuleFinding]:
    """What to report of those that were drawn again."""
    return [
        told(RULE, True, f"{one.rule} is near its limit: it was drawn several times")
        for one, settled in zip(before, after, strict=True)
        if one is not settled
    ]


def _further(seed: int, number: int) -> int:
    return int.from_bytes(sha256(f"{seed} {number}".encode()).digest()[:SEED_BYTES])


def _is_near(finding: RuleFinding, rule: Rule, case: Case) -> bool:
    """Whether another draw may come out otherwise."""
    if case.first and not rule.luck_when_first:
        return False
    share = share_of(finding, case.tension_step_n)
    return share is not None and abs(share) < rule.luck


def _same(again: Sequence[RuleFinding], k: int, name: str) -> RuleFinding:
    """The finding in the same place, which a rule that fails does not have."""
    if k < len(again) and again[k].rule == name:
        return again[k]
    return told(name, False, "a further draw found nothing")


def _decided(drawn: Sequence[RuleFinding]) -> bool | None:
    """Whether the mean margin is above 0; None: the interval does not tell.

    A draw that fails without a number is beyond any limit; of what is a limit of each draw one that fails is enough.
    """
    if any(not one.passed and (one.margin is None or one.rule.endswith(OF_EACH)) for one in drawn):
        return False
    margins = [one.margin for one in drawn if one.margin is not None]
    if (quantile := T_99.get(len(margins))) is None:
        return None
    mean, half = fmean(margins), quantile * stdev(margins) / sqrt(len(margins))
    return None if abs(mean) <= half else mean > 0.0


def _settled(drawn: Sequence[RuleFinding]) -> RuleFinding:
    """The worst of the draws that came out as is decided; what cannot be told is refused where any draw was."""
    if len(drawn) == 1:
        return drawn[0]
    decided = _decided(drawn)
    passed = all(one.passed for one in drawn) if decided is None else decided
    alike = [one for one in drawn if one.passed is passed] or drawn
    worst = min(alike, key=lambda one: -inf if one.margin is None else one.margin)
    return worst.model_copy(update={"passed": passed})
