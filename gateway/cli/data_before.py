"""Data of a line as they lay before each process had its own folder."""

from pathlib import Path
from shlex import quote

from gateway.mailbox.paths import AGENTS_DATA, GATEWAY_DATA, LOGS, LOOP_DATA, OPERATOR_DATA, SIM_DATA

#: What must not be begun anew beside what was there: records, what was approved, who may come in, what was added.
_KEPT = ("*.sqlite", "configuration.json", "wiring-proof.json", "keys", "users.toml", "knowledge")
#: What lay in the line's data folder itself, by the process that has it now.
_OF = {
    LOOP_DATA: (
        "controller*.json", "configuration*.json", "started-with.json", "deaths.json", "wiring-proof.json",
        "contradicted-cells.json", "loop.lock",
    ),
    GATEWAY_DATA: ("*.sqlite*", "audit.*", "audit-2*", "gateway.lock", "keys", "alarms.json"),
    OPERATOR_DATA: ("users.toml", "users.lock", "pki"),
    AGENTS_DATA: ("knowledge", "audit-heads.txt"),
    SIM_DATA: ("recording-*",),
    LOGS: ("*.log",),
}  # fmt: skip


def moves(data: Path, *, gateways_too: bool = True) -> str:
    """The shell's command that gives each process its own; empty where nothing of the earlier kind is there.

    Without `gateways_too` a folder that has the gateway's files alone is taken for the gateway's own.
    """
    found = {own: sorted({path for one in names for path in data.glob(one)}) for own, names in _OF.items()}
    counts = {path for own, paths in found.items() if gateways_too or own != GATEWAY_DATA for path in paths}
    if not any(path in counts for one in _KEPT for path in data.glob(one)):
        return ""
    moved = (
        f"mkdir -p -m 700 {own} && mv -n {' '.join(quote(path.name) for path in paths)} {own}/"
        for own, paths in found.items()
        if paths
    )
    return " && ".join((f"cd {quote(str(data))}", *moved))
