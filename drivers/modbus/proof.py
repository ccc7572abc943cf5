"""What is read from a unit on every connection before it is believed or written to: that it is the one it was."""

from collections.abc import Sequence

from drivers.modbus.client import ModbusConnection, ModbusFailed, ModbusTimeout
from drivers.modbus.device import Check
from gateway.core.finding import Finding, finding


class Proof:
    """Checks in their order; those of one register share a request.

    It keeps how far it came, so that a slow device gets there over several cycles.
    """

    def __init__(self, name: str, unit: int, function: int, checks: Sequence[Check]) -> None:
        self._name = name
        self._unit = unit
        self._function = function
        groups: dict[tuple[int, int], list[Check]] = {}
        for check in checks:
            groups.setdefault((check.register.address, check.register.count), []).append(check)
        self.groups = list(groups.items())
        self._passed = 0

    @property
    def complete(self) -> bool:
        return self._passed == len(self.groups)

    def void(self) -> None:
        """Nothing is proven any more: the connection was lost."""
        self._passed = 0

    def confirm(self) -> None:
        """All of it is proven, in another way."""
        self._passed = len(self.groups)

    async def go_on(self, connection: ModbusConnection, deadline_s: float) -> list[Finding]:
        """The checks that are left; what speaks against the unit. Raises ModbusTimeout."""
        while not self.complete:
            at = self._passed
            if reasons := await self.judge(at, connection, deadline_s):
                return reasons
            if self._passed == at:  # `prepare` may have proven, or voided, all of it meanwhile
                self._passed = at + 1
        return []

    async def judge(self, group: int, connection: ModbusConnection, deadline_s: float) -> list[Finding]:
        """What speaks against the unit in one group of checks. Raises ModbusTimeout."""
        (address, count), checks = self.groups[group]
        try:
            registers = await connection.read(self._function, self._unit, address, count, deadline_s)
            return [reason for check in checks for reason in check.judge(check.register.decode(registers)[0])]
        except ModbusTimeout:
            raise
        except (ModbusFailed, ValueError) as error:
            return [unit_not_read(self._name, self._unit, connection, error)]


def unit_not_read(name: str, unit: int, connection: ModbusConnection, error: Exception) -> Finding:
    return finding("unit-not-read", device=name, unit=unit, where=connection.where, error=str(error))
