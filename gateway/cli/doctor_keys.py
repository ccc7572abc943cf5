"""By which key the loop knows its gateway, and what that is worth on this computer (docs/security.md)."""

import os
from pathlib import Path

from gateway.cli.doctor_check import Check
from gateway.core.line import Line
from gateway.mailbox.keys import (
    FOLDER,
    INSTALLED,
    PRIVATE,
    KeyUnusable,
    existing_private_key,
    public_bytes,
    public_key,
)

_GROUP, _SUBJECT = "permissions", "gateway's key"
WANTED = "readable by the gateway's user alone; its public key where only root writes"


def gateway_key(line: Line, own: Path, installed: Path = INSTALLED) -> Check:
    """`own`: the gateway's folder. Reads only; makes no key."""
    private = own / FOLDER / PRIVATE
    try:
        key = existing_private_key(own)
        known = public_key(line.site, line.line, own, installed)
    except KeyUnusable as error:
        return Check(_GROUP, _SUBJECT, "", "FAIL", str(error), WANTED, "mend what is named, then start the gateway")
    if known is None:
        return Check(_GROUP, _SUBJECT, "", "skipped", f"{private}: not made yet", WANTED)
    install = (
        f"`install -m 644 {private.with_name('gateway.pub')} {installed / f'{line.site}_{line.line}.pub'}` as root"
    )
    if key is not None and public_bytes(key) != known.key.public_bytes_raw():
        measured = f"the loop goes by {known.path}, which is not this gateway's"
        return Check(_GROUP, _SUBJECT, "", "FAIL", measured, WANTED, f"{install}, and start the loop anew")
    if known.path.parent != installed:
        measured = f"the loop goes by {known.path}, which its gateway's user may write"
        todo = f"run the gateway as a user of its own, and {install}"
        return Check(_GROUP, _SUBJECT, "", "warning", measured, WANTED, todo)
    if key is not None and os.geteuid() != 0 and private.stat().st_uid == os.geteuid():
        measured = f"{known.path}, but this user can read {private}"
        todo = "run loop, operator and agents as other users than the gateway"
        return Check(_GROUP, _SUBJECT, "", "warning", measured, WANTED, todo)
    return Check(_GROUP, _SUBJECT, "", "OK", str(known.path), WANTED)
