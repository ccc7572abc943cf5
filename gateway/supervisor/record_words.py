"""A record of the audit as a sentence for people. Pure: made here out of its fields, never by a language model.

What people and agents wrote themselves is told as a quotation, shortened, and without what plays with a screen.
"""

from collections.abc import Callable, Mapping
from typing import Any

from pydantic import ValidationError

from gateway.core.finding import Finding, finding
from gateway.core.line_problem import printable, quoted
from gateway.wording.catalogue import ENGLISH, sentence, sentences

LONGEST_QUOTE = 200  #: characters
LONGEST_TOLD = 400  #: of what this program has found itself
SHORT = 12  #: letters of a hash

What = Mapping[str, Any]


def in_a_sentence(kind: str, who: str, what: What, reason: str = "", language: str = ENGLISH) -> str:
    """`reason`: of a proposal, by whoever made it. A kind that is not known here is told as it is called.

    Of another language than English only where `IN_EVERY_LANGUAGE` has the kind.
    """
    if (told := IN_EVERY_LANGUAGE.get(kind)) is not None:
        return told(_clean(who, 200), what, language)
    tell = SENTENCES.get(kind)
    if tell is None:
        return _clean(f"{kind}, by {who}", LONGEST_TOLD)
    return tell(_clean(who, 200), {**what, "reason": reason} if kind == "proposed" else what)


def _said(text: object) -> str:
    """In quotation marks, with what leads to it; empty where nothing was said."""
    said = str(text or "").strip()
    return f": {quoted(said, LONGEST_QUOTE)}" if said else ""


def _clean(text: str, most: int) -> str:
    plain = printable(" ".join(text.split())).replace("\u201c", '"').replace("\u201d", '"')
    return plain if len(plain) <= most else f"{plain[: most - 1]}\u2026"


def _of(what: What, key: str) -> str:
    """A field as it may be shown; ? where a record of another version lacks it."""
    return _clean(str(what.get(key, "?")), 80)


def _hash(what: What, key: str = "proposal") -> str:
    return _of(what, key)[:SHORT]


def _because(what: What) -> str:
    """What this program has found."""
    said = _clean(str(what.get("because") or ""), LONGEST_TOLD)
    return f": {said}" if said else ""


def _proposed(_: str, what: What) -> str:
    return f"{_of(what, 'author')} proposes {_of(what, 'change')} {_hash(what)}{_said(what['reason'])}"


def _approved(who: str, what: What) -> str:
    if what.get("by") == "verdict":
        return f"proposal {_hash(what)} passes by its verdict alone: it is like {_hash(what, 'like')}"
    second = f" as the second, after {_of(what, 'first')}" if "first" in what else ""
    return f"{who} approves proposal {_hash(what)}{second}{_said(what.get('comment'))}"


def _approved_once(who: str, what: What) -> str:
    return f"{who} approves proposal {_hash(what)} as the first of two{_said(what.get('comment'))}"


def _deployed(_: str, what: What) -> str:
    return f"proposal {_hash(what)} controls the line as epoch {_of(what, 'epoch')}, on probation"


def _rolled_back(_: str, what: What) -> str:
    return f"proposal {_hash(what)} is taken back, {_hash(what, 'to')} controls the line{_because(what)}"


def _experiment_ends(_: str, what: What) -> str:
    return (
        f"the experiment of proposal {_hash(what)} {'has ended' if what.get('because') else 'is done'}{_because(what)}"
    )


def _found(_: str, what: What) -> str:
    odd = "" if what.get("explained", True) else "; the records do not explain how it came to that"
    epoch = _of(what, "epoch")
    return f"the loop says that it runs {_hash(what, 'configuration')}, epoch {epoch}{_because(what)}{odd}"


def _wiring_proved(_: str, what: What) -> str:
    answers = what.get("answers")
    asked = [one for one in answers if isinstance(one, Mapping)] if isinstance(answers, list) else []
    by = sorted({_clean(str(one.get("by", "-")), LONGEST_TOLD) for one in asked})
    told = f"; {len(asked)} questions answered by {', '.join(by)}" if asked else ""
    return f"the wiring is proved: {_hash(what, 'wiring')}{told}"


def _operated(who: str, what: What) -> str:
    done = "done" if what.get("done") else "refused"
    return (
        f"{who}: {_of(what, 'command')}: {done}: {_clean(str(what.get('answer', '')), LONGEST_TOLD)}{_left_out(what)}"
    )


def _archived(who: str, what: What) -> str:
    kept = f"configuration {_hash(what, 'configuration')} (version {_of(what, 'version')}) as {_of(what, 'name')}"
    return f"{who} keeps {kept}{_said(what.get('because'))}"


def _not_archived(_: str, what: What) -> str:
    return f"configuration {_hash(what, 'configuration')} could not be kept as {_of(what, 'name')}{_because(what)}"


def _shelved(who: str, what: What) -> str:
    alarm, for_s = _of(what, "alarm"), what.get("for_s", 0.0)
    if not for_s:
        return f"{who} takes alarm {alarm} off the shelf{_said(what.get('because'))}"
    return f"{who} shelves alarm {alarm} for {for_s / 60.0:.0f} min{_said(what.get('because'))}"


def _left_out(what: What) -> str:
    """Of what came too often."""
    count = what.get("left_out", 0)
    return f" (and {count} times before, which are not on record)" if isinstance(count, int) and count > 0 else ""


def _refused_person(who: str, what: What) -> str:
    return f"{who} was refused {_of(what, 'command')}{_because(what)}{_left_out(what)}"


def _refused_decision(who: str, what: What) -> str:
    word = "approval" if what.get("approve") else "rejection"
    return f"{who}: {word} of proposal {_hash(what)} was refused{_because(what)}{_left_out(what)}"


def _refused_proposal(who: str, what: What) -> str:
    return f"a proposal of {who} was not taken{_because(what)}{_left_out(what)}"


def _logged_in(who: str, what: What) -> str:
    untold = what.get("untold", 0)
    others = f" (and {untold} others before, of whom nothing else is known)" if untold else ""
    return f"{who} has come in from {_of(what, 'address')}{_left_out(what)}{others}"


def _wrong_logins(_: str, what: What) -> str:
    places: list[Any] = what["places"] if isinstance(what.get("places"), list) else []
    told = [
        f"{_of(one, 'count')} from {_of(one, 'address')} ({_of(one, 'through')})"
        for one in places if isinstance(one, Mapping)
    ]  # fmt: skip
    more = what.get("elsewhere", 0)
    return _clean(f"wrong names or passwords: {', '.join([*told, *([f'{more} elsewhere'] if more else [])])}",
                  LONGEST_TOLD)  # fmt: skip


def _users(_: str, what: What) -> str:
    changes: list[Any] = what["changes"] if isinstance(what.get("changes"), list) else []
    if changes:
        return _clean(f"users have changed: {', '.join(map(str, changes))}", LONGEST_TOLD)
    roles = what.get("roles")
    named = [f"{name} ({role})" for name, role in roles.items()] if isinstance(roles, Mapping) else []
    return _clean(f"users are {', '.join(named) or 'nobody'}", LONGEST_TOLD)


def _line_stopped(who: str, what: What, language: str) -> str:
    """What was found in words only stands at the end of what the loop said then."""
    code = "line-stopped-by-person" if what.get("by_person") else "line-stopped"
    said = sentence(finding(code, who=who, phase=_of(what, "phase")), language)
    told = sentences(_findings(what), language)
    return f"{said}{': ' if told else ''}{_clean(told, 2 * LONGEST_TOLD)}{_left_out(what)}"


def _findings(what: What) -> list[Finding]:
    try:
        return [Finding.model_validate(one) for one in what.get("findings") or ()]
    except (TypeError, ValidationError):  # a record of another version
        return []


def _of_proposal(text: str) -> Callable[[str, What], str]:
    return lambda who, what: f"proposal {_hash(what)} {text}{_because(what)}"


#: Kinds that are told in the language that is asked for.
IN_EVERY_LANGUAGE: dict[str, Callable[[str, What, str], str]] = {"line-stopped": _line_stopped}

#: By kind. What is written down of a person's own words is quoted.
SENTENCES: dict[str, Callable[[str, What], str]] = {
    "proposed": _proposed,
    "accepted": _of_proposal("is accepted by the gate"),
    "refused": _of_proposal("is refused by the gate"),
    "approved-once": _approved_once,
    "approved": _approved,
    "approval-lapsed": _of_proposal("waits again"),
    "rejected": lambda who, what: f"{who} rejects proposal {_hash(what)}{_said(what.get('comment'))}",
    "expired": _of_proposal("has expired"),
    "superseded": _of_proposal("is superseded"),
    "deploying": lambda who, what: f"proposal {_hash(what)} goes to the loop as epoch {_of(what, 'epoch')}",
    "not-deployed": _of_proposal("was not taken by the loop"),
    "put-off": _of_proposal("was not taken by the loop now, and waits again"),
    "deployed": _deployed,
    "keeping": _of_proposal("is about to be kept"),
    "kept": _of_proposal("is kept"),
    "rolled-back": _rolled_back,
    "experiment-begins": _of_proposal("begins: an experiment runs"),
    "experiment-ends": _experiment_ends,
    "model-in-service": lambda who, what: f"proposals are judged by model {_hash(what, 'model')} from now on",
    "found-in-service": _found,
    "confirmed": lambda who, what: f"{who} confirms {_hash(what, 'configuration')}{_said(what.get('because'))}",
    "refused-at-loop": lambda _, what: f"at the loop was refused{_because(what)}{_left_out(what)}",
    "set-aside": lambda _, what: f"the loop has set aside what lay in its folder{_because(what)}",
    "rollback-asked": lambda who, what: f"{who} asks for what was before{_said(what.get('comment'))}{_left_out(what)}",
    "wiring-proved": _wiring_proved,
    "line-changed": lambda who, what: f"{who} says that the line has changed{_said(what.get('because'))}",
    "archived": _archived,
    "not-archived": _not_archived,
    "operated": _operated,
    "refused-person": _refused_person,
    "refused-decision": _refused_decision,
    "refused-proposal": _refused_proposal,
    "false-loop": lambda who, what: f"a false loop{_because(what)}{_left_out(what)}",
    "logged-in": _logged_in,
    "wrong-logins": _wrong_logins,
    "users": _users,
    "acknowledged": lambda who, what: f"{who} has seen alarm {_of(what, 'alarm')}{_said(what.get('comment'))}",
    "shelved": _shelved,
    "malformed-proposal": lambda who, what: f"{who} sent what is no proposal",
    "agents": lambda who, what: f"agents, {_of(what, 'times')} times {_of(what, 'case')}{_said(what.get('newest'))}",
    "gateway-start": lambda who, what: f"the gateway has started, version {_of(what, 'version')}",
    "begun": lambda who, what: "the audit has begun",
    "not-done": lambda who, what: f"records {_of(what, 'sequences')} were stored, and nothing came of them",
}
