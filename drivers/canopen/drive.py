"""A drive as a node of the bus: what the gateway knows of it and commands it."""

from dataclasses import replace

from drivers.canopen.configure import DriveSettings, drive_expected, drive_steps, watchdog_step
from drivers.canopen.map_drive import DriveMap
from drivers.canopen.map_parts import CanObject
from drivers.canopen.pdo import DriveSample, MalformedPdo, PdoCodec
from drivers.canopen.prepare import check_fixed
from drivers.canopen.sdo import SdoBus, SdoFailed, SdoNoObject
from drivers.canopen.station import Station
from drivers.canopen.transaction import Step, place, read_number
from drivers.cia402 import DISABLE_VOLTAGE, PowerState, is_barred, power_state
from drivers.mode_display import ModeDisplay
from drivers.power_stage import ORDERS_IGNORED, PowerStage
from drivers.scaling import torque_per_count, torque_step
from drivers.torque_rules import against_max_torque, against_rated_torque
from gateway.core.finding import Finding, finding
from gateway.core.signals import DriveState, Inputs, Outputs

STO_POLL_S = 0.2  #: how often a drive that may not switch on is asked whether safe torque off is why
_ENABLED = PowerState.OPERATION_ENABLED  # looked up in every cycle
_IN_FAULT = (PowerState.FAULT_REACTION, PowerState.FAULT)
_WITH_TORQUE = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION)


class DriveNode:
    """`index` is its roller - 1. A drive with a distrusted station is told to take torque off, whatever is asked."""

    def __init__(self, name: str, index: int, device: DriveMap, settings: DriveSettings, radius_m: float) -> None:
        self.station = Station(
            name,
            settings.node,
            device.heartbeat,
            watchdog=device.watchdog,
            classes=device.emergency,
            has_statusword=True,
        )
        self.index = index
        self.identity = device.identity
        self.device = device
        self.settings = settings
        self.watchdog = watchdog_step(device.watchdog, settings.watchdog_s)
        self.codec = PdoCodec(device, settings.rated_torque_nm, radius_m)
        self.sample: DriveSample | None = None  #: the answer to the present SYNC
        self.stage = PowerStage(device.follows_command, device.voltage_enabled)
        self._display = device.mode_displayed
        self.mode = ModeDisplay(
            device.cyclic_torque_mode,
            at_rest=self._display is not None and self._display.shown == "always",
            certain=device.objects.mode_displayed is not None,
        )
        self._mode_in_pdo = "mode_displayed" in device.transmit_pdo.objects
        self._mode_asked_s = float("-inf")
        self.answers = (device.transmit_pdo.cob_id + settings.node,)
        self._receive_cob_id = device.receive_pdo.cob_id + settings.node
        self._lacks_reaction = False  #: it has no object for what it does when its watchdog fires
        self._sto_asked_s = float("-inf")
        self._barred_by_sdo = False  #: as it said when asked, withheld and without an answer to SYNC
        self._ask_for_sto = (
            device.objects.safe_torque_off is not None and "safe_torque_off" not in device.transmit_pdo.objects
        )

    # the cycle

    def begin_sync(self) -> None:
        self.sample = None
        self.station.begin_sync()

    def on_answer(self, cob_id: int, data: bytes | bytearray) -> None:
        """The TPDO of the present SYNC. Raises MalformedPdo for a second one or a wrong length."""
        if self.sample is not None:
            raise MalformedPdo("a second answer to one SYNC")
        sample = self.codec.decode(data)
        self.sample = sample
        self.station.on_frame()
        stage = self.stage
        stage.on_statusword(sample.statusword, sample.safe_torque_off)
        if self.station.undecided is not None:
            self.station.on_statusword(in_fault=stage.power in _IN_FAULT)
        if stage.fault_was_reset:
            self.station.recover()
        if sample.mode is not None:
            self.mode.on_mode(sample.mode, enabled=stage.power is _ENABLED)

    def check_answer(self, cob_id: int, data: bytes | bytearray) -> None:
        """Raises MalformedPdo."""
        self.codec.decode(data)

    def absent(self, now_s: float) -> bool:
        return self.station.absent(now_s, self.stage.gives_torque)

    def trouble(self, now_s: float) -> Finding | None:
        return self.station.trouble(now_s, self.stage.gives_torque)

    @property
    def defies(self) -> Finding | None:
        if not self.stage.disobeys:
            return None
        return finding("orders-ignored", drive=self.station.name, orders=ORDERS_IGNORED)

    @property
    def shows_torque(self) -> bool:
        return self.sample is not None and self.stage.power in _WITH_TORQUE

    def state(self, now_s: float) -> DriveState:
        if self.absent(now_s):
            return DriveState.ABSENT
        if self.station.distrust or self.station.emergency:
            return DriveState.FAULT
        return self.stage.state

    def fill(self, inputs: Inputs, now_s: float, *, active: bool) -> list[str]:
        """State, speed and torque."""
        inputs.drive_state[self.index] = self.state(now_s)
        inputs.power_barred[self.index] = self._is_barred()
        sample, warning = self.sample, self.station.warning
        inputs.drive_condition[self.index] = self._condition() if active else 0
        inputs.drive_warning[self.index] = 0 if warning is None else warning.number
        if self.mode.mode is not None:
            inputs.drive_mode[self.index] = self.mode.mode
        if sample is not None:
            inputs.speed.put(self.index, sample.speed_m_per_s, now_s)
            inputs.torque.put(self.index, sample.torque_nm, now_s)
        else:
            inputs.speed.miss(self.index)
            inputs.torque.miss(self.index)
        return []

    def _is_barred(self) -> bool:
        """By its answer to this SYNC. One that is withheld may have left operational for it: by what SDO has read."""
        self._barred_by_sdo &= self.station.withheld
        return self.stage.barred if self.sample is not None else self._barred_by_sdo

    def _condition(self) -> int:
        mode = self.mode.condition(enabled=self.stage.power is _ENABLED)
        return self.stage.condition | mode

    def command(self, outputs: Outputs, now_s: float) -> tuple[int, bytes]:
        """Its RPDO. Raises ValueError when the torque cannot be commanded."""
        request, torque_nm = int(outputs.drive_request[self.index]), float(outputs.torque_nm[self.index])
        return self._receive_cob_id, self.payload(request, torque_nm, self.state(now_s))

    def payload(self, request: int, torque_nm: float, state: DriveState) -> bytes:
        """The RPDO towards `request`. A drive that is not trusted is told to take torque off.

        Raises ValueError when the torque cannot be commanded; nothing may be sent then.
        """
        word, given_nm = self.stage.command(request, torque_nm, state, trusted=not self.station.distrust)
        if given_nm != torque_nm:
            # Encoded also where it is not given: what cannot be commanded says that something is wrong.
            self.codec.encode(word, torque_nm)
        return self.codec.encode(word, given_nm)

    # by SDO

    def reading_due(self, now_s: float, *, active: bool) -> bool:
        return active and (self._is_mute or self._sto_due(now_s) or self._mode_due(now_s))

    @property
    def _is_mute(self) -> bool:
        """Withheld, and it answers no SYNC: a watchdog that fires may take it out of operational."""
        return self.station.withheld and self.sample is None

    def _sto_due(self, now_s: float) -> bool:
        blocked = self.stage.power is PowerState.SWITCH_ON_DISABLED
        return blocked and self._ask_for_sto and now_s - self._sto_asked_s >= STO_POLL_S

    def _mode_due(self, now_s: float) -> bool:
        if self._display is None or self._mode_in_pdo or self.stage.power is None:
            return False
        return now_s - self._mode_asked_s >= self.mode.read_after_s(enabled=self.stage.power is _ENABLED)

    async def read(self, sdo: SdoBus, now_s: float) -> list[Finding]:
        """Whether safe torque off is why it may not switch on, and its mode, as it is due. Raises SdoFailed.

        Of one that is mute, its statusword.
        """
        if self._is_mute:
            word = int(await read_number(sdo, self.station.node, self.device.objects.statusword))
            self._barred_by_sdo = self.station.withheld and is_barred(word)
            return []
        if self._sto_due(now_s):
            self._sto_asked_s = now_s
            self.stage.on_safe_torque_off(await self._read_safe_torque_off(sdo))
        if self._mode_due(now_s) and self._display is not None:
            self._mode_asked_s = now_s
            enabled = self.stage.power is _ENABLED  # before it answers: it may be enabled meanwhile
            try:
                mode = int(await read_number(sdo, self.station.node, self._display))
            except SdoFailed:
                self.mode.on_refusal()
                if self.device.objects.mode_displayed is None:
                    return []  # nobody said that it has such an object
                raise
            self.mode.on_mode(mode, enabled=enabled)
        return []

    async def confirm_stopped(self, sdo: SdoBus) -> bool:
        """Disable voltage by SDO, which needs no SYNC, and its statusword as the receipt. Raises SdoFailed."""
        controlword, statusword = self.device.objects.controlword, self.device.objects.statusword
        word = DISABLE_VOLTAGE.to_bytes(2, "little")
        await sdo.download(self.station.node, controlword.index, controlword.sub, word)
        found = int(await read_number(sdo, self.station.node, statusword))
        return power_state(found) not in _WITH_TORQUE

    async def check(self, sdo: SdoBus) -> list[Finding]:
        """Off, and what its map and the line say of it. Raises SdoFailed."""
        objects = self.device.objects
        statusword = int(await read_number(sdo, self.station.node, objects.statusword))
        reasons: list[Finding] = []
        if power_state(statusword) in _WITH_TORQUE:
            reasons.append(finding("still-enabled", drive=self.station.name, statusword=statusword))
        reasons += await self._check_rated_torque(sdo) + await self._check_max_torque(sdo)
        reasons += await check_fixed(sdo, self.station, drive_expected(self.device, self.station.node))
        reasons += await self._check_reaction(sdo)
        self.stage.on_safe_torque_off(await self._read_safe_torque_off(sdo))
        return reasons

    def steps(self) -> list[Step]:
        option, steps = self.device.options.abort_connection, drive_steps(self.device, self.settings)
        if option is None or not self._lacks_reaction:
            return steps
        return [step for step in steps if (step.index, step.sub) != (option.index, option.sub)]

    def release_steps(self) -> list[Step]:
        """A drive that waits for our heartbeat would go to fault."""
        return [replace(self.watchdog, value=0)] if self.station.listens_to is not None else []

    async def _read_safe_torque_off(self, sdo: SdoBus) -> bool:
        """Whether it says that safe torque off is active; False where its map knows no such object."""
        entry = self.device.objects.safe_torque_off
        return entry is not None and entry.is_set(int(await read_number(sdo, self.station.node, entry)))

    async def _check_reaction(self, sdo: SdoBus) -> list[Finding]:
        """A watchdog that is fed and proven, and does nothing when it fires, is refused by name."""
        option = self.device.options.abort_connection
        if option is None:
            return []
        if option.writable:
            self._lacks_reaction = not option.required and await self._lacks(sdo, option)
            return []
        if int(await read_number(sdo, self.station.node, option)):
            return []
        where = place(option.index, option.sub)
        return [finding("watchdog-without-reaction", device=self.station.name, object=where)]

    async def _lacks(self, sdo: SdoBus, entry: CanObject) -> bool:
        try:
            await read_number(sdo, self.station.node, entry)
        except SdoNoObject:
            return True
        return False

    async def _check_rated_torque(self, sdo: SdoBus) -> list[Finding]:
        entry = self.device.objects.rated_torque
        if entry is None:
            return []
        wanted_nm = self.settings.rated_torque_nm
        found_nm = await read_number(sdo, self.station.node, entry) * torque_per_count(
            entry.unit, entry.scale, wanted_nm
        )
        return against_rated_torque(self.station.name, found_nm, wanted_nm)

    async def _check_max_torque(self, sdo: SdoBus) -> list[Finding]:
        entry, settings = self.device.objects.max_torque, self.settings
        if entry is None or entry.writable:
            return []
        nm_per_count = torque_per_count(entry.unit, entry.scale, settings.rated_torque_nm)
        found_nm = await read_number(sdo, self.station.node, entry) * nm_per_count
        step_nm = torque_step(entry.type, entry.unit, entry.scale, settings.rated_torque_nm)
        return against_max_torque(self.station.name, found_nm, settings.torque_limit_nm, step_nm)

    def forget(self) -> None:
        self.station.forget()
        self.sample = None
        self.stage.forget()
        self.mode.forget()
        self._barred_by_sdo = False
        self._mode_asked_s = float("-inf")
