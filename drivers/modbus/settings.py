"""The settings of a unit on their way to it: what was found is noted, what is wanted is written and read back."""

import asyncio

from drivers.modbus.client import ModbusConnection, ModbusFailed
from drivers.modbus.device import Setting
from drivers.modbus.unit import Unit
from gateway.core.finding import Finding, finding

REQUEST_TIMEOUT_S = 0.5


class SettingsWriter:
    """Writes only to a unit whose identity is proven on the connection that there is."""

    def __init__(self, unit: Unit, connection: ModbusConnection) -> None:
        self._unit = unit
        self._connection = connection
        self._before: list[tuple[Setting, float]] = []  #: what may have been changed, and what to restore

    @property
    def written(self) -> bool:
        """Whether there is something to undo."""
        return bool(self._before)

    async def configure(self) -> list[Finding]:
        """Write every setting and read it back. Returns the first that fails; `undo` takes back what was written.

        Where that was not done after an earlier call, what is restored is what stood there before that one.
        """
        for setting in self._unit.settings:
            if reasons := await self._set(setting):
                return reasons
        return []

    async def _set(self, setting: Setting) -> list[Finding]:
        try:
            found = await self._read(setting)
            # What is as we want it was left behind by a gateway that could not restore it.
            left_behind = setting.off is not None and found == setting.counts
            if any(noted is setting for noted, _ in self._before):
                await self._write(setting, setting.counts)
            else:
                # Noted before: whatever becomes of the request, and of this task, it may have been written.
                self._before.append((setting, setting.off if setting.off is not None and left_behind else found))
                await self._write_noted(setting)
            found = await self._read(setting)
        except (ModbusFailed, ValueError) as error:
            return [finding("setting-not-set", **setting.named, error=str(error))]
        if found == setting.counts:
            return []
        return [finding("setting-reads-back", **setting.named, set_counts=setting.counts, found_counts=found)]

    async def _write_noted(self, setting: Setting) -> None:
        try:
            await self._write(setting, setting.counts)
        except ModbusFailed as error:
            if error.exception_code is not None:
                self._before.pop()  # it has said that it did not take it
            raise

    async def undo(self) -> list[Finding]:
        """Write back what was there before `configure`, the last first; returns what could not be restored."""
        failures: list[Finding] = []
        while self._before:
            setting, before = self._before[-1]
            try:
                await self._write(setting, before)
            except (ModbusFailed, ValueError) as error:
                failures.append(finding("setting-not-restored", **setting.named, error=str(error)))
            self._before.pop()  # not before: cut here, it is written back by the next call
        return failures

    def forget(self) -> None:
        """Nothing is restored any more: the watchdogs stay on."""
        self._before.clear()

    async def _read(self, setting: Setting) -> float:
        block, unit = setting.register, self._unit
        return block.decode(
            await self._connection.read(unit.read_function, unit.address, block.address, block.count, _deadline_s())
        )[0]

    async def _write(self, setting: Setting, counts: float) -> None:
        self._unit.require_proven()
        block = setting.register
        await self._connection.write(self._unit.address, block.address, block.encode([counts]), _deadline_s())


def _deadline_s() -> float:
    return asyncio.get_running_loop().time() + REQUEST_TIMEOUT_S
