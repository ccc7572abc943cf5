"""The one protocol that every driver meets, on a real wire or in memory.

A cycle goes `trigger` on every link (requests leave, nothing is awaited), then `collect` on every link (answers
are taken until the deadline), then the control law, then `write` on every link (hands over, never waits). All
links wait at the same time that way, and a slow or dead device costs the others nothing: `collect` returns at
the deadline at the latest, with the quality of what did not come set to STALE.

What `write` hands over acts at the devices with the next `trigger` (a SYNC, or the write half of the read-write
transaction), so the latency from sample to torque is one period on every wire.
"""

from collections.abc import Mapping, Sequence, Set
from typing import Protocol

from gateway.core.finding import Finding
from gateway.core.signals import Inputs, LinkHealth, Outputs


class PrepareRefused(Exception):
    """A device cannot be trusted with torque. `reasons` name the device and what was found."""

    def __init__(self, reasons: Sequence[Finding]) -> None:
        super().__init__("; ".join(reason.code for reason in reasons))
        self.reasons = list(reasons)


class Link(Protocol):
    """One bus with its devices."""

    name: str
    health: LinkHealth

    @property
    def serials(self) -> Mapping[str, str]:
        """Serial numbers of devices by name, as `prepare` has read them. One that tells none has no entry."""
        ...

    @property
    def watched(self) -> Set[str]:
        """Names of the devices whose communication watchdogs this link feeds."""
        ...

    async def open(self) -> None:
        """Open the transport. Sends nothing that changes a device. Raises OSError with what to do about it."""
        ...

    async def prepare(self) -> None:
        """Configure the devices and prove their communication watchdogs: set, read back, within bound.

        After it returns the link is active. Raises PrepareRefused with every reason, and stays silent then.
        """
        ...

    def withhold(self, devices: Set[str]) -> None:
        """Send nothing from now on that feeds the watchdogs of `devices`, nor of those that share a feed with them.

        Reading goes on. An empty set feeds all again; so do `prepare` and `silence`.
        """
        ...

    def silence(self) -> None:
        """Back to silent: from now on nothing is sent that changes a device."""
        ...

    async def release(self) -> None:
        """Leave the devices in order, then be silent: no command comes any more, and none is waited for.

        For when torque is off, or an arming has failed. Devices that are not released trip their watchdogs.
        """
        ...

    def trigger(self, now_s: float) -> None:
        """Start a cycle: latch and sample (SYNC), or send the read requests. A silent link only listens and reads."""
        ...

    async def collect(self, inputs: Inputs, deadline_s: float) -> None:
        """Fill in what arrived by `deadline_s` (monotonic), mark what did not."""
        ...

    def write(self, outputs: Outputs) -> None:
        """Hand over the commands of this cycle. A silent link ignores them. Never blocks."""
        ...

    async def close(self) -> None:
        """Release the transport. Idempotent."""
        ...
