"""A linear law whose matrices follow the line's speed: nodes of a schedule, frozen."""

from itertools import pairwise
from math import isfinite
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, BeforeValidator, Field, model_validator

from gateway.core.controller_laws import Law, LqgConfig, LqiConfig, LqrConfig, PidConfig, Vector
from gateway.core.signals import FloatArray

LinearConfig = PidConfig | LqrConfig | LqiConfig | LqgConfig
KINDS = ("pid", "lqr", "lqi", "lqg")
SHARED = frozenset(Law.model_fields)  #: what every node has alike


_UNSCHEDULED = {
    "mpc": "its programme and the plan in its state belong to one model",
    "scheduled": "a schedule of schedules has no speed of its own",
}


def _linear_only(given: Any) -> Any:
    """Before the union reads a law: it would say which names it knows, not why the others are none of them."""
    law: Any = given
    kind = law.get("kind") if isinstance(given, dict) else getattr(law, "kind", None)
    if reason := _UNSCHEDULED.get(str(kind)):
        raise ValueError(f"a law of kind {kind}: {reason}; allowed: {', '.join(KINDS)}")
    return law


Node = Annotated[LinearConfig, Field(discriminator="kind")]


class ScheduledConfig(Law):
    """Laws of one linear kind, each for one speed of the unwinder; between two nodes their matrices go linearly.

    Below the first node the first law holds, above the last the last.
    """

    kind: Literal["scheduled"] = "scheduled"
    speed_m_per_s: Vector  #: of the unwinder at each node, ascending
    laws: list[Annotated[Node, BeforeValidator(_linear_only)]]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if wrong := wrong_speeds(self.speed_m_per_s):
            raise ValueError(wrong)
        if len(self.laws) != len(self.speed_m_per_s):
            raise ValueError(f"{len(self.laws)} laws for {len(self.speed_m_per_s)} speeds: each speed has one law")
        if len(kinds := sorted({law.kind for law in self.laws})) > 1:
            raise ValueError(f"laws are of the kinds {', '.join(kinds)}; allowed: one kind for all nodes")
        first = parts(self.laws[0])
        for i, law in enumerate(self.laws):
            for name in sorted(SHARED):
                if (value := getattr(law, name)) != (whole := getattr(self, name)):
                    raise ValueError(f"laws[{i}].{name} is {value}, the schedule's is {whole}: they must be equal")
            for name, value in parts(law).items():
                if name not in first or value.shape != first[name].shape:
                    needed = first[name].shape if name in first else "not there"
                    raise ValueError(f"laws[{i}].{name} is {value.shape}, in laws[0] it is {needed}: must be equal")
            if missing := sorted(first.keys() - parts(law).keys()):
                raise ValueError(f"laws[{i}] has no {missing[0]}, which laws[0] has")
        return self


def wrong_speeds(speeds_m_per_s: list[float]) -> str:
    """What is wrong with the nodes of a schedule; empty: nothing."""
    rising = all(low < high for low, high in pairwise(speeds_m_per_s))
    if len(speeds_m_per_s) >= 2 and rising and all(isfinite(v) and v >= 0.0 for v in speeds_m_per_s):
        return ""
    return f"speed_m_per_s is {speeds_m_per_s}; allowed: 2 or more speeds from 0 up, strictly ascending, finite"


def law_at(config: ScheduledConfig, speed_m_per_s: float) -> LinearConfig:
    """The law for a speed of the unwinder: between two nodes every number of theirs goes linearly."""
    speeds = config.speed_m_per_s
    above = int(np.searchsorted(speeds, speed_m_per_s))
    if above == 0:
        return config.laws[0]
    if above == len(speeds):
        return config.laws[-1]
    share = (speed_m_per_s - speeds[above - 1]) / (speeds[above] - speeds[above - 1])
    return config.laws[above] if share == 1.0 else _between(config.laws[above - 1], config.laws[above], share)


def parts(law: LinearConfig) -> dict[str, FloatArray]:
    """Everything of a law that may differ from node to node, by name."""
    return _parts(law, "")


def _parts(model: BaseModel, prefix: str) -> dict[str, FloatArray]:
    found: dict[str, FloatArray] = {}
    for name in type(model).model_fields:
        match getattr(model, name):
            case BaseModel() as inner if name not in SHARED:
                found |= _parts(inner, f"{prefix}{name}.")
            case float() | list() if name not in SHARED:
                found[prefix + name] = np.array(getattr(model, name), dtype=np.float64)
            case _:
                pass
    return found


def _between(low: Any, high: Any, share: float) -> Any:
    """`low` for 0, `high` for 1. Not validated anew: whatever lies between matrices of one shape has it too."""
    match low:
        case BaseModel():
            names = [name for name in type(low).model_fields if name not in SHARED]
            return low.model_copy(
                update={name: _between(getattr(low, name), getattr(high, name), share) for name in names}
            )
        case float() | list():
            return _mixed(low, high, share)
        case _:
            return low


def _mixed(low: Any, high: Any, share: float) -> Any:
    """Of numbers, or of lists of one shape."""
    return ((1.0 - share) * np.array(low) + share * np.array(high)).tolist()
