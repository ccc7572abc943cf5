"""What the operator's commands do to a cycle: each is done, or refused with every reason and what is allowed."""

from collections.abc import Callable
from dataclasses import replace
from math import isfinite
from textwrap import shorten

from gateway.core.finding import LONGEST_PARAMETER, Finding, finding
from gateway.core.line import Recipe
from gateway.core.line_limits import setpoint_bands_n
from gateway.core.messages import (
    Arm,
    Command,
    Configuring,
    Drill,
    Hold,
    KeepProof,
    Operating,
    Prove,
    Reply,
    RunExperiment,
    SelectRecipe,
    SetSpeed,
    SetTension,
    Start,
    Stop,
)
from gateway.core.nearest import nearest
from gateway.core.proof import Proof
from gateway.core.states import LoopState, Phase
from gateway.core.wiring_proof import WiringProof, asked_of, devices_of, merged, not_shown, undrilled
from gateway.loop import machine as machines
from gateway.loop.arming import heard, not_ready, require_rest
from gateway.loop.cycle import Cycle
from gateway.loop.deploy import Prepared, configure
from gateway.loop.judged import least, on_probation, require_judged, unjudged
from gateway.loop.refused import Refused, said
from safety.recoverability import Shortfall

NOT_STARTED = "not started; mend what is named and start again"
NOTHING_KEPT = "nothing is kept"
OPERATORS_STOP = "operator's stop"  #: for people to read; what tells it from others is `Machine.by_person`
STEP_UNSAFE = {"span": "step-unsafe-tension", "roller": "step-unsafe-speed"}


def carry_out(
    cycle: Cycle, command: Command, now_s: float, prepared: Prepared = None, proof: Proof | None = None
) -> Reply:
    """Do `command` between two periods.

    What takes longer goes before it, aside: `arming.prepare_links` for an arming, `deploy.prepare` for what changes
    the configuration.
    """
    configuring = isinstance(command, Configuring)
    try:
        text = configure(cycle, command, prepared, now_s, proof) if configuring else _do(cycle, command, now_s)
    except Refused as refusal:
        reply = refusal.reply(cycle.machine.state.name)
    else:
        reply = Reply(ok=True, state=cycle.machine.state.name, text=text)
    if configuring:
        return reply.model_copy(update={"in_service": cycle.in_service()})
    if not reply.ok:
        return reply
    if isinstance(command, SetTension | SetSpeed | SelectRecipe):  # the operator's word goes before an experiment's
        cycle.experiments.end("a set-point was changed")
    return reply


def _do(cycle: Cycle, command: Operating, now_s: float) -> str:
    if plain := PLAIN.get(type(command)):
        return plain(cycle, now_s)
    match command:
        case Prove():
            return _prove(cycle, command, now_s)
        case KeepProof():
            return cycle.wiring.take_written()
        case SetTension():
            return _set_tension(cycle, command, now_s)
        case SetSpeed():
            return _set_speed(cycle, command, now_s)
        case SelectRecipe():
            return _select_recipe(cycle, command, now_s)
        case RunExperiment():
            return _run_experiment(cycle, command)
        case _:
            return _abort_experiment(cycle)


def _arm(cycle: Cycle, now_s: float) -> str:
    require_rest(cycle)
    cycle.change(machines.to_phase(cycle.machine, Phase.ARMING, now_s, ""))
    unproved = f"; start will be refused: {said(cycle.wiring.against)[0]}" if cycle.wiring.against else ""
    return f"watchdogs confirmed; the drives become ready{unproved}"


def _drill(cycle: Cycle, now_s: float) -> str:
    require_rest(cycle)
    if cycle.inputs.plc.local:
        raise Refused(finding("line-local"), title="not drilled; mend what is named and try again")
    cycle.change(machines.to_phase(cycle.machine, Phase.DRILLING, now_s, ""))
    return "the feed of every watchdog is withheld at rest, and its reaction seen"


def _start(cycle: Cycle, now_s: float) -> str:
    machine = cycle.machine
    match machine.phase:
        case Phase.READY:
            require_judged(cycle, cycle.setpoints.speed_target_m_per_s)
            if reasons := [*cycle.wiring.against, *_against_torque(cycle)]:
                raise Refused(*reasons, title=NOT_STARTED)
            warned = _warn(cycle, now_s, proves=False)
            return f"{warned}tensioning the web, then {cycle.setpoints.speed_target_m_per_s:g} m/s"
        case Phase.HOLDING:
            if machine.resumes:
                return "started already: the warning lasts"
            _require_remote(cycle)
            warned = _resume(cycle, now_s, stands=cycle.setpoints.speed_m_per_s == 0.0)
            return f"{warned}back to {cycle.setpoints.speed_target_m_per_s:g} m/s"
        case Phase.PROVING:
            raise Refused(finding("wiring-being-proved"))
        case Phase.WARNING | Phase.ENABLING | Phase.TENSIONING | Phase.RUNNING:
            return "running already" if machine.phase is not Phase.WARNING else "started already: the warning lasts"
        case _:
            raise Refused(finding("arm-first", state=machine.state.name))


def _resume(cycle: Cycle, now_s: float, *, stands: bool) -> str:
    """Go on running; a web that `stands` moves after the warning. Returns what is done first, in words."""
    warning_s = cycle.line.stages.start_warning_s
    if stands and warning_s and cycle.setpoints.speed_target_m_per_s > 0.0:
        cycle.change(machines.resume(cycle.machine, now_s))
        return f"warning for {warning_s:g} s, then "
    if cycle.machine.phase is not Phase.RUNNING:
        cycle.change(machines.to_phase(cycle.machine, Phase.RUNNING, now_s, ""))
    return ""


def _require_remote(cycle: Cycle) -> None:
    """Nobody who does not see the line sets it in motion from standstill while the line PLC says "local"."""
    if cycle.inputs.plc.local:
        raise Refused(finding("line-local"), title=NOT_STARTED)


def _prove(cycle: Cycle, command: Prove, now_s: float) -> str:
    machine = cycle.machine
    if machine.phase is not Phase.READY:  # until then nobody knows the devices of today
        raise Refused(finding("arm-first", state=machine.state.name))
    _require_only(cycle, command.only)
    # A drive that nothing is known of is given torque only once its watchdog has been seen to take it off.
    without_drill = [] if cycle.drill.watchdogs else [finding("not-drilled")]
    if reasons := without_drill + _against_torque(cycle):
        raise Refused(*reasons, title="not proved; mend what is named and prove again")
    cycle.proving.choose(command.only)
    warned = _warn(cycle, now_s, proves=True)
    if command.only:
        drives = ", ".join(_pulled(cycle)) or "none"
        return f"{warned}drives that pull a little: {drives}; the line stands meanwhile"
    return f"{warned}one drive after the other pulls a little; the line stands meanwhile"


def _pulled(cycle: Cycle) -> list[str]:
    names = {drive.roller - 1: drive.name for drive in cycle.line.drives}
    return [names[i] for i in cycle.proving.pulled()]


def _require_only(cycle: Cycle, only: list[str]) -> None:
    """That a proof is restricted to devices that are there, and that nothing else has changed since the last one."""
    names = [device.name for device in devices_of(cycle.line)]
    unknown = [
        finding(
            "device-unknown",
            device=name,
            names=shorten(", ".join(names), LONGEST_PARAMETER),
            nearest=nearest(name, names) or "-",
        )
        for name in only
        if name not in names
    ]
    if unknown:
        raise Refused(*unknown, title="not proved; name devices of the line's file")
    if only and (more := cycle.wiring.more_than(only)):
        raise Refused(*more, title="not proved; name whatever has changed, or prove the whole wiring: `r2rgate prove`")


def proof_to_keep(cycle: Cycle, command: KeepProof) -> WiringProof:
    """The proof that the last drill and the last pulls make, with a person's answers. Raises Refused."""
    require_rest(cycle)
    judged, watchdogs = cycle.proving.judged, cycle.drill.watchdogs
    if not watchdogs:
        raise Refused(finding("not-drilled"), title=NOTHING_KEPT)
    if judged is None or cycle.proving.only != frozenset(command.only):
        raise Refused(finding("not-pulled"), title=NOTHING_KEPT)
    _require_only(cycle, command.only)
    if judged.findings:
        against = [each.as_data() for each in judged.findings]
        raise Refused(*against, title="the wiring is not as the line's file says; mend what is named and prove again")
    answered = {(answer.question, answer.device) for answer in command.answers}
    if open_ := [each for each in judged.questions if (each.code, asked_of(each)) not in answered]:
        raise Refused(finding("person-asked"), *open_, title="nothing is kept before a person has answered")
    # An answer to what nobody has asked stands for nothing.
    asked = {(each.code, asked_of(each)) for each in judged.questions}
    answers = [each for each in command.answers if (each.question, each.device) in asked]
    drives, cells = judged.drives, judged.cells
    if command.only and cycle.wiring.proof is not None:
        drives, cells, answers = merged(cycle.wiring.proof, command.only, drives, cells, answers)
    # The drill has seen every device, whatever has pulled.
    if unshown := not_shown(cycle.line, drives, cells, answers) + undrilled(cycle.line, watchdogs):
        raise Refused(*unshown, title="nothing is kept of a proof that leaves something out")
    return cycle.wiring.proof_of(drives, cells, watchdogs, answers)


def _against_torque(cycle: Cycle) -> list[Finding]:
    """What speaks against a first torque now."""
    reasons = not_ready(cycle) + _unknown_rollers(cycle)
    return [*reasons, finding("line-local")] if cycle.inputs.plc.local else reasons


def _warn(cycle: Cycle, now_s: float, *, proves: bool) -> str:
    """Begin with the warning, where there is one. Returns what is done first, in words."""
    warning_s = cycle.line.stages.start_warning_s
    started = replace(cycle.machine, proves=proves)
    cycle.change(machines.to_phase(started, Phase.WARNING if warning_s else Phase.ENABLING, now_s, ""))
    return f"warning for {warning_s:g} s, then " if warning_s else ""


def _unknown_rollers(cycle: Cycle) -> list[Finding]:
    speed = cycle.inputs.speed
    return [finding("roller-speed-unknown", roller=i + 1) for i in range(cycle.line.n) if not heard(cycle, speed, i)]


def _hold(cycle: Cycle, now_s: float) -> str:
    machine = cycle.machine
    if machine.phase is Phase.HOLDING:
        if machine.resumes:
            cycle.change(machines.to_phase(machine, Phase.HOLDING, now_s, ""))
            return "the warning ends, and the line stays held"
        return "held already"
    if machine.phase is not Phase.RUNNING:
        raise Refused(finding("needs-running", phase=machine.phase.name.lower()))
    cycle.change(machines.to_phase(machine, Phase.HOLDING, now_s, ""))
    return "the line ramps to standstill, tension control stays on; start leads back to speed"


def _stop(cycle: Cycle, now_s: float) -> str:
    before = cycle.machine
    cycle.change(machines.stop(before, now_s, OPERATORS_STOP, by_person=True))
    if cycle.machine is before:
        return "nothing is sent to the drives" if before.state is LoopState.SILENT else "stopping or stopped already"
    if cycle.machine.phase is Phase.OFF:
        return "torque is off; arm leads out of it"
    return "the line ramps to standstill, then torque goes off; arm leads out of it"


#: Commands that say nothing but what they are.
PLAIN: dict[type[Operating], Callable[[Cycle, float], str]] = {
    Arm: _arm, Drill: _drill, Start: _start, Hold: _hold, Stop: _stop,
}  # fmt: skip


def _set_tension(cycle: Cycle, command: SetTension, now_s: float) -> str:
    line, setpoints = cycle.line, cycle.setpoints
    if command.span > line.n:
        raise Refused(finding("no-such-span", span=command.span, spans=line.n))
    # Noise and overshoot need room: a set-point at the limit would trip the line.
    low, high = (float(bound[command.span - 1]) for bound in setpoint_bands_n(line))
    if not (isfinite(command.tension_n) and low <= command.tension_n <= high):
        raise Refused(finding("tension-out-of-range", tension_n=command.tension_n, low_n=low, high_n=high))
    i = command.span - 1
    if command.step:
        size = abs(command.tension_n - setpoints.tension_n[i])
        judged = cycle.configurations.running.region.tension_step_max_n
        largest = least(line.limits.tension_step_max_n, judged)
        _require_step(cycle, setpoints.tension_step_pause_s(i, now_s))
        if size > largest * (1.0 + 1e-9):
            raise Refused(finding("step-too-large-tension", step_n=size, allowed_n=largest))
        _require_few(
            size, line.limits.steps_together * largest, setpoints.stepped_lately_n(now_s), setpoints.step_pause_s
        )
        stepped_n = setpoints.tension_n.copy()
        stepped_n[i] = command.tension_n
        _require_safe(cycle.foreseen(stepped_n))
        setpoints.step_tension(i, command.tension_n, now_s)
    setpoints.tension_target_n[i] = command.tension_n
    how = "at once" if command.step else _pace(cycle, f"at {line.moves.tension_rate_n_per_s:g} N/s")
    return f"span {command.span} to {command.tension_n:g} N {how}"


def _set_speed(cycle: Cycle, command: SetSpeed, now_s: float) -> str:
    line, setpoints = cycle.line, cycle.setpoints
    high = line.limits.speed_max_m_per_s
    if not (isfinite(command.speed_m_per_s) and 0.0 <= command.speed_m_per_s <= high):
        raise Refused(finding("speed-out-of-range", speed_m_per_s=command.speed_m_per_s, allowed_m_per_s=high))
    require_judged(cycle, command.speed_m_per_s)
    departs = _departs(cycle, command.speed_m_per_s)
    if departs:
        _require_remote(cycle)
    if command.step:
        if departs and line.stages.start_warning_s:
            raise Refused(finding("step-from-standstill"))
        size = abs(command.speed_m_per_s - setpoints.speed_m_per_s)
        judged = cycle.configurations.running.region.speed_step_max_m_per_s
        largest = least(line.limits.speed_step_max_m_per_s, judged)
        _require_step(cycle, setpoints.speed_step_pause_s(now_s))
        if size > largest * (1.0 + 1e-9):
            raise Refused(finding("step-too-large-speed", step_m_per_s=size, allowed_m_per_s=largest))
        _require_safe(cycle.foreseen(setpoints.tension_n, command.speed_m_per_s))
        setpoints.step_speed(command.speed_m_per_s, now_s)
    setpoints.speed_target_m_per_s = command.speed_m_per_s
    warned = _resume(cycle, now_s, stands=True) if departs else ""
    how = "at once" if command.step else _pace(cycle, f"at {line.moves.speed_rate_m_per_s2:g} m/s2")
    return f"{warned}line speed to {command.speed_m_per_s:g} m/s {how}"


def _departs(cycle: Cycle, speed_m_per_s: float) -> bool:
    """Whether a line that runs at standstill is set in motion by this speed."""
    stands = cycle.machine.phase is Phase.RUNNING and cycle.setpoints.speed_m_per_s == 0.0
    return stands and speed_m_per_s > 0.0


def _pace(cycle: Cycle, rate: str) -> str:
    """Set-points move while the line is controlled; before that they are where it will start to."""
    return rate if cycle.machine.state in (LoopState.RUN, LoopState.HOLD) else "from the next start on"


def _require_step(cycle: Cycle, pause_s: float) -> None:
    if cycle.machine.phase is not Phase.RUNNING:
        raise Refused(finding("step-needs-running", state=cycle.machine.state.name))
    if cycle.experiments.run is not None:
        raise Refused(finding("step-in-experiment"))
    probation = cycle.configurations.probation
    if probation is not None and probation.shaped_first:
        raise Refused(finding("step-on-probation", epoch=cycle.configurations.epoch))
    if pause_s > 0.0:
        raise Refused(finding("step-too-soon", pause_s=pause_s))


def _require_few(size_n: float, largest_n: float, lately_n: float, pause_s: float) -> None:
    """Steps of several spans add up in the speed of the rollers behind them."""
    together_n = lately_n + size_n
    if together_n > largest_n * (1.0 + 1e-9):
        values = {"step_n": size_n, "together_n": together_n, "allowed_n": largest_n, "within_s": pause_s}
        raise Refused(finding("steps-too-large-together", **values))


def _require_safe(foreseen: Shortfall | None) -> None:
    """The monitor would stop the line for it."""
    if foreseen is not None:
        raise Refused(finding(STEP_UNSAFE[foreseen.what], **foreseen.parameters))


def _select_recipe(cycle: Cycle, command: SelectRecipe, now_s: float) -> str:
    recipes: dict[str, Recipe] = {recipe.name: recipe for recipe in cycle.line.recipes}
    recipe = recipes.get(command.name)
    if recipe is None:
        close = nearest(command.name, recipes) or ", ".join(recipes)
        raise Refused(finding("no-such-recipe", recipe=command.name, nearest=close))
    require_judged(cycle, recipe.speed_m_per_s)
    departs = _departs(cycle, recipe.speed_m_per_s)
    if departs:
        _require_remote(cycle)
    cycle.setpoints.aim_at(recipe)
    warned = _resume(cycle, now_s, stands=True) if departs else ""
    return f"{warned}recipe {recipe.name}: tensions and speed move to it"


def _run_experiment(cycle: Cycle, command: RunExperiment) -> str:
    experiment = command.experiment
    if cycle.experiments.run is not None:
        raise Refused(finding("experiment-under-way"))
    if cycle.machine.phase is not Phase.RUNNING:
        raise Refused(finding("needs-running", phase=cycle.machine.phase.name.lower()))
    why_not = cycle.experiments.why_not(experiment, cycle.line, judged=command.proposal is not None)
    reasons = [finding("experiment-unfit", because=reason) for reason in why_not] + on_probation(cycle)
    warns = cycle.line.stages.start_warning_s > 0.0
    if warns and any(_departs(cycle, leg.speed_m_per_s or 0.0) for leg in experiment.legs):
        reasons.append(finding("experiment-departs"))
    if command.proposal is None:
        reasons += unjudged(cycle, experiment)
    if reasons := reasons + cycle.watch.doubted():
        raise Refused(*reasons, title="the experiment is not run")
    cycle.experiments.begin(experiment)
    return f"experiment {experiment.name} runs for {experiment.duration_s:g} s; abort, hold, stop and set end it"


def _abort_experiment(cycle: Cycle) -> str:
    if cycle.experiments.run is None:
        raise Refused(finding("no-experiment"))
    cycle.experiments.end("operator's abort")
    return "set-points go back to where they stood"
