"""What the operator's commands do to a cycle: each is done, or refused with every reason and what is allowed."""

from math import isfinite

from gateway.core.doubts import in_words
from gateway.core.line import Recipe
from gateway.core.messages import (
    AbortExperiment,
    Arm,
    Command,
    Configuring,
    Hold,
    Operating,
    Reply,
    RunExperiment,
    SelectRecipe,
    SetSpeed,
    SetTension,
    Start,
    Stop,
)
from gateway.core.nearest import nearest
from gateway.core.states import OPERATORS_STOP, LoopState, Phase
from gateway.loop import machine as machines
from gateway.loop.arming import heard, not_ready, require_rest
from gateway.loop.cycle import Cycle
from gateway.loop.deploy import Prepared, configure
from gateway.loop.judged import least, on_probation, require_judged, unjudged
from gateway.loop.refused import Refused
from gateway.loop.setpoints import STEP_PAUSE_S


def carry_out(cycle: Cycle, command: Command, now_s: float, prepared: Prepared = None) -> Reply:
    """Do `command` between two periods.

    What takes longer goes before it, aside: `arming.prepare_links` for an arming, `deploy.prepare` for what changes
    the configuration.
    """
    configuring = isinstance(command, Configuring)
    try:
        text = configure(cycle, command, prepared, now_s) if configuring else _do(cycle, command, now_s)
    except Refused as refusal:
        reply = Reply(
            ok=False, state=cycle.machine.state.name, text=str(refusal), reasons=refusal.reasons,
            findings=refusal.findings,
        )  # fmt: skip
    else:
        reply = Reply(ok=True, state=cycle.machine.state.name, text=text)
    if configuring:
        return reply.model_copy(update={"in_service": cycle.configurations.in_service(now_s)})
    if not reply.ok:
        return reply
    if isinstance(command, SetTension | SetSpeed | SelectRecipe):  # the operator's word goes before an experiment's
        cycle.experiments.end("a set-point was changed")
    return reply


def _do(cycle: Cycle, command: Operating, now_s: float) -> str:
    match command:
        case Arm():
            return _arm(cycle, now_s)
        case Start():
            return _start(cycle, now_s)
        case Hold():
            return _hold(cycle, now_s)
        case Stop():
            return _stop(cycle, now_s)
        case SetTension():
            return _set_tension(cycle, command, now_s)
        case SetSpeed():
            return _set_speed(cycle, command, now_s)
        case SelectRecipe():
            return _select_recipe(cycle, command)
        case RunExperiment():
            return _run_experiment(cycle, command)
        case AbortExperiment():
            return _abort_experiment(cycle)


def _arm(cycle: Cycle, now_s: float) -> str:
    require_rest(cycle)
    cycle.change(machines.to_phase(cycle.machine, Phase.ARMING, now_s, ""))
    return "watchdogs confirmed; the drives become ready"


def _start(cycle: Cycle, now_s: float) -> str:
    machine = cycle.machine
    match machine.phase:
        case Phase.READY:
            require_judged(cycle, cycle.setpoints.speed_target_m_per_s)
            reasons = not_ready(cycle) + _moving_rollers(cycle)
            if reasons:
                raise Refused("not started; mend what is named and start again", reasons)
            cycle.change(machines.to_phase(machine, Phase.ENABLING, now_s, ""))
            return f"tensioning the web, then {cycle.setpoints.speed_target_m_per_s:g} m/s"
        case Phase.HOLDING:
            cycle.change(machines.to_phase(machine, Phase.RUNNING, now_s, ""))
            return f"back to {cycle.setpoints.speed_target_m_per_s:g} m/s"
        case Phase.ENABLING | Phase.TENSIONING | Phase.RUNNING:
            return "running already"
        case _:
            raise Refused(f"the line is {machine.state.name}: arm it first")


def _moving_rollers(cycle: Cycle) -> list[str]:
    speed = cycle.inputs.speed
    # A web that gives way after a stop lets its rollers creep; a tenth of the line's speed is no creeping.
    creeping = 0.1 * cycle.line.limits.speed_max_m_per_s
    return [
        f"roller {i + 1} does not stand still, or its speed is not known"
        for i in range(cycle.line.n)
        if not heard(cycle, speed, i) or not abs(speed.value[i]) <= creeping
    ]


def _hold(cycle: Cycle, now_s: float) -> str:
    machine = cycle.machine
    if machine.phase is Phase.HOLDING:
        return "held already"
    if machine.phase is not Phase.RUNNING:
        raise Refused(f"only a running line can be held; this one is {machine.phase.name.lower()}")
    cycle.change(machines.to_phase(machine, Phase.HOLDING, now_s, ""))
    return "the line ramps to standstill, tension control stays on; start leads back to speed"


def _stop(cycle: Cycle, now_s: float) -> str:
    before = cycle.machine
    cycle.change(machines.stop(before, now_s, OPERATORS_STOP))
    if cycle.machine is before:
        return "nothing is sent to the drives" if before.state is LoopState.SILENT else "stopping or stopped already"
    if cycle.machine.phase is Phase.OFF:
        return "torque is off; arm leads out of it"
    return "the line ramps to standstill, then torque goes off; arm leads out of it"


def _set_tension(cycle: Cycle, command: SetTension, now_s: float) -> str:
    line, setpoints = cycle.line, cycle.setpoints
    if command.span > line.n:
        raise Refused(f"there is no span {command.span}; allowed: 1 to {line.n}")
    # Noise and overshoot need room: a set-point at the limit would trip the line.
    low = line.limits.tension_min_n + line.limits.tension_margin_n
    high = line.limits.tension_max_n - line.limits.tension_margin_n
    if not (isfinite(command.tension_n) and low <= command.tension_n <= high):
        raise Refused(f"{command.tension_n:g} N is too near a limit or beyond it; allowed: {low:g} to {high:g} N")
    i = command.span - 1
    if command.step:
        size = abs(command.tension_n - setpoints.tension_n[i])
        judged = cycle.configurations.running.region.tension_step_max_n
        largest = least(line.limits.tension_step_max_n, judged)
        _require_step(cycle, size, largest, "N", setpoints.tension_step_pause_s(i, now_s))
        _require_few(size, line.limits.steps_together * largest, setpoints.stepped_lately_n(now_s))
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
        raise Refused(f"{command.speed_m_per_s:g} m/s is outside the limits; allowed: 0 to {high:g} m/s")
    require_judged(cycle, command.speed_m_per_s)
    if command.step:
        size = abs(command.speed_m_per_s - setpoints.speed_m_per_s)
        judged = cycle.configurations.running.region.speed_step_max_m_per_s
        largest = least(line.limits.speed_step_max_m_per_s, judged)
        _require_step(cycle, size, largest, "m/s", setpoints.speed_step_pause_s(now_s))
        _require_safe(cycle.foreseen(setpoints.tension_n, command.speed_m_per_s))
        setpoints.step_speed(command.speed_m_per_s, now_s)
    setpoints.speed_target_m_per_s = command.speed_m_per_s
    how = "at once" if command.step else _pace(cycle, f"at {line.moves.speed_rate_m_per_s2:g} m/s2")
    return f"line speed to {command.speed_m_per_s:g} m/s {how}"


def _pace(cycle: Cycle, rate: str) -> str:
    """Set-points move while the line is controlled; before that they are where it will start to."""
    return rate if cycle.machine.state in (LoopState.RUN, LoopState.HOLD) else "from the next start on"


def _require_step(cycle: Cycle, size: float, largest: float, unit: str, pause_s: float) -> None:
    if cycle.machine.phase is not Phase.RUNNING:
        raise Refused(f"a step needs a running line, this one is {cycle.machine.state.name}; leave out the step")
    if cycle.experiments.run is not None:
        raise Refused("an experiment moves the set-points; abort it first, or leave out the step, which ends it")
    probation = cycle.configurations.probation
    if probation is not None and probation.shaped_first:
        raise Refused(f"epoch {cycle.configurations.epoch} is on probation: set-points move shaped; leave out the step")
    if size > largest * (1.0 + 1e-9):
        raise Refused(f"a step of {size:g} {unit} is too large; allowed: {largest:g} {unit}, or a ramp of any size")
    if pause_s > 0.0:
        raise Refused(f"the last step was just now; the next one may come in {pause_s:.1f} s, a ramp at any time")


def _require_few(size_n: float, largest_n: float, lately_n: float) -> None:
    """Steps of several spans add up in the speed of the rollers behind them."""
    if lately_n + size_n > largest_n * (1.0 + 1e-9):
        raise Refused(
            f"with this step of {size_n:g} N those of the last {STEP_PAUSE_S:g} s come to {lately_n + size_n:g} N; "
            f"allowed: {largest_n:g} N together (limits.steps_together), or a ramp at any time"
        )


def _require_safe(foreseen: str) -> None:
    """The monitor would stop the line for it."""
    if foreseen:
        raise Refused(f"this step is too large at this speed: {foreseen}; a smaller step, or a ramp at any time")


def _select_recipe(cycle: Cycle, command: SelectRecipe) -> str:
    recipes: dict[str, Recipe] = {recipe.name: recipe for recipe in cycle.line.recipes}
    recipe = recipes.get(command.name)
    if recipe is None:
        close = nearest(command.name, recipes)
        hint = f"; did you mean {close}?" if close else ""
        raise Refused(f"there is no recipe {command.name!r}{hint} Known: {', '.join(recipes)}")
    require_judged(cycle, recipe.speed_m_per_s)
    cycle.setpoints.aim_at(recipe)
    return f"recipe {recipe.name}: tensions and speed move to it"


def _run_experiment(cycle: Cycle, command: RunExperiment) -> str:
    experiment = command.experiment
    if cycle.experiments.run is not None:
        raise Refused("an experiment is under way; it can be aborted")
    if cycle.machine.phase is not Phase.RUNNING:
        raise Refused(f"an experiment needs a running line, this one is {cycle.machine.phase.name.lower()}")
    reasons = cycle.experiments.why_not(experiment, cycle.line, judged=command.proposal is not None)
    reasons += on_probation(cycle)
    if command.proposal is None:
        reasons += unjudged(cycle, experiment)
    if doubts := in_words(int(cycle.watch.doubts)):
        reasons.append(f"the loop doubts what it measures: {', '.join(doubts)}")
    if reasons:
        raise Refused("the experiment is not run", reasons)
    cycle.experiments.begin(experiment)
    return f"experiment {experiment.name} runs for {experiment.duration_s:g} s; abort, hold, stop and set end it"


def _abort_experiment(cycle: Cycle) -> str:
    if cycle.experiments.run is None:
        raise Refused("no experiment is under way")
    cycle.experiments.end("operator's abort")
    return "set-points go back to where they stood"
