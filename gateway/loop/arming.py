"""Whether the line may be armed, the links' way there, and back to silence however an arming ends."""

from collections.abc import Sequence

from drivers.port import PrepareRefused
from gateway.core.finding import Finding
from gateway.core.line import Device
from gateway.core.line_problem import printable
from gateway.core.messages import Reply
from gateway.core.signals import Channel, Quality
from gateway.core.states import LoopState, Phase
from gateway.loop.cycle import Cycle
from gateway.loop.refused import Refused, coded, said
from gateway.tasks.cleanup import finish_all

LONGEST_TROUBLE = 300  #: characters of what a bus has told
SILENT_PATIENCE_S = 0.25  #: without cyclic data (a silent CANopen link reads by SDO) samples are this old at most


def refusal_to_arm(cycle: Cycle) -> Reply | None:
    """Why no link may be touched for an arming: the line is not at rest, or a sample speaks against it. None: go on."""
    try:
        require_rest(cycle)
    except Refused as refusal:
        return Reply(ok=False, state=cycle.machine.state.name, text=str(refusal), findings=refusal.findings)
    reasons = not_ready(cycle)
    return not_armed(cycle, reasons) if reasons else None


def not_armed(cycle: Cycle, reasons: Sequence[str | Finding]) -> Reply:
    text = "not armed; mend what is named and arm again"
    state = cycle.machine.state.name
    return Reply(ok=False, state=state, text=text, reasons=said(reasons), findings=coded(reasons))


async def prepare_links(cycle: Cycle) -> list[Finding]:
    """Prove everything that must hold before torque is possible, on links that are released; periods go on meanwhile.

    Returns every reason of every link that refuses. Whoever calls releases all links where there is one, and where
    this is cancelled or raises.
    """
    reasons: list[Finding] = []
    for link in cycle.links:
        try:
            await link.prepare()
        except PrepareRefused as refusal:
            reasons += refusal.reasons
    return reasons


async def release_links(cycle: Cycle) -> None:
    """No link sends any more, and no device waits for it: all of them at once, to the end even where this is cancelled.

    One that fails keeps no other from it. Raises the first failure, after all have been released.
    """
    failures = await finish_all(link.release() for link in cycle.links)
    if failures:
        raise failures[0]


def not_ready(cycle: Cycle) -> list[str | Finding]:
    """What speaks against arming, as far as the samples tell. One that is late is no reason to send a person away."""
    running = cycle.configurations.running
    unfit: list[str | Finding] = [f"controller {running.hash[:12]}: {running.unfit}"] if running.unfit else []
    return unfit + (forbidden(cycle) or _turning(cycle)) + unheard(cycle) + _below_zero(cycle)


def _below_zero(cycle: Cycle) -> list[str | Finding]:
    """Load cells with a wrong zero. Where the wiring is not proved the proof names them: nothing else is started."""
    return [] if cycle.wiring.against else list(cycle.watch.below_zero(cycle.inputs))


def _turning(cycle: Cycle) -> list[str | Finding]:
    return list(cycle.standstill.turning(cycle.inputs, cycle.clock()))


def forbidden(cycle: Cycle) -> list[str | Finding]:
    """What the line PLC says against arming, as far as it has been heard."""
    inputs = cycle.inputs
    if not plc_heard(cycle):
        return []
    if inputs.plc.emergency_stop:
        return ["the emergency stop circuit is open: release it"]
    if not inputs.plc.permissive:
        return ["the line PLC gives no permissive"]
    return _turning(cycle)


def unheard(cycle: Cycle) -> list[str | Finding]:
    """Devices without a usable sample lately."""
    plc = cycle.line.plc
    reasons: list[str | Finding] = (
        [] if plc_heard(cycle) else [f"the line PLC ({plc.name}) gives no usable answer{_trouble(cycle, plc)}"]
    )
    for cell in cycle.line.load_cells:
        if not heard(cycle, cycle.inputs.tension, cell.span - 1):
            reasons.append(f"load cell {cell.name} (span {cell.span}) gives no usable value{_trouble(cycle, cell)}")
    return reasons


def _trouble(cycle: Cycle, device: Device) -> str:
    """What the bus of `device` has told last, to be appended; empty: nothing, or it was about another device."""
    line = cycle.line
    told = next((link.health.last_error for link in cycle.links if link.name == device.bus), "")
    others = {one.name for one in (line.plc, *line.drives, *line.load_cells)} - {device.name}
    if not told or told.partition(":")[0] in others:
        return ""
    return f"; its bus told last: {printable(told)[:LONGEST_TROUBLE]}"


def plc_heard(cycle: Cycle) -> bool:
    # v0 comes in the same answer. A PLC that answers but lost its watchdog is not GOOD either: arming proves it anew.
    inputs = cycle.inputs
    return heard(cycle, inputs.unwind_speed, 0) and inputs.plc.quality in (Quality.GOOD, Quality.STALE)


def heard(cycle: Cycle, channel: Channel, index: int) -> bool:
    """Whether a usable sample came lately: within as many periods as a running line may miss, or SILENT_PATIENCE_S."""
    age_s = cycle.clock() - channel.time_s[index]  # NaN for one that was never heard
    return bool(age_s < max((cycle.limits.hold_periods + 1) * cycle.limits.period_s, SILENT_PATIENCE_S))


def require_rest(cycle: Cycle) -> None:
    machine = cycle.machine
    if machine.state not in (LoopState.SILENT, LoopState.STOP):
        raise Refused(f"the line is {machine.state.name} already")
    if machine.phase not in (Phase.SILENT, Phase.OFF):
        raise Refused(f"the line is still {machine.phase.name.lower()}: wait until torque is off")
