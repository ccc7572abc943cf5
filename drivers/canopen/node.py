"""What the link asks of a node, whatever its role: a drive, a load-cell amplifier, a line PLC."""

from typing import Protocol

from drivers.canopen.map_parts import CanIdentity
from drivers.canopen.sdo import SdoBus
from drivers.canopen.station import Station
from drivers.canopen.transaction import Step
from gateway.core.finding import Finding
from gateway.core.signals import Inputs, Outputs


class Node(Protocol):
    """One node of a bus. What every node has is its `station`; the rest is what its role makes of it."""

    station: Station
    identity: CanIdentity
    answers: tuple[int, ...]  #: COB-IDs of the PDOs that it sends with every SYNC, as many as its station expects

    @property
    def watchdog(self) -> Step | None:
        """The object that has to stay as `prepare` writes it; None: nothing moves by this node."""
        ...

    def on_answer(self, cob_id: int, data: bytes | bytearray) -> None:
        """A PDO of the answer to the present SYNC. Raises ValueError for a second one or one that does not fit."""
        ...

    def check_answer(self, cob_id: int, data: bytes | bytearray) -> None:
        """Raises ValueError when this could be no answer of it, whenever it came."""
        ...

    def begin_sync(self) -> None:
        """A SYNC leaves: what was answered to the one before is used up."""
        ...

    def fill(self, inputs: Inputs, now_s: float, *, active: bool) -> list[str]:
        """What it said since the last time into `inputs`, and misses; returns what was wrong, for a person.

        `now_s` is the time of the SYNC, or of the cycle where the link is silent.
        """
        ...

    def absent(self, now_s: float) -> bool:
        """Whether it was never heard, or is lost."""
        ...

    def trouble(self, now_s: float) -> Finding | None:
        """What is wrong with it; None when nothing is."""
        ...

    @property
    def defies(self) -> Finding | None:
        """How it defies its commands, so that only its watchdog can stop it; None while it does not."""
        ...

    @property
    def shows_torque(self) -> bool:
        """Whether its answer to the present SYNC says that it has torque, or may have some."""
        ...

    def command(self, outputs: Outputs, now_s: float) -> tuple[int, bytes] | None:
        """Its receive PDO, COB-ID and payload, or None when it has none or must not be sent one now.

        Raises ValueError when it cannot be commanded what is asked; nothing may be sent then.
        """
        ...

    def reading_due(self, now_s: float, *, active: bool) -> bool:
        """Whether `read` has something to ask for."""
        ...

    async def read(self, sdo: SdoBus, now_s: float) -> list[Finding]:
        """Ask by SDO for what no PDO brings, beside the cycle. Changes nothing at the node.

        Returns what speaks against believing it. Raises SdoFailed.
        """
        ...

    async def check(self, sdo: SdoBus) -> list[Finding]:
        """What speaks against the node, before anything is written. Reads only. Raises SdoFailed."""
        ...

    def steps(self) -> list[Step]:
        """What `prepare` writes. Raises ValueError."""
        ...

    def release_steps(self) -> list[Step]:
        """What is written by SDO so that it waits for us no more. Its PDOs are over then."""
        ...

    async def confirm_stopped(self, sdo: SdoBus) -> bool:
        """Tell it by SDO to take torque off, and whether it says that it has none. Raises SdoFailed."""
        ...

    def forget(self) -> None:
        """Nothing that it said or was told before counts any more, except that it was heard."""
        ...
