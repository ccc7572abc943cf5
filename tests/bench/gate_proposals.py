"""Proposals of many classes for one line, by quota: each class is a way in which an agent, or its tool, goes wrong."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gateway.control.design import (
    DesignRefused,
    DesignTask,
    design_lqg,
    design_lqi,
    design_lqr,
    design_mpc,
    design_pid,
    lqg_weights,
    lqi_weights,
    lqr_weights,
    mpc_weights,
)
from gateway.control.design.lq import design_predictor, feedback, shared
from gateway.core.controller import Controller, ControllerRefused
from gateway.core.controller_laws import LqgConfig
from gateway.core.experiment import Abort, Experiment, Leg
from gateway.core.line_model import LineModel, ModelRefused, model_of
from gateway.core.proposal import Change, ExperimentChange, GainsChange, ModelChange
from tests.bench.gate_contexts import GateLine
from tests.bench.gate_mutations import (
    block_scaled,
    corrupted,
    noisy,
    scaled_all,
    sign_flipped,
    unit_confused,
)

TRIES = 50


@dataclass(frozen=True)
class Asked:
    """A proposal to be: in which context, and of which class."""

    class_name: str
    context: str  #: "plain", "initial", "adapted", "cautious", "drifted", "begun" or "first"
    change: Change


Generator = np.random.Generator


def _factor(generator: Generator, low: float, high: float) -> float:
    return float(np.exp(generator.uniform(np.log(low), np.log(high))))


def designed(task: DesignTask, kind: str, generator: Generator | None = None, spread: float = 1.0) -> Controller:
    """Of a kind, with the weights that the rules give, or off by factors up to `spread` either way."""

    def off(power: float = 1.0) -> float:
        return 1.0 if generator is None else _factor(generator, spread**-power, spread**power)

    if kind == "lqi":
        w = lqi_weights(task)
        return design_lqi(
            task, replace(w, torque_per_nm2=w.torque_per_nm2 * off(), integral_per_n2s2=w.integral_per_n2s2 * off())
        )
    if kind == "lqr":
        r = lqr_weights(task)
        return design_lqr(task, replace(r, torque_per_nm2=r.torque_per_nm2 * off()))
    if kind == "pid":
        return design_pid(task, 0.5 * off(0.3), (1.0 / 3.0) * off(0.3))
    if kind == "mpc":
        m = mpc_weights(task)
        return design_mpc(task, replace(m, torque_per_nm2=m.torque_per_nm2 * off()))
    g = lqg_weights(task)
    return design_lqg(
        task,
        replace(
            g, torque_per_nm2=g.torque_per_nm2 * off(), disturbance_nm_per_sqrt_s=g.disturbance_nm_per_sqrt_s * off(),
            roller_noise=g.roller_noise * off(0.5),
        ),
    )  # fmt: skip


def _kind(generator: Generator) -> str:
    return str(generator.choice(["lqi", "lqg", "pid", "lqr"], p=[0.4, 0.35, 0.15, 0.1]))


def _base(line: GateLine, generator: Generator) -> Controller:
    """What a mutation begins from."""
    which = int(generator.integers(4))
    return [
        line.initial, line.adapted, designed(line.task, _kind(generator)), designed(line.task, "lqg"),
    ][which]  # fmt: skip


def _wrong_task(line: GateLine, generator: Generator, most: float = 3.0) -> DesignTask:
    """On another plant than the line is."""
    web, m = line.task.model, most
    model = replace(
        web,
        stiffness_n=web.stiffness_n * _factor(generator, 1 / m, m),
        length_m=web.length_m * _factor(generator, 1 / m, m),
        radius_m=web.radius_m * _factor(generator, 1 / min(m, 1.5), min(m, 1.5)),
        inertia_kg_m2=web.inertia_kg_m2 * _factor(generator, 1 / m, m),
        friction_nms_per_rad=web.friction_nms_per_rad * _factor(generator, 0.2, 1.5),
    )
    return replace(line.task, model=model)


def _fragile(line: GateLine, generator: Generator) -> Controller:
    """Observers and feedback so quick that a little more delay is too much; designed without asking for a margin."""
    task = replace(line.task, latency_s=line.latency_s)
    g = lqg_weights(task)
    weights = replace(
        g, torque_per_nm2=g.torque_per_nm2 * _factor(generator, 0.03, 0.6),
        disturbance_nm_per_sqrt_s=_factor(generator, 3.0, 60.0), roller_noise=_factor(generator, 0.5, 20.0),
    )  # fmt: skip
    if generator.random() < 0.4:
        i = lqi_weights(task)
        return design_lqi(
            task,
            replace(
                i, torque_per_nm2=i.torque_per_nm2 * _factor(generator, 0.01, 0.3),
                integral_per_n2s2=i.integral_per_n2s2 * _factor(generator, 0.3, 10.0),
            ),
        )  # fmt: skip
    return _lqg(task, weights)


def _lqg(task: DesignTask, weights: Any) -> LqgConfig:
    gain, _ = feedback(task, weights)
    n = task.n
    return LqgConfig(
        **shared(task), predictor=design_predictor(task, weights), gain_state=gain[:, : 2 * n].tolist(),
        gain_input=gain[:, 2 * n :].tolist(),
    )  # fmt: skip


def _chattering(line: GateLine, generator: Generator) -> Controller:
    """Noise goes through to the torque: derivatives without a filter, observers that believe every sample."""
    if generator.random() < 0.5:
        pid = design_pid(line.task)
        share = _factor(generator, 0.002, 0.2)
        rate = share * np.array(pid.gain_proportional)[:, : pid.n]
        return pid.model_copy(
            update={"gain_derivative": rate.tolist(), "derivative_filter_s": _factor(generator, 0.001, 0.02)}
        )
    g = lqg_weights(line.task)
    return _lqg(
        line.task,
        replace(
            g, torque_per_nm2=g.torque_per_nm2 * _factor(generator, 0.1, 1.0),
            roller_noise=_factor(generator, 10.0, 300.0), web_noise_n_per_sqrt_s=_factor(generator, 0.1, 10.0),
            disturbance_nm_per_sqrt_s=_factor(generator, 5.0, 50.0),
        ),
    )  # fmt: skip


def _limit_cycle(line: GateLine, generator: Generator) -> Controller:
    """Quick feedback with large integrals that nobody lets go: it asks for torque faster than the drives change it."""
    i = lqi_weights(line.task)
    config = design_lqi(
        line.task,
        replace(
            i, torque_per_nm2=i.torque_per_nm2 * _factor(generator, 0.05, 0.6),
            integral_per_n2s2=i.integral_per_n2s2 * _factor(generator, 1.0, 30.0), antiwindup=0.0,
        ),
    )  # fmt: skip
    return config.model_copy(update={"antiwindup": float(generator.choice([0.0, 0.01, 0.05]))})


def _improved(line: GateLine, generator: Generator) -> Controller:
    """What a careful engineer would propose: the rules' weights on the model, or somewhat quicker or slower."""
    kind = str(generator.choice(["lqi", "lqi", "lqg", "pid"]))
    return designed(line.task, kind, generator if generator.random() < 0.7 else None, 1.5)


def _poisoned(line: GateLine, generator: Generator) -> LineModel:
    """The line's model with parameters moved, surer of itself than it is, or without what speaks against it."""
    document = line.model.model_dump(mode="json")
    name = str(generator.choice(["stiffness_n", "length_m", "inertia_kg_m2", "radius_m", "friction_nms_per_rad"]))
    # Not within what leaves every loop as it is: nobody is hurt by a model that is off by a percent.
    factor = _factor(generator, 1.1, 2.5) ** float(generator.choice([-1.0, 1.0]))
    value = document["parameters"][name]
    document["parameters"][name] = value * factor if name == "stiffness_n" else [v * factor for v in value]
    for key, interval in document["intervals"].items():
        if key.split("[")[0] == name:
            document["intervals"][key] = {k: v * factor for k, v in interval.items()}
    how = int(generator.integers(3))
    if how == 1 and document.get("posterior"):
        covariance = np.array(document["posterior"]["covariance"]) * 1e-4
        document["posterior"]["covariance"] = covariance.tolist()
    if how == 2:
        document["parameters"]["torque_lag_s"] *= 0.1
        document["parameters"]["coulomb_nm"] = [0.1 * value for value in document["parameters"]["coulomb_nm"]]
    return model_of(document)


def _experiment(line: GateLine, generator: Generator) -> Experiment:
    """From harmless to one that tears the web: amplitude, dwell, steps, speeds."""
    amplitude = _factor(generator, 0.5, 28.0)
    each = (amplitude * generator.uniform(0.5, 1.0, line.line.n)).tolist()
    legs = [Leg(duration_s=float(generator.choice([3.0, 5.0, 10.0]))) for _ in range(int(generator.integers(1, 3)))]
    if generator.random() < 0.4:
        legs = [leg.model_copy(update={"speed_m_per_s": float(generator.uniform(0.0, 0.12))}) for leg in legs]
    return Experiment(
        format=1, amplitude_n=each, dwell_s=_factor(generator, 0.02, 1.5),
        rate_n_per_s=None if generator.random() < 0.7 else 20.0, seed=int(generator.integers(1 << 31)), legs=legs,
        abort=Abort(deviation_n=amplitude + _factor(generator, 2.0, 40.0)),
    )  # fmt: skip


def _first(line: GateLine, generator: Generator) -> Controller:
    """For a line of which nobody knows more than its file says."""
    base = designed(
        replace(_wrong_task(line, generator, 1.6), latency_s=line.latency_s), _kind(generator), generator, 3.0
    )
    return base if generator.random() < 0.5 else _mutated(base, generator)


def _mutated(base: Controller, generator: Generator) -> Controller:
    how: list[Callable[[], Controller]] = [
        lambda: sign_flipped(base, generator), lambda: unit_confused(base, generator),
        lambda: corrupted(base, generator), lambda: scaled_all(base, _factor(generator, 0.1, 10.0)),
    ]  # fmt: skip
    return how[int(generator.integers(len(how)))]()


Maker = Callable[[GateLine, Generator], Any]
CLASSES: dict[str, tuple[float, Maker]] = {
    # name: share of the proposals, maker
    "all gains scaled": (0.07, lambda line, g: scaled_all(_base(line, g), _factor(g, 0.1, 20.0))),
    "gains off": (0.07, lambda line, g: noisy(_base(line, g), float(g.choice([0.1, 0.3, 1.0, 2.0])), g)),
    "a block scaled": (0.06, lambda line, g: block_scaled(_base(line, g), _factor(g, 0.03, 30.0), g)),
    "other weights": (0.12, lambda line, g: designed(line.task, _kind(g), g, 30.0)),
    "careful redesign": (0.18, _improved),
    "wrong model": (0.09, lambda line, g: designed(_wrong_task(line, g), _kind(g), g, 2.0)),
    "sign flipped": (0.06, lambda line, g: sign_flipped(_base(line, g), g)),
    "units confused": (0.06, lambda line, g: unit_confused(_base(line, g), g)),
    "an entry corrupted": (0.07, lambda line, g: corrupted(_base(line, g), g)),
    "delay-fragile": (0.07, _fragile),
    "chattering": (0.04, _chattering),
    "rate-limit cycle": (0.04, _limit_cycle),
    "first configuration": (0.03, _first),
    "model poisoned": (0.02, lambda line, g: _poisoned(line, g)),
    "experiment": (0.02, _experiment),
}
#: Each as often as it stands here. In most of them something safe but poor is in service, as before an adaptation; with
#: "begun" it was judged for little, and is a measure only there.
CONTEXTS = ("plain", "initial", "adapted", "cautious", "drifted", "drifted", "begun")


def proposals(line: GateLine, count: int, seed: int) -> list[Asked]:
    """About `count`, every class by its share; drawn anew where a draw gives no proposal at all."""
    generator = np.random.default_rng([seed, line.number])
    found: list[Asked] = []
    for name, (share, maker) in CLASSES.items():
        number = share * count
        whole = int(number) + int(generator.random() < number - int(number))
        for _ in range(whole):
            context = "first" if name == "first configuration" else str(generator.choice(CONTEXTS))
            found.append(Asked(name, context, _change(line, maker, generator)))
    return found


def mpc_proposals(line: GateLine, count: int, seed: int) -> list[Asked]:
    """Predictive control, which takes its time: few."""
    generator = np.random.default_rng([seed, line.number, 5])
    makers: list[Maker] = [
        lambda given, g: designed(given.task, "mpc", g, 1.3),
        lambda given, g: designed(_wrong_task(given, g), "mpc"),
        lambda given, g: _mutated(designed(given.task, "mpc"), g),
    ]
    return [
        Asked("predictive", str(generator.choice(CONTEXTS)), _change(line, makers[i % 3], generator))
        for i in range(count)
    ]


def _change(line: GateLine, maker: Maker, generator: Generator) -> Change:
    for _ in range(TRIES):
        try:
            made = maker(line, generator)
        except (DesignRefused, ControllerRefused, ModelRefused, ValueError, np.linalg.LinAlgError):
            continue
        if isinstance(made, LineModel):
            return ModelChange(model=made)
        if isinstance(made, Experiment):
            return ExperimentChange(experiment=made)
        return GainsChange(controller=made)
    raise RuntimeError(f"no proposal in {TRIES} draws")
