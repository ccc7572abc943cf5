"""All units behind one Modbus TCP address, behind the driver port.

A cycle's requests leave with `trigger`, each unit's on a connection of its own, and what has come by the deadline
counts. What `write` hands over is written with the next `trigger`, in the same transaction as that cycle's reading.
"""

import asyncio
from collections.abc import Mapping, Sequence, Set

from drivers.modbus.session import Session
from drivers.modbus.unit import Unit
from drivers.port import PrepareRefused
from gateway.core.finding import Finding, finding
from gateway.core.signals import Inputs, LinkHealth, Outputs
from gateway.tasks.cleanup import finish, finish_all


class ModbusLink:
    """A `drivers.port.Link` for the units at one host and port."""

    def __init__(self, name: str, host: str, port: int, units: Sequence[Unit], period_s: float) -> None:
        self.name = name
        self.health = LinkHealth()
        self._where = f"{host}:{port}"
        self._sessions = [Session(unit, host, port, period_s, self.health, self._on_done) for unit in units]
        self._awaited: set[Session] = set()
        self._releasing = asyncio.Lock()
        self._complete = asyncio.Event()  #: every unit that is waited for has answered

    async def open(self) -> None:
        """Connect. Raises OSError with what to do; the link may be used all the same, and goes on trying then."""
        if not all(await asyncio.gather(*(session.connect() for session in self._sessions))):
            raise OSError(
                f"bus {self.name}: no connection to {self._where}; "
                "check host and port, and that the device is switched on"
            )

    async def prepare(self) -> None:
        """Check every unit; set and prove the watchdogs. Raises PrepareRefused; what was written is undone then.

        Where this is cancelled, `release` undoes it.
        """
        self.silence()
        connected = await asyncio.gather(*(session.ensure_connected() for session in self._sessions))
        reasons = [
            finding("device-not-connected", device=device.name, where=self._where)
            for session, there in zip(self._sessions, connected, strict=True)
            if not there
            for device in session.unit.devices
        ]
        if reasons:
            raise PrepareRefused(reasons)
        for session in self._sessions:
            reasons += await session.check()
        if reasons:
            raise PrepareRefused(reasons)
        for session in self._sessions:
            reasons += await session.settings.configure()
        if not reasons:
            reasons = [reason for session in self._sessions for reason in session.lost_since_check()]
        if reasons:
            raise PrepareRefused(reasons + await finish(self._undo()))
        for session in self._sessions:
            session.activate()

    async def _undo(self) -> list[Finding]:
        return [failure for session in reversed(self._sessions) for failure in await session.settings.undo()]

    @property
    def serials(self) -> Mapping[str, str]:
        """An amplifier's is that of each load cell on it: it is called by all of them."""
        return {name: number for session in self._sessions for name, number in session.serials.items()}

    @property
    def watched(self) -> Set[str]:
        return {device.name for session in self._sessions for device in session.unit.devices if device.wish.write}

    def withhold(self, devices: Set[str]) -> None:
        """A unit is written whole or not at all."""
        for session in self._sessions:
            unit = session.unit
            unit.withheld = any(device.name in devices for device in unit.devices)

    def silence(self) -> None:
        """Nothing is written from now on; reading goes on."""
        for session in self._sessions:
            session.unit.silence()

    async def release(self) -> None:
        """Drives without torque, transport off, settings as they were: nothing is fed or waited for any more.

        No cancellation cuts it, and a unit that fails keeps no other from it. Raises the first failure.
        """
        self.silence()
        await finish(self._release())

    async def _release(self) -> None:
        async with self._releasing:
            failures = await finish_all(session.leave() for session in self._sessions)
        if failures:
            raise failures[0]

    def trigger(self, now_s: float) -> None:
        """Send the requests of this cycle, with the commands of the one before."""
        self._awaited.clear()
        self._complete.clear()
        self._awaited.update([session for session in self._sessions if session.begin(now_s)])
        if not self._awaited:
            self._complete.set()

    def _on_done(self, session: Session) -> None:
        self._awaited.discard(session)
        if not self._awaited:
            self._complete.set()

    async def collect(self, inputs: Inputs, deadline_s: float) -> None:
        """The answers that have come by `deadline_s`."""
        if not self._complete.is_set():
            over = asyncio.get_running_loop().call_at(deadline_s, self._complete.set)
            try:
                await self._complete.wait()
            finally:
                over.cancel()
        for session in self._sessions:
            session.end(inputs)
        absent = [session.unit for session in self._sessions if session.unit.standing.absent]
        self.health.absent = [device.name for unit in absent for device in unit.devices]

    def write(self, outputs: Outputs) -> None:
        """What the next transaction of every unit writes."""
        for session in self._sessions:
            if refused := session.unit.command(outputs):
                self.health.malformed += 1
                self.health.last_error = refused

    async def close(self) -> None:
        """Drop the connections. Idempotent; no cancellation cuts it."""
        await finish(self._close())

    async def _close(self) -> None:
        await finish_all(session.close() for session in self._sessions)
        await asyncio.sleep(0)  # lets the transports release their sockets
