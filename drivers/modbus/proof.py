"""What is read from a device on every connection before it is believed: that it is the one it was."""

from collections.abc import Callable

from drivers.modbus.client import ModbusConnection, ModbusFailed, ModbusTimeout
from drivers.modbus.registers import RegisterBlock

Judge = Callable[[float], list[str]]  #: what speaks against a number that was read


class Proof:
    """Checks in their order. It keeps how far it came, so that a slow device gets there over several cycles."""

    def __init__(self, name: str, unit: int, function: int, checks: list[tuple[RegisterBlock, Judge]]) -> None:
        self._name = name
        self._unit = unit
        self._function = function
        self._checks = checks
        self._passed = 0

    @property
    def complete(self) -> bool:
        return self._passed == len(self._checks)

    def void(self) -> None:
        """Nothing is proven any more: the connection was lost."""
        self._passed = 0

    def confirm(self) -> None:
        """All of it is proven, in another way."""
        self._passed = len(self._checks)

    async def go_on(self, connection: ModbusConnection, deadline_s: float) -> list[str]:
        """The checks that are left; what speaks against the device. Raises ModbusTimeout."""
        while not self.complete:
            at = self._passed
            block, judge = self._checks[at]
            try:
                registers = await connection.read(self._function, self._unit, block.address, block.count, deadline_s)
                reasons = judge(block.decode(registers)[0])
            except ModbusTimeout:
                raise
            except (ModbusFailed, ValueError) as error:
                return [f"{self._name}: unit {self._unit} at {connection.where}: {error}"]
            if reasons:
                return reasons
            self._passed = at + 1
        return []
