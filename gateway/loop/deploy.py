"""What commands about the configuration do to a cycle: each is done, or refused with every reason."""

from gateway.core.controller import Controller, ControllerRefused
from gateway.core.deployment import Deployment, RecoveryPrediction
from gateway.core.doubts import in_words
from gateway.core.messages import AskConfiguration, Configuring, Deploy, Keep, Narrow, Renew, Rollback, WatchGood
from gateway.core.states import Phase
from gateway.loop.configurations import Configurations
from gateway.loop.cycle import Cycle
from gateway.loop.refused import Refused
from safety.recoverability import Recovery

CHANGEABLE = (Phase.SILENT, Phase.READY, Phase.RUNNING, Phase.HOLDING)


def configure(cycle: Cycle, command: Configuring, now_s: float) -> str:
    """Do `command` between two periods. Raises Refused."""
    match command:
        case Deploy():
            return _deploy(cycle, command.deployment, now_s)
        case Renew():
            _require_probation(cycle, command.epoch)
            cycle.configurations.renew(now_s)
            return f"the lease of epoch {command.epoch} begins anew"
        case Keep():
            return _keep(cycle, command)
        case WatchGood():
            return _watch_good(cycle, command)
        case Narrow():
            return _narrow(cycle, command)
        case Rollback():
            done = cycle.configurations.roll_back(command.reason)
            runs = f"{cycle.configurations.good.hash[:12]}, the last known good, runs"
            return f"{runs} again" if done else f"{runs} already"
        case AskConfiguration():
            return "what controls the line"


def against(cycle: Cycle, deployment: Deployment) -> list[str]:
    """What speaks against a swap now, but for the configuration itself."""
    configurations, setpoints, phase = cycle.configurations, cycle.setpoints, cycle.machine.phase
    reasons: list[str] = []
    if configurations.probation is not None:
        reasons.append(f"epoch {configurations.epoch} is on probation: keep it or roll it back first")
    if deployment.epoch != configurations.epoch + 1:
        reasons.append(f"its epoch is {deployment.epoch}; allowed: {configurations.epoch + 1}, the next one")
    if phase not in CHANGEABLE:
        reasons.append(f"the line is {phase.name.lower()}; allowed: silent, ready, running, holding")
    if cycle.experiments.run is not None:
        reasons.append("an experiment is under way: wait for its end, or abort it")
    elif phase in (Phase.RUNNING, Phase.HOLDING) and not setpoints.stands(phase is Phase.HOLDING):
        reasons.append("set-points are on their way: wait until they stand")
    if cycle.account.held:
        reasons.append(f"signals have been missing for {cycle.account.held} periods")
    if doubts := in_words(int(cycle.watch.doubts)):
        reasons.append(f"the loop doubts what it measures: {', '.join(doubts)}")
    most = deployment.region.speed_max_m_per_s
    if most is not None and setpoints.speed_target_m_per_s > most and phase is not Phase.SILENT:
        reasons.append(
            f"the line shall run at {setpoints.speed_target_m_per_s:g} m/s; the configuration was judged up to {most:g}"
        )
    return reasons


def _deploy(cycle: Cycle, deployment: Deployment, now_s: float) -> str:
    if reasons := against(cycle, deployment):
        raise Refused("not deployed", reasons)
    configurations = cycle.configurations
    prepared, configurations.prepared = configurations.prepared, None
    if prepared is not None and prepared[0] is deployment:
        candidate = prepared[1]
    else:
        try:
            candidate = configurations.candidate(deployment)
        except ControllerRefused as refused:
            raise Refused("not deployed", [str(refused)]) from refused
    configurations.take(candidate, deployment, now_s)
    return f"{candidate.config.kind} controller {candidate.hash[:12]} controls the line, on probation"


def _keep(cycle: Cycle, command: Keep) -> str:
    _require_probation(cycle, command.epoch)
    configurations, watch = cycle.configurations, command.watch
    recovery = None
    if watch is not None:
        recovery = _recovery(configurations, watch, configurations.good_if_kept.config, "not kept")
    configurations.keep(watch, recovery)
    good = configurations.good
    under = "" if configurations.running is good else f", with {good.hash[:12]} to go back to"
    return f"epoch {command.epoch} is kept{under}"


def _watch_good(cycle: Cycle, command: WatchGood) -> str:
    configurations = cycle.configurations
    if configurations.probation is not None:
        raise Refused(f"epoch {configurations.epoch} is on probation: it is kept by the newest model, or not")
    good = configurations.good
    configurations.watch_good(
        command.watch, _recovery(configurations, command.watch, good.config, "not watched by another model")
    )
    return f"{configurations.running.hash[:12]} is watched by the model that was accepted last"


def _narrow(cycle: Cycle, command: Narrow) -> str:
    configurations, speed = cycle.configurations, cycle.setpoints.speed_target_m_per_s
    reasons: list[str] = []
    if configurations.probation is not None:
        reasons.append(f"epoch {configurations.epoch} is on probation: keep it or roll it back first")
    if cycle.experiments.run is not None:
        reasons.append("an experiment is under way: wait for its end, or abort it")
    most = command.region.speed_max_m_per_s
    if most is not None and speed > most and cycle.machine.phase is not Phase.SILENT:
        reasons.append(f"the line shall run at {speed:g} m/s; allowed: up to {most:g} m/s, `r2rgate speed {most:g}`")
    if reasons:
        raise Refused("not narrowed", reasons)
    configurations.narrow(command.region)
    return f"{configurations.running.hash[:12]} goes no further than a first configuration"


def _recovery(configurations: Configurations, watch: RecoveryPrediction, fallback: Controller, not_: str) -> Recovery:
    """Prepared ahead, or made now. Raises Refused."""
    prepared, configurations.prepared_watch = configurations.prepared_watch, None
    if prepared is not None and prepared[0] is watch:
        return prepared[1]
    try:
        return configurations.recovery(watch, fallback)
    except ControllerRefused as refused:
        raise Refused(not_, [str(refused)]) from refused


def _require_probation(cycle: Cycle, epoch: int) -> None:
    configurations = cycle.configurations
    if configurations.probation is None or configurations.epoch != epoch:
        now = f"epoch {configurations.epoch} is" if configurations.probation else "nothing is"
        raise Refused(f"epoch {epoch} is not on probation ({now}); {configurations.why}")
