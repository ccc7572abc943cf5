"""One axis on OPC UA: what is asked of it and told to it each cycle, and which of its answers may be believed. No I/O.

Its command carries a life counter; the axis takes its torque off when that stands still. So an axis that is lost, that
refuses a command or does not obey is not written to any more until the next `prepare`: its own watchdog takes torque
off. One whose watchdog is found to be another than was set would keep its torque in silence: it is told to take it
off, without a life counter.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.cia402 import DISABLE_VOLTAGE, PowerState, power_state
from drivers.life import LifeCounter
from drivers.mode_display import ModeDisplay
from drivers.opcua.maps import DriveMap
from drivers.opcua.nodes import DeviceNodes, NodeTable, Reading, to_type
from drivers.opcua.proof import ANSWERS_ALLOWED, Proof, Watchdog, not_read
from drivers.opcua.source_time import STANDS_STILL, SourceTime
from drivers.opcua.status import describe, is_done
from drivers.power_stage import ORDERS_IGNORED, PowerStage
from drivers.scaling import speed_per_count, torque_per_count, torque_step
from drivers.torque_rules import against_max_torque, against_rated_torque
from gateway.core.finding import Finding, finding
from gateway.core.signals import Channel, DriveCondition, DriveState, Inputs, Outputs
from gateway.wording.catalogue import sentence, sentences

_WARNS = int(DriveCondition.WARNS)
_TORQUE_ON = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION)
_TORQUE_OFF = (
    PowerState.SWITCH_ON_DISABLED,
    PowerState.READY_TO_SWITCH_ON,
    PowerState.SWITCHED_ON,
    PowerState.FAULT,
)
_FAULT = 0x08  #: the bits 0 to 3 and 6 of a fault; a combination that the profile does not know only counts as one
_WATCHED = 3  #: readings whose source time stamps have to move: statusword, speed, torque
_LEFT_ALONE = "it is not written to any more, so that its watchdog takes torque off"
_TOLD_OFF = "it is told to take torque off"


@dataclass(frozen=True, slots=True)
class AxisSettings:
    """What a line asks of one axis. `index` is roller - 1."""

    name: str
    index: int
    address: int
    channel: int
    rated_torque_nm: float
    torque_limit_nm: float
    watchdog_s: float
    radius_m: float


class Axis:
    """`distrust` is why it is not commanded until the next `prepare`, empty while there is no reason."""

    def __init__(self, device: DriveMap, settings: AxisSettings, table: NodeTable) -> None:
        self.name = settings.name
        self.stage = PowerStage(device.follows_command, device.voltage_enabled)
        self.missed = ANSWERS_ALLOWED  #: cycles in a row without a usable answer; nothing was heard yet
        self.active = False  #: the link is not silent
        self.distrust: Sequence[Finding] = ()
        self._settings = settings
        self._index = settings.index
        entries = device.nodes
        nodes = DeviceNodes(table, device.namespace, settings.address, settings.channel)
        self.watchdog = Watchdog(device.watchdog, settings.watchdog_s, nodes)
        self.proof = Proof(settings.name, device.identity, self.watchdog, nodes)
        self.serial = nodes.serial(device.serial)  #: its node
        rated_nm = settings.rated_torque_nm
        speed, torque, target = entries.speed, entries.torque, entries.target_torque
        self._m_per_s_per_count = speed_per_count(speed.unit, speed.scale, settings.radius_m)
        self._nm_per_count = torque_per_count(torque.unit, torque.scale, rated_nm)
        self._target_nm_per_count = torque_per_count(target.unit, target.scale, rated_nm)
        self._target_type = target.type
        self.statusword = nodes.place(entries.statusword, entries.statusword.type)
        self._sto, self._error_code = entries.safe_torque_off, entries.error_code
        self._mode: ModeDisplay | None = None
        displayed = entries.mode_displayed
        if displayed is not None and device.torque_mode is not None:
            self._mode = ModeDisplay(device.torque_mode, at_rest=displayed.shown == "always", certain=True)
        optional = {"sto": entries.safe_torque_off, "mode": displayed, "error": entries.error_code}
        self._optional = {name: entry for name, entry in optional.items() if entry is not None}  #: in their order
        cyclic = [entries.statusword, speed, torque, *self._optional.values()]
        self.reads = tuple(nodes.place(entry, entry.type) for entry in cyclic)  #: each cycle
        command = (entries.controlword, target, entries.life)
        self._command_nodes = tuple(nodes.place(entry, entry.type) for entry in command)
        self._max_torque = entries.max_torque
        self._rated_torque = entries.rated_torque
        torques = [entry for entry in (entries.max_torque, entries.rated_torque) if entry is not None]
        #: what `prepare` looks at: identity, watchdog, statusword, max torque, and rated torque where there is one
        self.prepare_reads = (
            *self.proof.nodes,
            self.statusword,
            *(nodes.place(entry, entry.type) for entry in torques),
        )
        self._life = LifeCounter()
        self._command: tuple[int, float] | None = None  #: controlword and torque (counts) of this cycle
        self._refused = False  #: a command; while the server refuses a part of a Write, it may do nothing of it
        self._sampled = [SourceTime(device.source_time) for _ in range(_WATCHED)]

    # the cycle

    @property
    def state(self) -> DriveState:
        if self.missed >= ANSWERS_ALLOWED:
            return DriveState.ABSENT
        return DriveState.FAULT if self.distrust else self.stage.state

    def command(self, outputs: Outputs) -> None:
        """What the next write says. Raises ValueError when the torque cannot be commanded; nothing is written then."""
        self._command = None
        if self.state == DriveState.ABSENT:
            self._drop(finding("device-unanswered", device=self.name, cycles=self.missed))
        if self.distrust:
            return
        request, torque_nm = int(outputs.drive_request[self._index]), float(outputs.torque_nm[self._index])
        # Converted also where it is not given: what cannot be commanded says that something is wrong.
        self._torque_counts(torque_nm)
        word, given_nm = self.stage.command(request, torque_nm, self.state, trusted=True)
        if self.stage.disobeys:
            self._drop(finding("orders-ignored", drive=self.name, orders=ORDERS_IGNORED))
            return
        self._command = (word, self._torque_counts(given_nm))

    def _torque_counts(self, torque_nm: float) -> float:
        return to_type(torque_nm / self._target_nm_per_count, self._target_type)

    def take_writes(self) -> list[tuple[int, float]]:
        """The command that was handed over for this cycle, once."""
        command, self._command = self._command, None
        if self._tells_off() and self.stage.power in _TORQUE_ON:
            return list(zip(self._command_nodes[:2], (float(DISABLE_VOLTAGE), 0.0), strict=True))
        if command is None or not self.may_write:
            return []
        return list(zip(self._command_nodes, (*command, self._life.next()), strict=True))

    @property
    def may_write(self) -> bool:
        """Whether it is commanded; one that is not is left to its watchdog."""
        return self.active and self.proof.proven and not self.distrust

    def _tells_off(self) -> bool:
        return self.active and self.proof.unguarded and not self._refused

    def on_written(self, statuses: tuple[int, ...]) -> str:
        """What became of the command; returns what was wrong."""
        refused = [describe(status) for status in statuses if not is_done(status)]
        if not refused:
            return ""
        self._refused = True
        self._drop(finding("command-refused", device=self.name, error=", ".join(dict.fromkeys(refused))))
        return self._why_dropped()

    def _drop(self, *why: Finding) -> None:
        """It cannot be commanded: a life counter that goes on would keep a watchdog fed that nobody listens behind."""
        self.distrust = self.distrust or why

    def _why_dropped(self) -> str:
        return f"{sentences(self.distrust)}; {_TOLD_OFF if self._tells_off() else _LEFT_ALONE}"

    def connection_lost(self) -> None:
        """Whatever answers on the next connection has to prove itself before it is believed or written to."""
        self.proof.void()

    def fill(self, inputs: Inputs, time_s: float, readings: tuple[Reading, ...] | None) -> list[str]:
        """Speed, torque and state into `inputs`; returns what was wrong. Without an answer they are missed."""
        index = self._index
        if self.active and self.proof.doubts:
            self._drop(*self.proof.doubts)
        if readings is None or not self.proof.known:
            self._miss(inputs)
            return [sentence(doubt) for doubt in self.proof.doubts] if readings is not None else []
        statusword, speed, torque, *optional = readings
        watched = zip(self._sampled, (statusword, speed, torque), strict=True)
        old_status, old_speed, old_torque = [sampled.stands_still(of.source_us) for sampled, of in watched]
        if old_status:
            self._miss(inputs)
            return [f"{self.name}: statusword: {STANDS_STILL}"]
        if not statusword.good:  # nobody knows what the rest is worth
            self.missed += 1
            inputs.speed.reject(index)
            inputs.torque.reject(index)
            inputs.drive_state[index], inputs.power_barred[index] = self.state, False
            return [f"{self.name}: statusword: {statusword.trouble}"]
        self.missed = 0
        troubles = [self._why_dropped()] if self.distrust else []
        troubles += self._hear(inputs, int(statusword.value), optional)
        for channel, what, reading, si_per_count, is_old in (
            (inputs.speed, "speed", speed, self._m_per_s_per_count, old_speed),
            (inputs.torque, "torque", torque, self._nm_per_count, old_torque),
        ):
            if is_old:
                channel.miss(index)
                troubles.append(f"{self.name}: {what}: {STANDS_STILL}")
            else:
                troubles.append(self._put(channel, what, reading, si_per_count, time_s))
        inputs.drive_state[index], inputs.power_barred[index] = self.state, self.stage.barred
        return [trouble for trouble in troubles if trouble]

    def _miss(self, inputs: Inputs) -> None:
        self.missed += 1
        inputs.speed.miss(self._index)
        inputs.torque.miss(self._index)
        inputs.drive_state[self._index], inputs.power_barred[self._index] = self.state, False

    def _hear(self, inputs: Inputs, statusword: int, optional: list[Reading]) -> list[str]:
        troubles: list[str] = []
        said = dict(zip(self._optional, optional, strict=True))
        safe_torque_off: bool | None = None
        if self._sto is not None:
            found = said["sto"]
            safe_torque_off = self._sto.is_set(found.value) if found.good else None
            troubles += [] if found.good else [f"{self.name}: safe torque off: {found.trouble}"]
        self.stage.on_statusword(statusword, safe_torque_off)
        error = said.get("error")
        if error is not None and self.stage.state == DriveState.FAULT:
            troubles.append(f"{self.name}: fault {int(error.value):04X}h" if error.good else f"{self.name}: fault")
        return troubles + self._tell_condition(inputs, said.get("mode"), error)

    def _tell_condition(self, inputs: Inputs, mode: Reading | None, error: Reading | None) -> list[str]:
        """What it says beside its state, and the code of what it warns of; returns what cannot be read."""
        index, condition, troubles = self._index, self.stage.condition, list[str]()
        if self._mode is not None and mode is not None:
            enabled = self.stage.power is PowerState.OPERATION_ENABLED
            if mode.good:
                self._mode.on_mode(int(mode.value), enabled=enabled)
                inputs.drive_mode[index] = int(mode.value)
            else:
                self._mode.on_refusal()
                troubles.append(f"{self.name}: mode of operation: {mode.trouble}")
            condition |= self._mode.condition(enabled=enabled)
        inputs.drive_condition[index] = condition
        coded = error is not None and error.good and condition & _WARNS and self.stage.state != DriveState.FAULT
        inputs.drive_warning[index] = int(error.value) if coded and error is not None else 0
        return troubles

    def _put(self, channel: Channel, what: str, reading: Reading, si_per_count: float, time_s: float) -> str:
        if not reading.good:
            channel.reject(self._index)
            return f"{self.name}: {what}: {reading.trouble}"
        value = reading.value * si_per_count
        channel.put(self._index, value, time_s)
        return "" if abs(value) < float("inf") else f"{self.name}: {what} {value} is not finite"

    # prepare and release

    def activate(self) -> None:
        """`prepare` has proven it."""
        self.active = True
        self.missed = 0
        self.proof.confirm()

    def forget(self) -> None:
        """Nothing that was true of the drive before counts any more, except that it was heard."""
        self.active = False
        self.stage.forget()
        if self._mode is not None:
            self._mode.forget()
        self.distrust = ()
        self._refused = False
        self._command = None
        self._life.forget()

    def against(self, readings: tuple[Reading, ...]) -> list[Finding]:
        """What `prepare_reads` say against giving it torque."""
        identity, watchdog, statusword, *torques = readings
        if reasons := self.proof.against_identity(identity):
            return reasons
        reasons = [] if watchdog.good else [not_read(self.name, "watchdog", watchdog)]
        if not statusword.good:
            reasons.append(not_read(self.name, "statusword", statusword))
        elif power_state(word := int(statusword.value)) in _TORQUE_ON:
            reasons.append(finding("still-enabled", drive=self.name, statusword=word))
        reasons += self._against_max_torque(torques[0])
        if self._rated_torque is not None:
            reasons += self._against_rated_torque(torques[1])
        return reasons

    def _against_max_torque(self, found: Reading) -> list[Finding]:
        if not found.good:
            return [not_read(self.name, "max_torque", found)]
        entry, settings = self._max_torque, self._settings
        found_nm = found.value * torque_per_count(entry.unit, entry.scale, settings.rated_torque_nm)
        step_nm = torque_step(entry.type, entry.unit, entry.scale, settings.rated_torque_nm)
        return against_max_torque(self.name, found_nm, settings.torque_limit_nm, step_nm)

    def _against_rated_torque(self, found: Reading) -> list[Finding]:
        if not found.good:
            return [not_read(self.name, "rated_torque", found)]
        entry, wanted_nm = self._rated_torque, self._settings.rated_torque_nm
        assert entry is not None
        found_nm = found.value * torque_per_count(entry.unit, entry.scale, wanted_nm)
        return against_rated_torque(self.name, found_nm, wanted_nm)

    def farewell(self) -> list[tuple[int, float]]:
        """A last command: torque off."""
        return list(zip(self._command_nodes, (float(DISABLE_VOLTAGE), 0.0, float(self._life.next())), strict=True))

    def against_off(self, statusword: Reading) -> str:
        """What speaks against its torque being off; empty when it says that it is."""
        if not statusword.good:
            return f"its statusword cannot be read: {statusword.trouble}"
        word = int(statusword.value)
        if (power := power_state(word)) in _TORQUE_OFF and (power is not PowerState.FAULT or word & 0x4F == _FAULT):
            return ""
        return f"was told to take torque off and does not say that it is (statusword {word:04X}h)"
