"""Ports for servers that are begun later, or by another process: nobody else is given them meanwhile.

They lie below those that the system gives to anybody's connections, and each worker has a block of its own. Where a
server can say which port it got, it is given port 0 instead.
"""

import itertools
import os
import socket

FIRST, BLOCK = 20_000, 400

_worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
_ports = itertools.cycle(range(FIRST + BLOCK * _worker, FIRST + BLOCK * (_worker + 1)))


def free_port() -> int:
    """The next one of this worker's that is free, for TCP and for UDP. Raises OSError where none is."""
    for port in itertools.islice(_ports, BLOCK):
        if _is_free(port, socket.SOCK_STREAM) and _is_free(port, socket.SOCK_DGRAM):
            return port
    raise OSError(f"all ports of worker {_worker} are in use: {FIRST + BLOCK * _worker} and the {BLOCK - 1} behind it")


def _is_free(port: int, kind: socket.SocketKind) -> bool:
    with socket.socket(socket.AF_INET, kind) as probe:
        try:
            probe.bind(("", port))
        except OSError:
            return False
    return True
