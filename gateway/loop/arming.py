"""Whether the line may be armed, the links' way there, and back to silence however an arming ends."""

from collections.abc import Sequence

from drivers.port import PrepareRefused
from gateway.core.finding import Finding, finding
from gateway.core.line import Device
from gateway.core.line_problem import printable
from gateway.core.messages import Reply
from gateway.core.signals import Channel, Quality
from gateway.core.states import LoopState, Phase
from gateway.loop.cycle import Cycle
from gateway.loop.refused import Refused, coded, said
from gateway.tasks.cleanup import finish_all

SILENT_PATIENCE_S = 0.25  #: without cyclic data (a silent CANopen link reads by SDO) samples are this old at most


def refusal_to_arm(cycle: Cycle) -> Reply | None:
    """Why no link may be touched for an arming: the line is not at rest, or a sample speaks against it. None: go on."""
    try:
        require_rest(cycle)
    except Refused as refusal:
        return refusal.reply(cycle.machine.state.name)
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


def not_ready(cycle: Cycle) -> list[Finding]:
    """What speaks against arming, as far as the samples tell. One that is late is no reason to send a person away."""
    running = cycle.configurations.running
    unfit = [finding("controller-unfit", controller=running.hash[:12], because=running.unfit)] if running.unfit else []
    return unfit + (forbidden(cycle) or _turning(cycle)) + unheard(cycle) + _below_zero(cycle)


def _below_zero(cycle: Cycle) -> list[Finding]:
    """Load cells with a wrong zero. Where the wiring is not proved the proof names them: nothing else is started."""
    return [] if cycle.wiring.against else cycle.watch.below_zero(cycle.inputs)


def _turning(cycle: Cycle) -> list[Finding]:
    return cycle.standstill.turning(cycle.inputs, cycle.clock())


def forbidden(cycle: Cycle) -> list[Finding]:
    """What the line PLC says against arming, as far as it has been heard."""
    inputs = cycle.inputs
    if not plc_heard(cycle):
        return []
    if inputs.plc.emergency_stop:
        return [finding("emergency-stop")]
    if not inputs.plc.permissive:
        return [finding("no-permissive")]
    return _turning(cycle)


def unheard(cycle: Cycle) -> list[Finding]:
    """Devices without a usable sample lately, and what their buses have told last."""
    plc, findings = cycle.line.plc, list[Finding]()
    if not plc_heard(cycle):
        findings += [finding("plc-unheard", plc=plc.name), *_trouble(cycle, plc)]
    for cell in cycle.line.load_cells:
        if not heard(cycle, cycle.inputs.tension, cell.span - 1):
            findings.append(finding("load-cell-unheard", cell=cell.name, span=cell.span))
            findings += [one for one in _trouble(cycle, cell) if one not in findings]
    return findings


def _trouble(cycle: Cycle, device: Device) -> list[Finding]:
    """What the bus of `device` has told last, unless it was about another device."""
    line = cycle.line
    told = next((link.health.last_error for link in cycle.links if link.name == device.bus), "")
    others = {one.name for one in (line.plc, *line.drives, *line.load_cells)} - {device.name}
    if not told or told.partition(":")[0] in others:
        return []
    return [finding("bus-told", bus=device.bus, told=printable(told))]


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
        raise Refused(finding("not-at-rest", state=machine.state.name))
    if machine.phase not in (Phase.SILENT, Phase.OFF):
        raise Refused(finding("torque-not-off", phase=machine.phase.name.lower()))
