"""What commands about the configuration do to a cycle: each is done, or refused with every reason."""

from dataclasses import replace

from gateway.core.deployment import Deployment, RecoveryPrediction
from gateway.core.doubts import in_words
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
                raise Refused(NOT_DONE[Deploy], reasons)
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
                raise Refused(f"{command.configuration[:12]} does not control the line: nothing is confirmed")
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
        raise Refused("not narrowed", reasons)
    if command.confine:
        cycle.experiments.end("no record explains what controls the line")
    configurations.narrow(command.region)  # the set-point of the speed goes down with it
    return f"{configurations.running.hash[:12]} goes no further than a first configuration"


def _against_narrowing(cycle: Cycle, command: Narrow) -> list[str]:
    configurations, speed = cycle.configurations, cycle.setpoints.speed_target_m_per_s
    reasons: list[str] = []
    if configurations.probation is not None:
        reasons.append(f"epoch {configurations.epoch} is on probation: keep it or roll it back first")
    if command.confine:
        return reasons
    if cycle.experiments.run is not None:
        reasons.append("an experiment is under way: wait for its end, or abort it")
    most = command.region.speed_max_m_per_s
    if most is not None and speed > most and cycle.machine.phase is not Phase.SILENT:
        reasons.append(f"the line shall run at {speed:g} m/s; allowed: up to {most:g} m/s, `r2rgate speed {most:g}`")
    return reasons


def _recovery(prepared: Prepared) -> Recovery | None:
    return prepared if isinstance(prepared, Recovery) else None


def _require_still(recovery: Recovery | None, good: Configuration, refused: str) -> None:
    """What was prepared aside is for what the line goes back to now, too."""
    if recovery is not None and recovery.fallback != good.hash:
        raise Refused(refused, ["what the line would go back to has changed meanwhile"])


def _require_nothing_on_probation(configurations: Configurations) -> None:
    """For what belongs to the last known good one. Raises Refused."""
    if configurations.probation is not None:
        raise Refused(f"epoch {configurations.epoch} is on probation: it is kept by the newest model, or not")


def _require_probation(cycle: Cycle, epoch: int) -> None:
    configurations = cycle.configurations
    if configurations.probation is None or configurations.epoch != epoch:
        now = f"epoch {configurations.epoch} is" if configurations.probation else "nothing is"
        raise Refused(f"epoch {epoch} is not on probation ({now}); {configurations.why}")
