"""Who may serve a line on this computer, and in which folders: asked before anything is sent to whoever listens.

The kernel names the user who listens at the other end of a socket (`SO_PEERCRED`). This user and root may; others where
root has named them, by number, in `/etc/r2rgate/served-by/NAME`, with NAME that of the line's run folder. Root also
takes the owner of a run folder that only root can have given him.
"""

import os
import socket
import stat
import struct
from collections.abc import Collection
from pathlib import Path

from gateway.core.finding import Finding, finding
from gateway.mailbox.port import NotSent, Peer
from gateway.wording.catalogue import sentence

NAMED = Path("/etc/r2rgate/served-by")  #: a file for each run folder, by its name: numbers of users, one a line
_UCRED = struct.Struct("3i")  # pid, uid, gid: unix(7), SO_PEERCRED
_MOST_BYTES = 4096
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


class ServedByStranger(NotSent):
    """Somebody listens who may not serve the line, as `found` says; nothing was sent."""

    def __init__(self, found: Finding) -> None:
        super().__init__(sentence(found))
        self.found = found


def may_serve(uid: int, run_folder: Path) -> bool:
    """Whether a user may serve the line with this run folder."""
    own = os.geteuid()
    if uid in (own, 0) or uid in named(run_folder):
        return True
    if own != 0:
        return False
    try:  # root, who asks what runs as a user of its own
        return run_folder.stat().st_uid == uid and unsafe_place(run_folder, (0, uid), shared=False) is None
    except OSError:
        return False


def peer_of(connected: socket.socket) -> Peer:
    """Who is at the other end of a connected socket."""
    pid, uid, _ = _UCRED.unpack(connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size))
    return Peer(uid, pid)


def require_server(connected: socket.socket, path: Path) -> None:
    """Raises ServedByStranger where who listens on `path` may not serve the line."""
    peer = peer_of(connected)
    if not may_serve(peer.uid, path.parent):
        raise ServedByStranger(
            finding("served-by-stranger", path=str(path), process_pid=peer.pid, process_uid=peer.uid)
        )


def require_socket(path: Path) -> None:
    """As `require_server`, by the owner of the socket and its folders: for a connection that is made by a library.

    Nothing is raised where there is no socket.
    """
    try:
        owner = path.lstat().st_uid
    except OSError:
        return
    if not may_serve(owner, path.parent):
        raise ServedByStranger(finding("served-by-stranger", path=str(path), process_pid=0, process_uid=owner))
    if unsafe := unsafe_place(path.parent, {owner, *owners(path.parent)}):
        raise ServedByStranger(unsafe)


def owners(run_folder: Path) -> frozenset[int]:
    """Whose the run folder, and the folders above it, may be."""
    return frozenset((os.geteuid(), 0)) | named(run_folder)


def named(run_folder: Path) -> frozenset[int]:
    """The users whom root has named for the line; nobody where others than root may write their list."""
    try:
        descriptor = os.open(NAMED / run_folder.name, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return frozenset()
    try:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode) or found.st_uid != 0 or found.st_mode & _OTHERS_WRITE:
            return frozenset()
        return frozenset(int(word) for word in os.read(descriptor, _MOST_BYTES).split() if word.isdigit())
    finally:
        os.close(descriptor)


def unsafe_place(folder: Path, allowed: Collection[int], *, shared: bool = True) -> Finding | None:
    """The first of `folder` and those above it that is another's, or that others may write; None: there is none.

    Of those that are there. A folder that all may write and nobody may clear, as /tmp, is good above one's own, unless
    `shared` is False. Raises OSError.
    """
    real, said = Path(os.path.realpath(folder)), Path(os.path.abspath(folder))
    for place in dict.fromkeys((real, *real.parents, said, *said.parents)):
        try:
            found = place.lstat()
        except FileNotFoundError:
            continue
        mode = stat.S_IMODE(found.st_mode)
        is_sticky = shared and place != real and mode & stat.S_ISVTX
        is_open = not stat.S_ISLNK(found.st_mode) and mode & _OTHERS_WRITE and not is_sticky
        if found.st_uid not in allowed or is_open:
            return finding(
                "run-folder-of-others", folder=str(folder), place=str(place), owner_uid=found.st_uid, mode=f"{mode:o}"
            )
    return None
