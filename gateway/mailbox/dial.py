"""A connected unix socket, at which one listens who may serve the line: the one way in which anybody connects."""

import os
import socket
import struct
from pathlib import Path

from gateway.mailbox.listener import new_socket
from gateway.mailbox.who_serves import require_server

_TIMEVAL = struct.Struct("ll")  # seconds, microseconds: socket(7), SO_SNDTIMEO


def dial(path: Path) -> socket.socket:
    """A socket connected to `path`, at which one listens who may serve the line. Never blocks.

    Raises OSError (BlockingIOError where the backlog is full), ServedByStranger.
    """
    connecting = new_socket()
    try:
        connecting.connect(os.fspath(path))
        require_server(connecting, path)
    except BaseException:
        connecting.close()
        raise
    return connecting


def dial_patiently(path: Path, within_s: float) -> socket.socket:
    """As `dial`, but waits for a place in the backlog, in the order in which others do. Blocks for so long at most."""
    waiting = new_socket()
    try:
        seconds, fraction_s = divmod(within_s, 1.0)
        waiting.setblocking(True)
        waiting.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _TIMEVAL.pack(int(seconds), int(fraction_s * 1e6)))
        waiting.connect(os.fspath(path))
        waiting.setblocking(False)
        require_server(waiting, path)
    except BaseException:
        waiting.close()
        raise
    return waiting
