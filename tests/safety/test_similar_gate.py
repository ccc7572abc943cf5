"""The gate judges a line by what it is, not by its size: scaled proposals get the same verdicts, rule by rule.

Unless a margin is so small that rounding decides: eigenvalues and filters are not computed with powers of two.
"""

from functools import cache

import numpy as np
import pytest

from gateway.control.design import design_lqi, task_on
from gateway.core.controller_laws import LqiConfig
from gateway.core.judge_context import DataReference, JudgeContext
from gateway.core.line_model import LineModel, model_hash, noise_of, theta_of
from gateway.core.proposal import canonical
from gateway.core.verdict import Verdict
from safety.judge import judge
from tests.safety.case_support import MADE, Setting, gains, proposal, published
from tests.support.similar import Similar

SIZES = {
    "foil of 0.1 N": Similar(force=2.0**-9),
    "laminator of 15 kN, 8 m/s": Similar(force=2.0**8, length=2.0**6),
    "four times as fast": Similar(2.0, 2.0, 2.0**-2),
}
CLOSE = 1e-6
#: Rules that look at predictions, which begin after the longest lag that a drive may have: a device's time, in seconds.
OF_DEVICES = ("model", "alignment")
WILD = ("corners",)


def sized(size: Similar) -> Setting:
    """The published setting, larger or smaller."""
    of = published()
    line = size.line(of.line)
    recording = size.recording(of.recording)
    return Setting(line, recording, size.model(of.model, recording))


def context_of(of: Setting, size: Similar, in_service: LqiConfig, model: LineModel | None) -> JudgeContext:
    state = size.scaled(published().context().state.model_dump(mode="json"))
    data = [DataReference(path="experiment.csv", digest=of.recording.digest(), recorded=MADE)]
    return published().context(
        state=type(published().context().state).model_validate(state), in_service=in_service, model=model, data=data
    )


@cache
def laws() -> tuple[LqiConfig, dict[str, LqiConfig]]:
    """What is in service, and what is proposed: a good law, and ones that are too quick, too slow or turned round."""
    of = published()
    in_service = of.context().in_service
    good = design_lqi(task_on(of.line, theta_of(of.model), noise_of(of.model)))
    assert isinstance(in_service, LqiConfig)

    def times(share: float) -> LqiConfig:
        return good.model_copy(update={"gain_state": (share * np.array(good.gain_state)).tolist()})

    return in_service, {"good": good, "quick": times(3.0), "slow": times(0.5), "turned": times(-1.0)}


def verdict(size: Similar, name: str, *, first: bool) -> Verdict:
    of, (in_service, proposed) = sized(size), laws()
    context = context_of(of, size, size.lqi(in_service), None if first else of.model)
    given = gains(size.lqi(proposed[name]), context)
    return judge(canonical(given), context, of.line, [of.recording], 1)


@cache
def verdict_as_in_the_file(name: str, first: bool) -> Verdict:
    return verdict(Similar(), name, first=first)


def compared(one: Verdict, other: Verdict, but: tuple[str, ...] = ()) -> None:
    """Same rules, and each passed alike, unless its margin is nothing; of what passes by as much, but of some rules."""
    assert [found.rule for found in other.findings] == [found.rule for found in one.findings]
    for mine, its in zip(one.findings, other.findings, strict=True):
        both = [(found.margin, found.limit) for found in (mine, its)]
        margins = [margin / limit for margin, limit in both if margin is not None and limit]
        if any(abs(margin) < CLOSE for margin in margins):
            continue
        assert its.passed == mine.passed, (mine.text, its.text)
        if len(margins) == 2 and mine.passed and not mine.rule.startswith(but):
            assert margins[1] == pytest.approx(margins[0], rel=CLOSE, abs=CLOSE), (mine.text, its.text)


@pytest.mark.parametrize(
    ("size", "name", "first"),
    [*((size, *which) for size in SIZES for which in (("good", False), ("slow", True))),
     ("laminator of 15 kN, 8 m/s", "quick", False), ("four times as fast", "turned", False)],
)  # fmt: skip
def test_a_proposal_for_a_line_of_any_size_gets_the_same_verdict(size: str, name: str, first: bool) -> None:
    one, other = verdict_as_in_the_file(name, first), verdict(SIZES[size], name, first=first)
    # A loop that swings from limit to limit goes its own way after the last digit: of it only the verdict is compared.
    compared(one, other, OF_DEVICES if one.accepted else (*OF_DEVICES, *WILD))


@pytest.mark.parametrize("size", SIZES)
def test_so_does_a_model(size: str) -> None:
    def judged(by: Similar) -> Verdict:
        of = sized(by)
        context = context_of(of, by, by.lqi(laws()[0]), of.model)
        given = proposal({"kind": "model", "model": of.model.model_dump(mode="json")}, context)
        return judge(canonical(given), context, of.line, [of.recording], 1)

    compared(judged(Similar()), judged(SIZES[size]), OF_DEVICES)


def test_verdicts_differ_so_that_likeness_says_something() -> None:
    assert verdict_as_in_the_file("good", False).accepted != verdict_as_in_the_file("turned", False).accepted
    assert model_hash(published().model)
