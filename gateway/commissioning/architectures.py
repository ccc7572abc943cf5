"""The controller architectures of phase 1, each with the few numbers that tune it: the paper's phi, seen from above.

A knob acts on a whole family of gains through the design; gains follow from it and from the model. Knobs are positive
and are turned by factors.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

from gateway.control.design import (
    DesignRefused,
    DesignTask,
    design_lqg,
    design_lqi,
    design_lqr,
    design_mpc,
    design_pid,
    design_scheduled,
    lqg_weights,
    lqi_weights,
    lqr_weights,
    mpc_weights,
)  # fmt: skip
from gateway.control.design.pid import SPEED_SHARE, TENSION_SHARE
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.controller_schedule import LinearConfig
from gateway.core.nearest import nearest

Values = Mapping[str, float]


@dataclass(frozen=True)
class Knob:
    name: str
    unit: str
    least: float
    most: float
    more: str  #: what a greater value does
    less: str  #: what a smaller one does


@dataclass(frozen=True)
class Architecture:
    name: str
    title: str
    knobs: tuple[Knob, ...]
    begin: Callable[[DesignTask], Values]  #: the values of a design that is given none
    make: Callable[[DesignTask, Values], LinearConfig | MpcConfig]

    def first(self, task: DesignTask) -> dict[str, float]:
        """Where to begin."""
        begin = self.begin(task)
        return {knob.name: min(max(begin[knob.name], knob.least), knob.most) for knob in self.knobs}

    def design(self, task: DesignTask, values: Values, speeds_m_per_s: Sequence[float] = ()) -> Controller:
        """The configuration at `values`; with speeds, one whose gains follow them.

        Raises DesignRefused, also for values that are none of its knobs', and for a schedule of MPC.
        """
        if wrong := self.wrong(values):
            raise DesignRefused("; ".join(wrong))
        if speeds_m_per_s:
            return design_scheduled(task, lambda at_speed: self.make(at_speed, values), list(speeds_m_per_s))
        return self.make(task, values)

    def wrong(self, values: Values) -> list[str]:
        """What is wrong with `values`: unknown or missing knobs, numbers outside their range."""
        knobs = {knob.name: knob for knob in self.knobs}
        found = [
            f"{name}: {self.name} has no such knob; allowed: {', '.join(knobs)}; nearest: {nearest(name, list(knobs))}"
            for name in values
            if name not in knobs
        ]
        found += [f"{name} is missing" for name in knobs if name not in values]
        for name, value in values.items():
            knob = knobs.get(name)
            if knob and not knob.least <= value <= knob.most:
                found.append(f"{name} is {value:g} {knob.unit}; allowed: {knob.least:g} to {knob.most:g}")
        return found


TORQUE_WEIGHT = Knob(
    "torque_per_nm2", "N2/Nm2", 1e-5, 100.0, "calmer torque, slower loop", "faster loop, busier torque"
)
DISTURBANCE = Knob(
    "disturbance_nm_per_sqrt_s", "Nm/s^0.5", 0.01, 100.0, "faster on disturbances", "less moved by noise"
)
PID = Architecture(
    "pid",
    "PID: a speed loop per roller, tension trim on the draw",
    (
        Knob("speed_share", "", 0.02, 1.5, "faster speed loops", "calmer speed loops"),
        Knob("tension_share", "", 0.01, 1.0, "faster tension trim", "calmer tension trim"),
    ),
    lambda task: {"speed_share": SPEED_SHARE, "tension_share": TENSION_SHARE},
    lambda task, values: design_pid(task, values["speed_share"], values["tension_share"]),
)
LQR = Architecture(
    "lqr",
    "LQR: state feedback, no integral action",
    (TORQUE_WEIGHT,),
    lambda task: asdict(lqr_weights(task)),
    lambda task, values: design_lqr(task, replace(lqr_weights(task), **values)),
)
LQI = Architecture(
    "lqi",
    "LQI: state feedback with integral action",
    (
        TORQUE_WEIGHT,
        Knob("integral_per_n2s2", "1/s2", 1.0, 1e6, "offsets vanish faster", "less push from the integrals"),
        Knob("antiwindup", "", 0.01, 1.0, "integrals let go sooner at a limit", "integrals hold on longer"),
    ),
    lambda task: asdict(lqi_weights(task)),
    lambda task, values: design_lqi(task, replace(lqi_weights(task), **values)),
)
LQG = Architecture(
    "lqg",
    "LQG: state feedback on a Kalman observer of torque disturbances",
    (TORQUE_WEIGHT, DISTURBANCE),
    lambda task: asdict(lqg_weights(task)),
    lambda task, values: design_lqg(task, replace(lqg_weights(task), **values)),
)
MPC = Architecture(
    "mpc",
    "MPC: constraints over a horizon, on the same observer",
    (TORQUE_WEIGHT, DISTURBANCE),
    lambda task: asdict(mpc_weights(task)),
    lambda task, values: design_mpc(task, replace(mpc_weights(task), **values)),
)
ARCHITECTURES = {one.name: one for one in (PID, LQR, LQI, LQG, MPC)}
