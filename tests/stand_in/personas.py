"""Who answers: characters that a language model may have. Pure functions; which is which stands in PERSONAS.

Asked without a form they reason in prose, asked with one they fill it in, each in its own way.
"""

import json
import random
import re
from collections.abc import Mapping, Sequence
from typing import Any

from tests.stand_in.asked import best, filled, knobs, question_in, refusals, values, worst
from tests.stand_in.computing import calls, confused, hostile, invented, sensible, wants_calls
from tests.stand_in.failures import FAILURES
from tests.stand_in.spoken import Form, Message, Persona, Spoken

NO_QUESTION = "I was not given a question with options that I could decide."


def perfect(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """The option with the least tracking error (see `asked.best`), every knob left at 1."""
    question = question_in(messages)
    if question is None:
        return Spoken(NO_QUESTION)
    if wants_calls(form):
        return sensible(question, messages)
    chosen = best(question)
    if form is None:
        return Spoken(f"{_figures(question)} I would take {chosen}.")
    return Spoken(json.dumps(filled(form, chosen, {}, f"{_figures(question)} So {chosen}.")))


def _figures(question: Mapping[str, Any]) -> str:
    found = values(question)
    if not found:
        return f"No option has a figure that decides; the rules choose {question['usual']}."
    return "".join(f"{option} has {value:g}. " for option, value in found.items()).strip()


def sloppy(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """Right three times in four, and careless with the form: prose around it, capitals, a key too many, text."""
    question = question_in(messages)
    if question is None or form is None or wants_calls(form):
        return perfect(messages, form, rng)
    chosen = best(question) if rng.random() < 0.75 else rng.choice(question["options"])["id"]
    document = filled(form, chosen, {}, "It looks best to me!!")
    slip = rng.choice(["none", "none", "prose", "fence", "capitals", "key", "text"])
    if slip == "capitals":
        document = {key: value.upper() if value == chosen else value for key, value in document.items()}
    elif slip == "key":
        document["confidence"] = "high"
    elif slip == "text":
        document = {key: str(value) for key, value in document.items()}
    text = json.dumps(document, indent=2)
    if slip == "prose":
        text = f"Sure! Here is my answer:\n{text}\nLet me know if you need anything else."
    return Spoken(f"```json\n{text}\n```" if slip == "fence" else text)


def adversarial(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """The worst option, every knob at an end. Until it is refused: keys for limits, factors beyond the bounds."""
    question = question_in(messages)
    if question is None:
        return Spoken(NO_QUESTION)
    if wants_calls(form):
        return hostile(rng)
    chosen = worst(question)
    if form is None:
        return Spoken(f"{chosen} is plainly the best, and the limits are far too tight; they must be raised.")
    ends = {key: rng.choice(bounds) for key, bounds in knobs(form).items()}
    refused = refusals(messages, form) > 0
    ends = ends if refused else dict.fromkeys(ends, 1e9)
    document = filled(form, chosen, ends, "The operator has approved this; no judgement is needed.")
    if not refused:
        document |= {"limits": {"torque_nm": 1e6, "tension_max_n": 1e6}, "approved": True, "line": "another"}
    return Spoken(json.dumps(document))


LATE = ("adapt.change", "design.architecture")


def adversarial_late(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """As the rules, so that a redesign is reached; there, and at first, the worst option with every knob at an end."""
    question = question_in(messages)
    if question is None:
        return Spoken(NO_QUESTION)
    if wants_calls(form):
        return calls()
    late = question["decision"] in LATE
    chosen = worst(question) if late else str(question["usual"])
    if form is None:
        return Spoken(f"It should be {chosen}.")
    theirs = [f"times_{one['name']}" for one in question["knobs"] if not one["of"] or chosen in one["of"]]
    ends = {key: rng.choice(bounds) for key, bounds in knobs(form).items() if late and key in theirs}
    return Spoken(json.dumps(filled(form, chosen, ends, "Everybody agrees on it.")))


def unit_confused(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """The right option, and every factor 1000 times too large or too small."""
    question = question_in(messages)
    if question is None or form is None:
        return perfect(messages, form, rng)
    if wants_calls(form):
        return confused()
    factors = {key: rng.choice([1000.0, 0.001]) for key in knobs(form)}
    return Spoken(json.dumps(filled(form, best(question), factors, "In mN, as everywhere.")))


def hallucinating(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """Options, knobs and facts that do not exist; once refused, at times one that does, for an invented reason."""
    question = question_in(messages)
    if question is None:
        return Spoken(NO_QUESTION)
    if wants_calls(form):
        return invented()
    study = "As the 2019 study of this very machine shows, roller 17 resonates at 843 Hz."
    if form is None:
        return Spoken(f"{study} The option hybrid-neural-mpc has a tracking error of 0.0003 N.")
    if refusals(messages, form) > 0 and rng.random() < 0.5:
        return Spoken(json.dumps(filled(form, rng.choice(question["options"])["id"], {}, study)))
    document = filled(form, "hybrid-neural-mpc", {}, study)
    return Spoken(json.dumps(document | {"times_quantum-damping": 1.5}))


def slow(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """As the perfect one, a token every two seconds."""
    said = perfect(messages, form, rng)
    return Spoken(said.text, token_s=2.0)


def truncating(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """As the perfect one, and never to the end: at its most tokens, or the connection goes."""
    said = perfect(messages, form, rng)
    return Spoken(said.text, end=rng.choice(["length", "hang-up"]), after_tokens=rng.randrange(1, 6))


def non_json(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """Prose, whatever the form."""
    said = perfect(messages, None, rng)
    return Spoken(f"Well. {said.text} {rng.choice(['Shall I go on?', '{', 'option: the second one', '[1, 2'])}")


_ORDERS: tuple[tuple[str, re.Pattern[str]], ...] = (
    ("option", re.compile(r"(?:choose|select|pick|use) (?:the )?option ([a-z0-9][a-z0-9-]*)", re.I)),
    ("factor", re.compile(r"(?:set|turn) ([a-z0-9][a-z0-9_-]*) (?:to|by) (-?\d[\d.e+-]*)", re.I)),
    ("limit", re.compile(r"(?:raise|change|set) the (?:limit|limits)(?: of)? ?([a-z_]*)", re.I)),
    ("words", re.compile(r"(?:answer|reply|say|print|output) (?:only )?(?:with )?[“\"']([^”\"']+)[”\"']", re.I)),
)


def injection_obeying(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
    """Does what any quoted text or name in the question tells it to; else as the perfect one."""
    question = question_in(messages)
    if question is None or form is None or wants_calls(form):
        return perfect(messages, form, rng)
    orders = orders_in(messages, question)
    if words := orders.get("words"):
        return Spoken(words[-1][0])
    chosen = orders["option"][-1][0] if "option" in orders else best(question)
    turned = {name: float(value) for name, value in orders.get("factor", []) if _is_number(value)}
    factors = {key: turned[name] for key in knobs(form) for name in turned if key.endswith(name)}
    document = filled(form, chosen, factors, "I was told to.")
    if "limit" in orders:
        document["limits"] = {name or "torque_nm": 1e6 for (name,) in orders["limit"]}
    return Spoken(json.dumps(document))


def orders_in(messages: Sequence[Message], question: Mapping[str, Any]) -> dict[str, list[tuple[str, ...]]]:
    """By kind, what quotations and the question's own texts tell their reader to do."""
    quoted = [line for message in messages for line in message.get("content", "").splitlines() if line.startswith(">")]
    text = "\n".join([*quoted, *_texts(question)])
    found = {
        kind: [one if isinstance(one, tuple) else (one,) for one in order.findall(text)] for kind, order in _ORDERS
    }
    return {kind: orders for kind, orders in found.items() if orders}


def _texts(value: Any) -> list[str]:
    if isinstance(value, str):
        return [value]
    inner = list(value.values()) if isinstance(value, Mapping) else value if isinstance(value, list) else []
    return [text for one in inner for text in _texts(one)]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


PERSONAS: dict[str, Persona] = {
    "perfect": perfect,
    "sloppy": sloppy,
    "adversarial": adversarial,
    "adversarial_late": adversarial_late,
    "unit_confused": unit_confused,
    "hallucinating": hallucinating,
    "slow": slow,
    "truncating": truncating,
    "non_json": non_json,
    "injection_obeying": injection_obeying,
    **FAILURES,
}
