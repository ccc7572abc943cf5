"""Records of the audit that a case of bench-agents-live must leave, and when none is outstanding any more."""

from collections.abc import Sequence
from math import inf
from pathlib import Path

from gateway.supervisor.agents_cases import RECORD_EVERY_S
from gateway.supervisor.audit_file import AuditFile

SPARE_S = 1.0  #: on a busy machine, for a record that is due

Recorded = tuple[str, float]  #: a record of kind "agents": its case, and the Unix time


def records_in(data: Path) -> list[Recorded]:
    """Of the line whose data these are."""
    with AuditFile(data) as file:
        records = [row.record() for row in file.rows()]
    return [(str(one.what["case"]), one.wall_s) for one in records if one.kind == "agents"]


def settled_s(wanted: frozenset[str], found: Sequence[Recorded], began_s: float, ended_s: float) -> float:
    """Unix time from which on no record of what came until `ended_s` is outstanding.

    What came after a record is stored `RECORD_EVERY_S` after it. While one of `wanted` is not there, as long after the
    case's end; after that it does not come any more.
    """
    newest: dict[str, float] = {}
    for kind, at_s in found:
        if at_s <= ended_s:
            newest[kind] = max(at_s, newest.get(kind, at_s))
    until = [at_s + RECORD_EVERY_S + SPARE_S for at_s in newest.values()]
    if missing(wanted, found, began_s, inf):
        until.append(ended_s + RECORD_EVERY_S + SPARE_S)
    return max(until, default=ended_s)


def missing(wanted: frozenset[str], found: Sequence[Recorded], began_s: float, until_s: float) -> frozenset[str]:
    """What of `wanted` is not among those from the case's begin until `until_s`."""
    return wanted - {kind for kind, at_s in found if began_s <= at_s <= until_s}
