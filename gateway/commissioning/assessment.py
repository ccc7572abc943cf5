"""Before any design: how fast the line is, how its spans hang together, and whether a linear model is enough."""

import numpy as np

from gateway.control.design import DesignRefused, DesignTask, design_lqi, design_scheduled, gains_change
from gateway.control.design.task import linear
from gateway.core.line import Line, NonNegative, Strict
from gateway.core.web_model import equilibrium_torque, reference_speeds

STRAIN = 0.1  #: beyond it the products T v of the web equation are no small correction
GAINS_MOVE = 0.2  #: beyond it one set of gains for all speeds is a compromise
COUPLED = 0.3  #: of a torque's effect on its own span: beyond it loops that are tuned one by one fight each other


class Assessment(Strict):
    """Figures of the nominal model at the design point, and what follows for the choice of a controller."""

    fastest_s: NonNegative  #: time constant of the fastest mode
    slowest_s: NonNegative  #: of the slowest; 1e9 stands for a web at rest, which does not forget by itself
    dead_time_s: NonNegative  #: from a sample to the middle of the time for which its torque acts
    coupling: NonNegative  #: what a torque does to a neighbouring span's tension, of what it does to its own
    strain: NonNegative  #: greatest permitted tension over E A: the relative size of the nonlinear terms
    gains_move: NonNegative | None  #: change of an LQI's gains over the line's speeds, relative; None: there is none
    torque_use: NonNegative  #: of the limit, needed to hold the first recipe at the greatest speed
    linearised: bool
    schedule: bool
    sentences: list[str]


def assess(line: Line, task: DesignTask) -> Assessment:
    """The assessment of a line with its design task."""
    A, _ = linear(task)
    rates = -np.linalg.eigvals(A).real
    fastest_s = 1.0 / float(rates.max())
    slowest_s = 1.0 / max(float(rates.min()), 1e-9)
    dead_time_s = task.latency_s + 0.5 * task.period_s
    coupling = _coupling(task, 0.5 / dead_time_s)
    strain = line.limits.tension_max_n / task.model.stiffness_n
    gains_move = _gains_move(task, line.limits.speed_max_m_per_s)
    speeds = reference_speeds(task.model, task.tension_n, line.limits.speed_max_m_per_s)
    torque_use = float(np.abs(equilibrium_torque(task.model, task.tension_n, speeds)).max()) / line.limits.torque_nm
    schedule = (gains_move or 0.0) > GAINS_MOVE
    found = Assessment(
        fastest_s=fastest_s, slowest_s=slowest_s, dead_time_s=dead_time_s, coupling=coupling, strain=strain,
        gains_move=gains_move, torque_use=torque_use, linearised=strain <= STRAIN, schedule=schedule,
        sentences=[],
    )  # fmt: skip
    return found.model_copy(update={"sentences": _sentences(found, line.limits.speed_max_m_per_s)})


def _sentences(found: Assessment, speed_m_per_s: float) -> list[str]:
    short = found.dead_time_s < 0.5 * found.fastest_s
    pace = "short beside them" if short else "as long as the fastest of them: it sets the pace"
    together = "the spans must be controlled together" if found.coupling > COUPLED else "single spans hardly meet"
    linearised = "designs take the model linearised at the operating point, simulation and feed-forward the full one"
    rough = "a linear design is a rough guide here, and what simulation of the full model says is what counts"
    follow = "gains should follow the speed (--schedule)" if found.schedule else "one set of gains serves all speeds"
    meet = ": large steps meet it, and MPC alone knows of it beforehand" if found.torque_use > 0.5 else ""
    said = [
        f"The line's own modes take from {found.fastest_s:.3g} to {found.slowest_s:.3g} s; the dead time of "
        f"{1e3 * found.dead_time_s:.3g} ms is {pace}."
    ]
    if found.coupling:
        said.append(
            f"Within the bandwidth in reach a torque that moves its own span by 1 N moves another by "
            f"{found.coupling:.2f} N: {together}."
        )
    said.append(
        f"Tension reaches {100.0 * found.strain:.2g} % of E A, which is the size of the nonlinear terms: "
        f"{linearised if found.linearised else rough}."
    )
    if found.gains_move is not None:
        said.append(
            f"Up to {speed_m_per_s:g} m/s the gains of an LQI change by {100.0 * found.gains_move:.2g} %: {follow}."
        )
    said.append(
        f"Holding the first recipe at {speed_m_per_s:g} m/s takes {100.0 * found.torque_use:.0f} % of the torque limit"
        f"{meet}."
    )
    return said


def _coupling(task: DesignTask, rad_per_s: float) -> float:
    """max |G_ji| / |G_ii|, j != i, from torques to tensions at a frequency, without draw spans."""
    A, B = linear(task)
    spans = task.tension_spans
    if len(spans) < 2:
        return 0.0
    gain = np.abs(np.linalg.solve(1j * rad_per_s * np.eye(len(A)) - A, B)[np.ix_(spans, spans)])
    own = gain.diagonal()
    return float(((gain - np.diag(own)) / own).max())


def _gains_move(task: DesignTask, fastest_m_per_s: float) -> float | None:
    """By how much the gains of an LQI change from a tenth of the greatest speed to all of it, relative."""
    try:
        return max(gains_change(design_scheduled(task, design_lqi, [0.1 * fastest_m_per_s, fastest_m_per_s])).values())
    except DesignRefused:  # of another law than is asked for, perhaps: its own design will tell
        return None
