"""theta: everything that is believed of a line's physics; what the paper leaves out stands beside its two equations."""

from dataclasses import dataclass, field
from math import sqrt

import numpy as np

from gateway.core.line import Line
from gateway.core.line_scales import line_scales
from gateway.core.signals import FloatArray
from gateway.core.web_model import WebModel, nominal_model

CELL_NOISE = 10.0  #: of load cells (1 sigma): one part in so many of what is a small tension
ENCODER_NOISE = 12.0, 100.0  #: of encoders (1 sigma): one part in so many, twice, of the greatest speed
NOISE_SHARE = 0.2  #: of what torque may change by in a period: what encoders' noise may make of it (1 sigma)
#: What shakes a roller (1 sigma) in the time in which the line answers, in units of an encoder's noise.
SHAKEN = 16.0 * sqrt(0.6)


@dataclass(frozen=True)
class Noise:
    """What moves the line and its measurements at random, as far as it is known. Defaults: a line of 60 N, 0.12 m/s."""

    tension_n: float = 0.1  #: standard deviation of a sample
    speed_m_per_s: float = 1e-4
    acceleration_m_per_s1_5: float = 1.6e-3  #: intensity of the white noise on roller accelerations


def expected_noise(line: Line) -> Noise:
    """What is expected of a line of this size before a model says more."""
    scales, (parts, hundred) = line_scales(line), ENCODER_NOISE
    speed_m_per_s = line.limits.speed_max_m_per_s / parts / hundred
    shaken = speed_m_per_s * (SHAKEN / sqrt(scales.response_s))
    return Noise(scales.tension_n / CELL_NOISE, speed_m_per_s, shaken)


@dataclass(frozen=True)
class Theta:
    """A torque sent with the sample at t moves the roller from t + latency on, behind a lag of the first order:

        torque_lag dm_i/dt = u_i(t - latency) - m_i
        dv_i/dt = R_i^2/J_i (T_{i+1} - T_i) - f_i/J_i v_i + R_i/J_i (m_i - c_i sign(v_i))

    and the tensions follow as in `web_model`. c is the Coulomb friction of the bearings. The radius under the web is
    R_i (1 + e_i cos(angle_i + phase_i)), v_i the surface speed that a round roller would have; the phases are nobody's
    belief, but what the data at hand show.
    """

    web: WebModel
    coulomb_nm: FloatArray  #: (n,), 0 and above
    torque_lag_s: float  #: 0: none
    latency_s: float  #: from a sample to the torque that it causes
    #: e (n,), amplitude over radius; nothing given: none
    eccentricity: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if not self.eccentricity.size:
            object.__setattr__(self, "eccentricity", np.zeros(self.n))

    @property
    def n(self) -> int:
        return self.web.n


def nominal_theta(line: Line) -> Theta:
    """The line's file, which knows of no Coulomb friction and no lag."""
    web = nominal_model(line)
    return Theta(web, 0.0 * web.radius_m, 0.0, line.control.latency_s)
