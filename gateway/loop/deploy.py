"""What commands about the configuration do to a cycle: each is done, or refused with every reason."""

from dataclasses import replace

from gateway.core.deployment import Deployment, RecoveryPrediction
from gateway.core.finding import Finding, finding
from gateway.core.messages import (
    AskConfiguration,
    Configuring,
    Confirmed,
    Deploy,
    Keep,
    Narrow,
    Renew,
    Rollback,
    WatchGood,
)
from gateway.core.proof import Proof
from gateway.core.states import Phase
from gateway.loop.configurations import Configuration, Configurations
from gateway.loop.cycle import Cycle
from gateway.loop.kept import Durable
from gateway.loop.refused import Refused
from safety.recoverability import Recovery

Prepared = Configuration | Recovery | None  #: what a command brings along, built and measured ahead

CHANGEABLE = (Phase.SILENT, Phase.READY, Phase.RUNNING, Phase.HOLDING)


NOT_DONE = {Deploy: "not deployed", Keep: "not kept", WatchGood: "not watched by another model"}


def require(cycle: Cycle, command: Deploy | Keep | WatchGood) -> None:
    """Before anything is prepared for it: that it would not be refused anyway. Raises Refused."""
    match command:
        case Deploy():
            if reasons := against(cycle, command.deployment):
                raise Refused(*reasons, title=NOT_DONE[Deploy])
        case Keep():
            _require_probation(cycle, command.epoch)
        case WatchGood():
            _require_nothing_on_probation(cycle.configurations)


def durable_after(
    configurations: Configurations, command: Deploy | Keep | WatchGood, proof: Proof | None = None
) -> Durable:
    """What a loop that starts anew is to run once `command` is done. One on probation leaves only its epoch."""
    match command:
        case Deploy():
            return replace(configurations.durable, epoch=command.deployment.epoch)
        case Keep():
            return configurations.durable_if_kept(command.watch, proof)
        case WatchGood():
            return replace(configurations.durable, watch=command.watch, watch_proof=proof)


def prepare(cycle: Cycle, command: Configuring) -> Prepared:
    """Build and measure what `command` brings along. Takes its time: aside. Raises ControllerRefused."""
    configurations, admission = cycle.configurations, cycle.admission
    match command:
        case Deploy():
            return admission.admit(command.deployment, configurations.good)
        case Keep() if command.watch is not None:
            return admission.recovery(command.watch, configurations.good_if_kept.config, configurations.running.law_s)
        case WatchGood():
            return admission.recovery(command.watch, configurations.good.config, configurations.running.law_s)
        case _:
            return None


def configure(cycle: Cycle, command: Configuring, prepared: Prepared, now_s: float, proof: Proof | None = None) -> str:
    """Do `command` between two periods, with what `prepare` has made of it. Raises Refused.

    `proof`: that the gateway has asked for it; it is kept with the configuration.
    """
    configurations = cycle.configurations
    match command:
        case Deploy() | Keep() | WatchGood():
            require(cycle, command)
            return _change(cycle, command, prepared, now_s, proof)
        case Renew():
            _require_probation(cycle, command.epoch)
            configurations.renew(now_s)
            return f"the lease of epoch {command.epoch} begins anew"
        case Narrow():
            return _narrow(cycle, command)
        case Confirmed():
            if not configurations.confirm(command.configuration):
                raise Refused(finding("not-in-service", configuration=command.configuration[:12]))
            return f"{command.configuration[:12]} is guarded as a first configuration no more"
        case Rollback():
            done = cycle.roll_back(command.reason)
            runs = f"{configurations.good.hash[:12]}, the last known good, runs"
            return f"{runs} again" if done else f"{runs} already"
        case AskConfiguration():
            return "what controls the line"


def _change(
    cycle: Cycle, command: Deploy | Keep | WatchGood, prepared: Prepared, now_s: float, proof: Proof | None
) -> str:
    match command:
        case Deploy():
            assert isinstance(prepared, Configuration)
            watch_proof = None if prepared.watch is None else proof
            proven = replace(prepared, proof=proof, watch_proof=watch_proof)
            return _deploy(cycle, command.deployment, proven, now_s)
        case Keep():
            return _keep(cycle.configurations, command, _recovery(prepared), proof)
        case WatchGood():
            return _watch_good(cycle.configurations, command.watch, _recovery(prepared), proof)


def against(cycle: Cycle, deployment: Deployment) -> list[Finding]:
    """What speaks against a swap now, but for the configuration itself."""
    configurations, setpoints, phase = cycle.configurations, cycle.setpoints, cycle.machine.phase
    reasons = _not_on_probation(configurations)
    if deployment.epoch != configurations.epoch + 1:
        reasons.append(finding("epoch-not-next", epoch=deployment.epoch, next=configurations.epoch + 1))
    if phase not in CHANGEABLE:
        reasons.append(finding("no-change-now", phase=phase.name.lower()))
    if cycle.experiments.run is not None:
        reasons.append(finding("experiment-under-way"))
    elif phase in (Phase.RUNNING, Phase.HOLDING) and not setpoints.stands(phase is Phase.HOLDING):
        reasons.append(finding("setpoints-move"))
    if cycle.account.held:
        reasons.append(finding("signals-held", periods=cycle.account.held))
    return reasons + cycle.watch.doubted() + _too_fast(cycle, deployment.region.speed_max_m_per_s)


def _not_on_probation(configurations: Configurations) -> list[Finding]:
    return [] if configurations.probation is None else [finding("on-probation", epoch=configurations.epoch)]


def _too_fast(cycle: Cycle, most_m_per_s: float | None) -> list[Finding]:
    """The line is to run faster than the region would let it."""
    speed = cycle.setpoints.speed_target_m_per_s
    if most_m_per_s is None or speed <= most_m_per_s or cycle.machine.phase is Phase.SILENT:
        return []
    return [finding("line-too-fast", speed_m_per_s=speed, allowed_m_per_s=most_m_per_s)]


def _deploy(cycle: Cycle, deployment: Deployment, candidate: Configuration, now_s: float) -> str:
    _require_still(candidate.recovery, cycle.configurations.good, NOT_DONE[Deploy])
    cycle.deploy(candidate, deployment, now_s)
    return f"{candidate.config.kind} controller {candidate.hash[:12]} controls the line, on probation"


def _keep(configurations: Configurations, command: Keep, recovery: Recovery | None, proof: Proof | None) -> str:
    _require_still(recovery, configurations.good_if_kept, NOT_DONE[Keep])
    configurations.keep(command.watch, recovery, proof)
    good = configurations.good
    under = "" if configurations.running is good else f", with {good.hash[:12]} to go back to"
    return f"epoch {command.epoch} is kept{under}"


def _watch_good(
    configurations: Configurations, watch: RecoveryPrediction, recovery: Recovery | None, proof: Proof | None
) -> str:
    assert recovery is not None
    _require_still(recovery, configurations.good, NOT_DONE[WatchGood])
    configurations.watch_good(watch, recovery, proof)
    return f"{configurations.running.hash[:12]} is watched by the model that was accepted last"


def _narrow(cycle: Cycle, command: Narrow) -> str:
    configurations = cycle.configurations
    if reasons := _against_narrowing(cycle, command):
        raise Refused(*reasons, title="not narrowed")
    if command.confine:
        cycle.experiments.end("no record explains what controls the line")
    configurations.narrow(command.region)  # the set-point of the speed goes down with it
    return f"{configurations.running.hash[:12]} goes no further than a first configuration"


def _against_narrowing(cycle: Cycle, command: Narrow) -> list[Finding]:
    reasons = _not_on_probation(cycle.configurations)
    if command.confine:
        return reasons
    if cycle.experiments.run is not None:
        reasons.append(finding("experiment-under-way"))
    return reasons + _too_fast(cycle, command.region.speed_max_m_per_s)


def _recovery(prepared: Prepared) -> Recovery | None:
    return prepared if isinstance(prepared, Recovery) else None


def _require_still(recovery: Recovery | None, good: Configuration, refused: str) -> None:
    """What was prepared aside is for what the line goes back to now, too."""
    if recovery is not None and recovery.fallback != good.hash:
        raise Refused(finding("fallback-changed"), title=refused)


def _require_nothing_on_probation(configurations: Configurations) -> None:
    """For what belongs to the last known good one. Raises Refused."""
    if reasons := _not_on_probation(configurations):
        raise Refused(*reasons)


def _require_probation(cycle: Cycle, epoch: int) -> None:
    configurations = cycle.configurations
    if configurations.probation is None or configurations.epoch != epoch:
        raise Refused(finding("not-on-probation", epoch=epoch, at=configurations.epoch, because=configurations.why))
