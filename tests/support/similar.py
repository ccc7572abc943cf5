"""Lines that differ in nothing but their size: what has a unit is scaled by powers of two, so that no digit changes.

The unit of a key is the end of its name. What has none is a number, or a choice, and stays.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gateway.core.controller_laws import LqiConfig
from gateway.core.line import Line
from gateway.core.line_defaults import derived_defaults
from gateway.core.line_model import LineModel
from gateway.core.recording import Recording
from safety.tensioning import tensioning_speed_m_per_s

#: Exponents of force, length and time, by how a key ends; the longest end counts.
UNITS: dict[str, tuple[float, float, float]] = {
    "_n": (1, 0, 0), "_nm": (1, 1, 0), "_m": (0, 1, 0), "_s": (0, 0, 1),
    "_m_per_s": (0, 1, -1), "_m_per_s2": (0, 1, -2), "_m_per_s1_5": (0, 1, -1.5),
    "_n_per_s": (1, 0, -1), "_nm_per_s": (1, 1, -1), "_per_s": (0, 0, -1),
    "_kg_m2": (1, 1, 2), "_nms_per_rad": (1, 1, 1), "_w": (1, 1, -1), "_j": (1, 1, 0),
    "rmse_per_n": (-1, 0, 0), "robustness_per_n": (-1, 0, 0), "effort_per_n2m2s": (-2, -2, -1),
    "stiffness_per_length": (1, -1, 0), "radius_per_inertia": (-1, 0, -2), "friction_per_inertia": (0, 0, -1),
    "radius2_per_inertia": (-1, 1, -2), "per_speed_n": (1, -1, 1),
}  # fmt: skip
#: Times of people, of the wire's devices and of data, which no line is quicker for.
SLACK_M, BRAKE_TIME_S = 0.1, 4.0
OF_NO_LINE = ("history", "agents", "network", "operator", "buses", "plc")


def _within_what_people_stand(line: Line) -> Line:
    """`line` with a speed of tensioning in its file, little slack and soon braked: people set bounds to them."""
    tensioning = line.stages.tensioning.model_copy(update={"roller_speed_max_m_per_s": tensioning_speed_m_per_s(line)})
    stages = line.stages.model_copy(update={"tensioning": tensioning})
    spans = [span.model_copy(update={"slack_max_m": min(span.slack_max_m, SLACK_M)}) for span in line.spans]
    moves = line.moves.model_copy(update={"brake_time_s": min(line.moves.brake_time_s, BRAKE_TIME_S)})
    return line.model_copy(update={"stages": stages, "spans": spans, "moves": moves})


@dataclass(frozen=True)
class Similar:
    """How much larger a line is than another one. Powers of two."""

    force: float = 1.0
    length: float = 1.0
    time: float = 1.0

    def of(self, key: str) -> float:
        """What a number under this key is multiplied by."""
        ends = [end for end in UNITS if key.endswith(end)]
        if not ends:
            return 1.0
        force, length, time = UNITS[max(ends, key=len)]
        return float(self.force**force * self.length**length * self.time**time)

    def scaled(self, document: Any, key: str = "") -> Any:
        """A document with every number in its unit; lists and `value` under their key's."""
        if isinstance(document, Mapping):
            return {
                name: inner
                if name in OF_NO_LINE
                else self.scaled(inner, key if name in ("value", "low", "high") else name)
                for name, inner in document.items()
            }
        if isinstance(document, list | tuple):
            return [self.scaled(inner, key) for inner in document]
        if isinstance(document, float):
            return document * self.of(key)
        return document

    def line(self, line: Line) -> Line:
        """As its file would be read without what is derived where it is not given: that must follow by itself."""
        document = self.scaled(_within_what_people_stand(line).model_dump(mode="json"))
        for table, derived in derived_defaults(line).items():
            for key in derived:
                document[table].pop(key)
        return Line.model_validate(document)

    def model(self, model: LineModel, recording: Recording) -> LineModel:
        """Of the scaled `recording`."""
        document = self.scaled(model.model_dump(mode="json"))
        document["data"]["digest"] = recording.digest()
        return LineModel.model_validate(document)

    def lqi(self, config: LqiConfig) -> LqiConfig:
        """The same law: Nm/N, Nm/(m/s) and Nm/(N s)."""
        n = len(config.gain_integral)
        columns = np.repeat([self.length, self.force * self.time], n)
        document = self.scaled(config.model_dump(mode="json"))
        document["gain_state"] = (np.array(config.gain_state) * columns).tolist()
        document["gain_integral"] = (np.array(config.gain_integral) * (self.length / self.time)).tolist()
        return LqiConfig.model_validate(document)

    def recording(self, recording: Recording) -> Recording:
        changed = {
            name: getattr(recording, name) * self.of(name)
            for name in (
                "time_s", "tension_n", "tension_setpoint_n", "speed_m_per_s", "torque_nm", "torque_actual_nm",
                "unwind_speed_m_per_s", "period_s",
            )
        }  # fmt: skip
        return replace(recording, **changed)
