"""What stands behind one unit identifier: devices that are exchanged in one transaction. No I/O.

A unit is written whole or not at all. Where one of its devices cannot be commanded, or one that gives torque was
lost, nothing is written to any of them, so that every watchdog in it fires: there is no half of a transaction. Where a
watchdog itself may be off all of them are told to rest first: left alone they might follow their last command for ever.
"""

from collections.abc import Sequence

from drivers.modbus.client import ModbusFailed
from drivers.modbus.cyclic import only
from drivers.modbus.device import Check, Device, Setting, Standing
from drivers.modbus.plan import Plan, Wish
from drivers.modbus.proof import Proof
from drivers.modbus.registers import spans
from drivers.power_stage import ORDERS_IGNORED
from gateway.core.finding import Finding, finding
from gateway.core.signals import Inputs, Outputs
from gateway.wording.catalogue import sentences

RESTS = 5  #: cycles in which a unit that has not kept its settings is told to rest; some may not arrive

Payloads = list[list[int]]  #: the registers of each of the plan's writes


class Unit:
    """`together`: it knows function 23. Raises ValueError when its devices do not go together."""

    def __init__(self, address: int, read_function: int, devices: Sequence[Device], together: bool = True) -> None:
        self.address = address
        self.read_function = read_function
        self.devices = devices
        self.name = ", ".join(device.name for device in devices)
        self.standing = Standing()
        self.settings = _settings(devices)
        wishes = [device.wish for device in devices]
        self._seen = _in_reach(wishes, self.settings)  #: those that every cycle reads
        self.plan = Plan([*wishes, *(setting.wish for setting in self._seen)], together)
        #: The one request of a cycle that reads, and of one that writes too; None where it takes several.
        self.reads_at_once = only(self.plan.read_only, read_function)
        self.writes_at_once = only(self.plan.read_write, read_function)
        proofs = [device.proofs for device in devices]
        #: Before anything is believed. `prepare` proves it before there is torque; nobody would after a reconnection.
        self.identity = self._proof([check for proof in proofs for check in proof.identity])
        self.identity.confirm()
        self.trust = self._proof([check for proof in proofs for check in proof.trust])
        self.kept_settings = self._proof([setting.kept for setting in self.settings])
        #: The settings that no cycle reads.
        self.unseen_settings = self._proof([setting.kept for setting in self.settings if setting not in self._seen])
        self.dropped = False  #: gave torque and was lost: nothing is written to it before the next `prepare`
        self.commanded = False  #: something was written since it became active
        self.withheld = False  #: nothing is written to it, to see its watchdogs fire
        self.owes_rest = False  #: silent, and it was commanded before: to be told to rest
        self.was_lost = False  #: silent, and it was dropped before: nothing is written to it
        self._rests = 0  #: that are left
        self._gives_torque = any(device.gives_torque for device in devices)
        self._writers = [device for device in devices if device.wish.write is not None]
        self._payloads: Payloads | None = None

    def _proof(self, checks: Sequence[Check]) -> Proof:
        return Proof(self.name, self.address, self.read_function, checks)

    def activate(self) -> None:
        """Its settings are proven: from now on it is commanded."""
        self.kept_settings.confirm()
        self.standing.active = True
        self.standing.missed = 0
        self.standing.distrust, self.dropped, self._rests = (), False, 0
        self.owes_rest = self.was_lost = False

    def silence(self) -> None:
        """Nothing is written from now on, and nothing of the last command is left but that it has to be taken back."""
        standing = self.standing
        standing.active, standing.wrote, standing.distrust, standing.refused = False, False, (), ""
        self.owes_rest |= self.commanded
        self.was_lost |= self.dropped
        self.dropped = self.commanded = self.withheld = False
        self._rests = 0
        self._payloads = None
        for device in self.devices:
            device.forget()

    def connection_lost(self) -> None:
        """Whatever answers on the next connection has to prove itself; it may have been restarted, or another."""
        self.identity.void()
        self.kept_settings.void()
        if not self.identity.complete:
            self.standing.doubt = [finding("unit-not-proven", device=self.name)]

    def command(self, outputs: Outputs) -> str:
        """What the next transaction writes. Returns why that is nothing; empty when all is well."""
        self._payloads = None
        standing = self.standing
        standing.refused = ""
        if not standing.active or self.dropped or self.withheld or not self._writers:
            return ""
        registers: list[list[int]] = []
        for device in self._writers:
            try:
                registers.append(device.command(outputs))
            except ValueError as error:
                standing.refused = f"{device.name}: {error}"
                return standing.refused
        self._payloads = self.plan.payloads(registers)
        return ""

    def take_payloads(self) -> Payloads | None:
        """What was commanded last, once: a command that was not sent with the next cycle is never sent."""
        payloads, self._payloads = self._payloads, None
        return payloads

    def rest_payloads(self) -> Payloads:
        """No torque, no transport: what a unit is told that is left."""
        return self.plan.payloads([device.rest() for device in self._writers])

    def require_proven(self) -> None:
        """Raises ModbusFailed when what answers on this connection may be another device."""
        if not self.identity.complete:
            raise ModbusFailed("its identity is not proven on this connection")

    def take_rest(self) -> Payloads | None:
        """What is written now to a unit that has not kept its settings, a few times. Nothing while it is withheld."""
        if not self._rests or self.withheld:
            return None
        self._rests -= 1
        return self.rest_payloads()

    @property
    def settled(self) -> bool:
        """Whether there is nothing to prove, and nothing to tell it, before a cycle's reading and writing."""
        proven = self.kept_settings.complete or self.dropped or not self.standing.active
        return proven and self.identity.complete and not self._rests

    def may_write(self) -> bool:
        return self.standing.active and not self.dropped and self.identity.complete and self.kept_settings.complete

    def take_settings(self, numbers: list[list[float]], *, judged: bool) -> list[list[float]]:
        """What a transaction has read, without the settings in it. Where `judged`, one that changed is in doubt."""
        count = len(self.devices)
        found = zip(self._seen, numbers[count:], strict=True)
        if judged and any(setting.against(number) for setting, (number,) in found):
            self.doubt_settings()
        return numbers[:count]

    def doubt_settings(self) -> None:
        """They are proven again before anything else is written: a single answer may have been damaged."""
        self.kept_settings.void()

    def distrust(self, reasons: Sequence[Finding]) -> None:
        """It has not kept its settings; none: it has. Who gives torque does not come back by itself."""
        if reasons and not self.standing.distrust:
            self._rests = RESTS
        self.standing.distrust = reasons
        self.dropped |= self._gives_torque and bool(reasons)

    def _drop(self, reason: Finding) -> None:
        self.dropped = True
        self.standing.distrust = [reason]

    def fill(self, inputs: Inputs, numbers: Sequence[Sequence[float]] | None, time_s: float) -> list[str]:
        """What came in this cycle into `inputs`, device by device; returns what was wrong. None: no answer."""
        standing = self.standing
        standing.missed = 0 if numbers is not None else standing.missed + 1
        if standing.absent and standing.active and self._gives_torque and not self.dropped:
            self._drop(finding("device-unanswered", device=self.name, cycles=standing.missed))
        troubles: list[str] = []
        for k, device in enumerate(self.devices):
            troubles += device.fill(inputs, numbers[k] if numbers is not None else None, standing, time_s)
            if not self.dropped and device.disobeys:
                self._drop(finding("orders-ignored", drive=device.name, orders=ORDERS_IGNORED))
        if mute := sentences(standing.distrust) or standing.refused:
            troubles.append(f"{self.name}: {mute}; it is not written to")
        return troubles


def _settings(devices: Sequence[Device]) -> list[Setting]:
    """Those of all devices; one register that several of them want set is set once."""
    settings: dict[tuple[int, int], Setting] = {}
    for device in devices:
        for setting in device.proofs.settings:
            other = settings.setdefault((setting.register.address, setting.register.count), setting)
            if other.counts != setting.counts:
                raise ValueError(
                    f"{setting.device}: {setting.name} should be {setting.counts:g}, but in the same register "
                    f"{other.device}: {other.name} should be {other.counts:g}"
                )
    return list(settings.values())


def _in_reach(wishes: Sequence[Wish], settings: Sequence[Setting]) -> list[Setting]:
    """The settings that can be read together with what the devices wish, without one request more."""
    fields = [field for wish in wishes for field in wish.reads]
    requests = len(spans(fields))
    found: list[Setting] = []
    for setting in settings:
        if len(spans([*fields, *setting.wish.reads])) == requests:
            fields.extend(setting.wish.reads)
            found.append(setting)
    return found
