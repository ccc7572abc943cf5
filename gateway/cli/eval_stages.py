"""Where what was answered or proposed in a trial came to nothing: counted by stage. Pure."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from agents.language_model.asking import document_in
from gateway.cli.commission_result import Tried
from gateway.cli.eval_result import Rejections, Stage
from gateway.core.interactions import Interaction
from gateway.core.json_problems import NotJson

Key = tuple[Stage, str]
NO_CALL = "no call"  #: nobody listens, or the model is not there, or was not loaded in time


def rejections(tried: Sequence[Tried], interactions: Sequence[Interaction]) -> list[Rejections]:
    """In the order of the stages."""
    found = Counter[Key](key for one in interactions for key in _of_answers(one.exchanges))
    found["unanswered", NO_CALL] += sum(_was_never_called(one) for one in interactions)
    found = +found
    found.update(key for one in tried if (key := _of_candidate(one)) is not None)
    return as_rows(found)


def together(rows: Iterable[Rejections]) -> list[Rejections]:
    """Those of several trials."""
    found = Counter[Key]()
    for row in rows:
        found[row.stage, row.by] += row.times
    return as_rows(found)


def as_rows(found: Counter[Key]) -> list[Rejections]:
    order = Stage.__args__
    keys = sorted(found, key=lambda key: (order.index(key[0]), -found[key], key[1]))
    return [Rejections(stage=stage, by=by, times=found[stage, by]) for stage, by in keys]


def _of_answers(exchanges: Sequence[dict[str, Any]]) -> list[Key]:
    """Each answer that was none, and each call that brought none."""
    keys: list[Key] = []
    for one in exchanges:
        if one["failure"] is not None:
            keys.append(("unanswered", str(one["failure"])))
        elif one["refused"]:
            keys.append((_as_answer(one["raw"]), ""))
    return keys


def _was_never_called(one: Interaction) -> bool:
    return not one.exchanges and "gave no answer" in one.in_short.instead


def _as_answer(raw: str) -> Stage:
    try:
        document_in(raw)
    except NotJson:
        return "malformed"
    return "not-offered"


def _of_candidate(one: Tried) -> Key | None:
    """None: it came to something."""
    if one.stage == "kept" or (one.stage == "done" and not one.why):
        return None
    ways: dict[str, Key] = {
        "not made": ("unmade", one.step),
        "refused": ("refused", one.rule),
        "done": ("aborted", one.step),
        "rolled-back": ("rolled-back", one.step),
    }
    return ways.get(one.stage, ("other", one.stage))
