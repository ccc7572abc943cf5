"""The recovery prediction that goes with a verdict, from the accepted model. Not for the loop: it needs scipy."""

import numpy as np

from gateway.control.design.sampling import with_dead_time
from gateway.control.design.task import feedforward_of
from gateway.core.controller import Controller, config_hash
from gateway.core.deployment import RecoveryNode, RecoveryPrediction
from gateway.core.line import Line
from gateway.core.line_scales import line_scales
from gateway.core.signals import FloatArray
from gateway.core.theta import Theta
from gateway.core.web_model import linearise, reference_speeds

#: In small tensions. Where that is 1 N, 2 let 11 of 272 unsafe configurations out under stress effects, 4 one, 6 none.
MARGIN = 6.0
SIGNIFICANT = 1e-9  #: of the greatest entry: smaller ones are 0


def recovery_prediction(
    theta: Theta,
    fallback: Controller,
    line: Line,
    speeds_m_per_s: list[float],
    horizon_s: float | None = None,
    margin_n: float | None = None,
) -> RecoveryPrediction:
    """What the loop needs to see whether `fallback` would still recover the line, of which `theta` is believed.

    One node per speed (ascending), at the first recipe's tensions. The lag of the drives counts as dead time. Where no
    horizon and margin are given, they are as the line is large.
    """
    scales = line_scales(line)
    period_s, model = line.control.period_s, theta.web
    tension_n = np.array(line.recipes[0].tension_n)
    nodes: list[RecoveryNode] = []
    for speed in speeds_m_per_s:
        A, B = linearise(model, tension_n, reference_speeds(model, tension_n, speed), speed)
        plant = with_dead_time(A, B, period_s, theta.latency_s + theta.torque_lag_s)
        nodes.append(
            RecoveryNode(
                speed_m_per_s=speed,
                transition=_rounded(plant.transition),
                inputs=[_rounded(matrix) for matrix in plant.inputs],
            )
        )
    return RecoveryPrediction(
        fallback=config_hash(fallback),
        period_s=period_s,
        horizon_s=scales.response_s if horizon_s is None else horizon_s,
        margin_n=MARGIN * scales.tension_n if margin_n is None else margin_n,
        model=feedforward_of(model),
        coulomb_nm=theta.coulomb_nm.tolist(),
        nodes=nodes,
    )


def _rounded(matrix: FloatArray) -> list[list[float]]:
    """Without what is smaller than any use of it: on a long line most entries are, and a message is short."""
    found: list[list[float]] = np.where(np.abs(matrix) < SIGNIFICANT * np.abs(matrix).max(), 0.0, matrix).tolist()
    return found
