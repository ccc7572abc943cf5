"""Units of measurement as OPC UA names them: by the UNECE's common codes (OPC 10000-8, 5.6.3.4)."""

from dataclasses import dataclass
from typing import Any

from asyncua import ua as asyncua_ua

NAMESPACE = "http://www.opcfoundation.org/UA/units/un/cefact"

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ


@dataclass(frozen=True)
class Unit:
    code: str  #: UNECE Recommendation 20
    symbol: str
    name: str

    @property
    def number(self) -> int:
        """The code's characters as the bytes of a number, the first the highest."""
        return int.from_bytes(self.code.encode("ascii"), "big")

    def information(self) -> Any:
        """EUInformation."""
        return ua.EUInformation(
            NamespaceUri=NAMESPACE,
            UnitId=self.number,
            DisplayName=ua.LocalizedText(self.symbol),
            Description=ua.LocalizedText(self.name),
        )


NEWTON = Unit("NEW", "N", "newton")
NEWTON_METRE = Unit("NU", "N·m", "newton metre")
METRE_PER_SECOND = Unit("MTS", "m/s", "metre per second")
METRE = Unit("MTR", "m", "metre")
SECOND = Unit("SEC", "s", "second [unit of time]")
