"""What a device has to show on every connection before it is believed and written to. No I/O.

That it is the device that the map is for; and, while it is commanded, that its watchdog is still the one that was
set: a server that was restarted has lost it. It is asked again now and then on a connection that stays: devices can be
restarted, exchanged or set behind a server that goes on.
"""

from drivers.opcua.maps import Identity, WatchdogNode
from drivers.opcua.nodes import DeviceNodes, Reading
from drivers.scaling import watchdog_counts
from gateway.core.finding import Finding, finding

ANSWERS_ALLOWED = 3  #: cycles in a row without a usable answer until a device counts as absent


class Watchdog:
    """The communication watchdog of a device: its node and the number that is written to it.

    Raises ValueError when the device cannot do `watchdog_s`.
    """

    def __init__(self, entry: WatchdogNode, watchdog_s: float, nodes: DeviceNodes) -> None:
        self.node = nodes.place(entry, entry.type)
        self.time_s = watchdog_s
        self.counts = watchdog_counts(entry, watchdog_s)


class Proof:
    """`known`: it is the right device, and may be believed. `proven`: it may be written to as well, if it ever was.

    `doubts` are why it is not, as far as it has been looked at. `unguarded`: it is the right one, but what was read of
    its watchdog is not what was set, so that silence would not stop it.
    """

    def __init__(self, name: str, identity: Identity, watchdog: Watchdog | None, nodes: DeviceNodes) -> None:
        self.name = name
        self.nodes = (nodes.place(identity, identity.type), *((watchdog.node,) if watchdog else ()))  #: to be read
        self.known = self.proven = self.unguarded = False
        self.doubts: list[Finding] = []
        self._unread = 0  #: answers in a row without a usable one, since it was proven
        self._wanted = identity.value
        self._watchdog = watchdog

    @property
    def due(self) -> bool:
        """Whether it has to be asked with the next question."""
        return not self.proven or self._unread > 0

    def void(self) -> None:
        """Nothing is proven any more: the connection was lost."""
        self._set(known=False, proven=False)

    def judge(self, readings: tuple[Reading, ...], *, commanded: bool) -> None:
        """The readings of `nodes` on this connection. One that was proven may miss as many as any other reading."""
        self._unread = 0 if all(reading.good for reading in readings) else self._unread + 1
        if self.proven and 0 < self._unread < ANSWERS_ALLOWED:
            return
        self.doubts = self.against_identity(readings[0])
        self.known = not self.doubts
        self.unguarded = False
        if not self.doubts and commanded and self._watchdog is not None:
            self.doubts = self.against_watchdog(readings[1])
            self.unguarded = bool(self.doubts) and readings[1].good
        self.proven = not self.doubts

    def confirm(self) -> None:
        """All of it was proven in another way."""
        self._set(known=True, proven=True)

    def _set(self, *, known: bool, proven: bool) -> None:
        self.known, self.proven, self.unguarded = known, proven, False
        self.doubts = []
        self._unread = 0

    def against_identity(self, found: Reading) -> list[Finding]:
        if not found.good:
            return [not_read(self.name, "identity", found)]
        if found.value != self._wanted:
            return [finding("device-id-differs", device=self.name, found=int(found.value), wanted=self._wanted)]
        return []

    def against_watchdog(self, found: Reading) -> list[Finding]:
        assert self._watchdog is not None
        if not found.good:
            return [not_read(self.name, "watchdog", found)]
        if found.value == self._watchdog.counts:
            return []
        counts = {"set_counts": self._watchdog.counts, "found_counts": found.value}
        return [finding("setting-changed", device=self.name, setting="watchdog", **counts)]


def not_read(device: str, node: str, found: Reading) -> Finding:
    """Of a node by its key in the map."""
    return finding("node-not-read", device=device, node=node, status=found.trouble)
