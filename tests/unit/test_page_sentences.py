"""The sentences that the page says in other languages, against the code of the gate and the loop that composes them."""

import ast
import json
import re
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import pytest

from gateway.operator.page.words import NAMED, catalogue, sentences, words_of

#: What is composed here is read by whoever decides on a change, or looks after the line.
COMPOSE = (
    "safety", "gateway/core/differences.py", "gateway/core/doubts.py", "gateway/core/experiment.py::reasons_against",
    "gateway/supervisor/alarm_conditions.py",
)  # fmt: skip
#: Names of findings of the loop, fields of them, refusals of files that are none, and what no person is told.
NO_SENTENCES = {
    "warming up", "in service", "Callable[[Case], T]", "dict[str, Any]",
    "7 has no programme", "7 N", "7 %", "7 m/s",
}  # fmt: skip
#: What is put together of more than one text of the code: the texts, and what comes out.
PUT_TOGETHER = {
    ("7 are needed", "7: this counts neither for it nor against it; 7"): (
        "the load cell of span 3 has told 40% of its samples, 80% are needed",
        "of torque 3 10% of the changes were seen, 25% are needed",
        "the newest telemetry is 2.0 s old: this counts neither for it nor against it",
        "too little was seen of it for 60 s: the newest telemetry is 2.0 s old",
    ),
    ("7 7 7 7 7, allowed: 7 7", "is off by", "swings by", "chatters by"): (
        "tension 3 is off by 4.20 N, allowed: 3.00 N",
        "tension 3 swings by 4.20 N, allowed: 3.00 N",
        "torque 3 chatters by 7.20 Nm, allowed: 5.00 Nm",
    ),
    ("7 in 7: 7, 7 7; allowed: up to 77", "7 7", "without end"): (
        "tracking error in velocity: 0.887 N, in service 0.968 N; allowed: up to 1.07 N",
        "settling time in velocity: never, baseline 0.3 s; allowed: up to 0.4 s",
        "tracking error in velocity: without end, baseline 0.968 N; allowed: up to 1.07 N, compared up to 0.1 m/s and "
        "steps of 24 N",
        "tracking error in velocity: 0.887 N, in service 0.968 N; allowed: up to 1.07 N, compared up to 0.1 m/s and "
        "steps of 24 N",
    ),
    ("author is 7; allowed: gate.authors, which are 77",): (
        "author is operater; allowed: gate.authors, which are operator, agents; did you mean operator?",
    ),
    ("the loop stands 7 ms7 beyond a latency of 7 ms, at 7 m/s; allowed: gate.delay_margin_min_s, 7 ms, and more",): (
        "the loop stands 3.2 ms beyond a latency of 10.0 ms, at 0.005 m/s; allowed: gate.delay_margin_min_s, 4 ms, and "
        "more",
        "the loop stands 8.0 ms or more beyond a latency of 10.0 ms, at 0.005 m/s; allowed: gate.delay_margin_min_s, "
        "4 ms, and more",
    ),
    ("data have shown the model up to 7 m/s; the line runs at 7 m/s",): (
        "data have shown the model up to 0.05 m/s; the line runs at 0.1 m/s: run an experiment at 0.1 m/s or more "
        "(r2rgate experiment), then propose again",
    ),
    (
        "no recent data show the model: of 7, none has 7 s at one speed in which every tension moves by 7 times its "
        "noise; 7",
        "7 recordings",
        "7 recordings, 7 of them older than 7 s",
    ): (
        "no recent data show the model: of 3 recordings, 1 of them older than 3600 s, none has 2 s at one speed in "
        "which every tension moves by 5 times its noise; run an experiment at 0.1 m/s or more (r2rgate experiment), "
        "then propose again",
        "no recent data show the model: of 0 recordings, none has 2 s at one speed in which every tension moves by 5 "
        "times its noise; run an experiment at 0.1 m/s or more (r2rgate experiment), then propose again",
    ),
    ("the model says that it was made up to 7 m/s; the data go to 7",): (
        "the model says that it was made up to 0.1 m/s; the data go to 0.05 m/s",
    ),
    ("7: 7 has 7 values in place of 7",): (
        "feed-forward: length_m has 5 values in place of 6",
        "model: length_m has 5 values in place of 6",
    ),
    (
        "7 plants that the line may be, and 7 late, 7 courses each, ", "7 shared out, up to 7 m/s and steps of 7 N",
        "7 of 7",
    ): (
        "32 plants that the line may be, and 2 late, 3 courses each, 6 shared out, up to 0.05 m/s and steps of 24 N",
        "32 plants that the line may be, and 2 late, 3 courses each, 6 shared out, up to 0.05 m/s and steps of 24 N; "
        "left out, because no controller holds them with 60 Nm: 2 of neighbours, 1 of one after another",
    ),
    (
        "the slowest mode decays at 7 1/s", "the loop is unstable",
        "7 at 7 m/s on the worst of 7 plants that the line may be; allowed: 7 1/s and more (gate.decay_min_per_s)",
        "7 at 7 m/s on the worst of 7 plants that the line may be; allowed: 7 1/s and more (gate.decay_min_per_s, or "
        "half of what a draw span has by itself)",
    ): (
        "the slowest mode decays at 0.51 1/s at 0.005 m/s on the worst of 9 plants that the line may be; allowed: 0.05 "
        "1/s and more (gate.decay_min_per_s)",
        "the slowest mode decays at 0.51 1/s at 0.005 m/s on the worst of 9 plants that the line may be; allowed: 0.05 "
        "1/s and more (gate.decay_min_per_s, or half of what a draw span has by itself)",
        "the loop is unstable at 0.005 m/s on the worst of 9 plants that the line may be; allowed: 0.05 1/s and more "
        "(gate.decay_min_per_s)",
        "the loop is unstable at 0.005 m/s on the worst of 9 plants that the line may be; allowed: 0.05 1/s and more "
        "(gate.decay_min_per_s, or half of what a draw span has by itself)",
    ),
    (
        "no step at all", "a step of 7 N of one span",
        "7 keeps rollers below 7 m/s, of 7 m/s at which torque goes off: a calmer law is needed",
    ): (
        "a step of 2.1 N of one span keeps rollers below 0.16 m/s, of 0.18 m/s at which torque goes off: a calmer law "
        "is needed",
        "no step at all keeps rollers below 0.16 m/s, of 0.18 m/s at which torque goes off: a calmer law is needed",
    ),
    ("7 is 7 of 7; allowed: 7 and more: the model ", "takes the noise for greater than it is"): (
        "normalised innovation squared at 0.05 m/s over 2.6 s is 0.71 of tension 3; allowed: 0.75 and more: the model "
        "takes the noise for greater than it is",
    ),
    ("7: 7 7", "7 to 7 %", "7 changes by 7 %7"): (
        "feed-forward: stiffness_n +3.1 %",
        "feed-forward: stiffness_n -0.1 to +0.2 %",
        "model: radius_m +3.1 %",
        "model: radius_m -0.1 to +0.2 %",
        "A changes by 3.1 %",
        "A changes by 3.1 %; 2 large entries change their sign",
    ),
    ("7; allowed: 7 to 7 N", "7, set to 7 N"): (
        "span 3 nip: 61.0 N; allowed: 2 to 60 N",
        "span 3 nip: 21.0 N, set to 28.0 N",
    ),
    (
        "7, small", "7, late", "7, small, late", "on 7 7", "on 7 7, 7 left out", "corners of the line's file",
        "corners of the accepted model", "speed change", "none of 7 7 is held by the torque at these speeds: go slower",
    ): (
        "tension falls to 8.17 N (neighbours, small, late); allowed: down to 2 N",
        "tension falls to 8.1 N (on 32 corners of the line's file, 2 left out); allowed: down to 2 N",
        "tension rises to 8.1 N (on 32 corners of the accepted model); allowed: up to 60 N",
        "none of 32 corners of the accepted model is held by the torque at these speeds: go slower",
        "none of 32 corners of the line's file is held by the torque at these speeds: go slower",
    ),
    ("the line's file", "the model 7", "the line's file: no model is accepted", "the model in service"): (
        "it was made by the line's file; allowed: the model 0123456789ab",
        "it was made by the model 0123456789ab; allowed: the line's file: no model is accepted",
        "the data are likelier by 3 in the logarithm than by the model in service; allowed: -2 and more",
    ),
    (
        "the model was made from these recordings", "these recordings came after the model", "has not begun",
        "has given no verdict", "normalised innovation squared at 7 m/s over 7 s", "torque 7", "unwinder speed",
        "run an experiment at 7 m/s or more (r2rgate experiment), then propose again", "no end",
    ): (
        "these recordings came after the model",
        "the model was made from these recordings",
        "the judge has not begun within 20 s, and none in time is a refusal",
        "torque 3 tells -0.1 ms late, within 0.5 ms; allowed: gate.alignment_max_s, 2 ms either way, as far as its "
        "interval goes; 18 of 18 channels tell",
        "tension falls to no end (neighbours); allowed: down to 2 N",
    ),
}  # fmt: skip
WHOLES = {one for wholes in PUT_TOGETHER.values() for one in wholes}
FRAGMENTS = NO_SENTENCES | {text for texts in PUT_TOGETHER for text in texts}
#: Names of devices, given or by number, and a bus's own error: nothing in it is the gateway's.
ENGLISH = {"7 on 7: 7", "load cell 7", "drive 7"}


def test_every_sentence_of_the_gate_and_the_loop_is_there():
    missing = [
        f"{where}: {sample}"
        for where, sample in composed()
        if sample not in FRAGMENTS | ENGLISH and not a_name(sample) and not is_there(sample)
    ]
    assert not missing, "\n".join(missing)


@pytest.mark.parametrize("whole", sorted(WHOLES))
def test_what_is_put_together_is_there(whole: str):
    assert is_there(whole)


def test_what_the_example_of_a_verdict_says_is_there():
    verdict = json.loads(Path("docs/examples/verdict.json").read_bytes())
    assert [one["text"] for one in verdict["findings"] + verdict["reported"] if not is_there(one["text"])] == []


@pytest.mark.parametrize(("english", "said"), [*sentences()["sentences"].items(), *sentences()["parts"].items()])
def test_a_sentence_has_the_same_places_to_fill_in_and_something_between_them(english: str, said: str):
    assert places(english) == places(said) and len(set(places(english))) == len(places(english))
    assert "}{" not in english


@pytest.mark.slow
def test_no_sentence_is_there_that_nobody_says():
    """Each is a text of the code, or what is put together of several."""
    spoken = {sample for _, sample in composed(everywhere=True)} | WHOLES
    unsaid = [one for one in sentences()["sentences"] if not any(pattern(one).fullmatch(text) for text in spoken)]
    assert not unsaid, "\n".join(unsaid)


def test_no_part_is_there_that_stands_in_no_code():
    """By the words that it always has."""
    code = "\n".join(
        file.read_text() for folder in ("safety", "gateway") for file in sorted(Path(folder).rglob("*.py"))
    )
    for part in sentences()["parts"]:
        assert all(piece.strip(" ,()") in code for piece in re.split(r"\{\w+\}", part)), part


def test_they_go_to_the_page_with_its_words_in_other_languages_only():
    assert words_of("de")["sentence.nothing is promised"] == "nichts ist zugesagt"
    assert words_of("de")["part.neighbours"] == "Nachbarn gemeinsam"
    assert not [key for key in words_of("en") if key.startswith(("sentence.", "part."))]


def places(text: str) -> list[str]:
    return re.findall(r"\{(\w+)\}", text)


def pattern(english: str) -> re.Pattern[str]:
    return re.compile(re.sub(r"\\\{\w+\\\}", ".+?", re.escape(english)), re.DOTALL)


SAID = [pattern(one) for one in sentences()["sentences"]]


def is_there(text: str) -> bool:
    return any(one.fullmatch(text) for one in SAID)


def a_name(text: str) -> bool:
    """Of a rule or a measure: in the catalogue by its parts."""
    known = {key.removeprefix(NAMED) for key in catalogue() if key.startswith(NAMED)} | {"7", "C_safe", "P_improved"}
    return all(part in known | {"S_robust"} for part in re.split(": |, ", text))


def composed(*, everywhere: bool = False) -> Iterator[tuple[str, str]]:
    """Where, and the text with 7 for what differs; each of the texts, where one of several constants is in it.

    Not what only goes on with another text.
    """
    for named in ("safety", "gateway") if everywhere else COMPOSE:
        name, _, function = named.partition("::")
        for file in [Path(name)] if name.endswith(".py") else sorted(Path(name).rglob("*.py")):
            tree: ast.AST = ast.parse(file.read_text())
            if function:
                (tree,) = (one for one in ast.walk(tree) if isinstance(one, ast.FunctionDef) and one.name == function)
            for node in _texts(tree):
                for sample in _choices(node):
                    if " " in sample.strip() and not sample.startswith((" ", ",", ";", ":")):
                        yield f"{file.as_posix()}:{node.lineno}", sample


def _texts(tree: ast.AST) -> Iterator[ast.expr]:
    """Strings that are no docstring and no part of another."""
    within = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))
        for inner in ast.walk(node)
        if inner is not node
    }
    for node in ast.walk(tree):
        if id(node) not in within and (
            isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))
        ):
            yield node


def _choices(node: ast.expr) -> list[str]:
    match node:
        case ast.Constant(value=str(text)):
            return [text]
        case ast.FormattedValue(value=value):
            return _choices(value)
        case ast.IfExp(body=body, orelse=orelse):
            return [*_choices(body), *_choices(orelse)]
        case ast.JoinedStr(values=values):
            return ["".join(one) for one in product(*map(_choices, values))]
        case _:
            return ["7"]
