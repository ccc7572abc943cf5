"""The linear laws inside model predictive control: what it is where no limit is reached, and what it falls back on."""

from gateway.control.mpc_problem import MpcProblem
from gateway.core.controller_laws import LqgConfig, Matrix, MpcConfig


def unconstrained(config: MpcConfig) -> LqgConfig:
    """The law on the same observer where no limit is reached: the first torque of the programme without its rows.

    In rollouts the loop's own limits stay, but it does not see them coming.
    """
    gain = MpcProblem(config).gain()
    return _on_its_observer(config, gain[:, : 2 * config.n].tolist(), gain[:, 2 * config.n :].tolist())


def fallback(config: MpcConfig) -> LqgConfig:
    """The more cautious law that answers where no solution comes in time."""
    return _on_its_observer(config, config.fallback_state, config.fallback_input)


def _on_its_observer(config: MpcConfig, gain_state: Matrix, gain_input: Matrix) -> LqgConfig:
    return LqgConfig(
        period_s=config.period_s, latency_s=config.latency_s, draw_spans=config.draw_spans,
        feedforward=config.feedforward, predictor=config.predictor, gain_state=gain_state, gain_input=gain_input,
    )  # fmt: skip
