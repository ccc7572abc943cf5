"""The link of stepped time."""

from collections.abc import Coroutine
from dataclasses import dataclass, field
from math import inf, nan
from typing import Any

import numpy as np
import pytest

from drivers.memory import BoolArray, MemoryLink
from drivers.port import Link
from gateway.core.signals import DriveRequest, DriveState, FloatArray, Inputs, Outputs, Quality
from tests.protocol.driver_support import line

N = 6


@dataclass
class FakePlant:
    """Reads and commands are kept, nothing moves."""

    tension_n: FloatArray = field(default_factory=lambda: np.full(N, 20.0))
    speed_m_per_s: FloatArray = field(default_factory=lambda: np.full(N, 0.1))
    torque_nm: FloatArray = field(default_factory=lambda: np.full(N, 40.0))
    unwind_speed_m_per_s: float = 0.09
    permissive: bool = True
    emergency_stop: bool = False
    running: bool = True
    enabled: BoolArray = field(default_factory=lambda: np.ones(N, dtype=np.bool_))
    local: bool = False
    applied: list[tuple[FloatArray, BoolArray, float, bool, float]] = field(default_factory=list)
    warned: list[tuple[bool, float]] = field(default_factory=list)

    def sample(self, now_s: float) -> "FakePlant":
        return self

    def apply(self, torque_nm: FloatArray, enable: BoolArray, speed: float, run: bool, now_s: float) -> None:
        self.applied.append((torque_nm.copy(), enable, speed, run, now_s))

    def warn(self, on: bool, now_s: float) -> None:
        self.warned.append((on, now_s))


def finish(coroutine: Coroutine[Any, Any, None]) -> None:
    """Drive a coroutine that must not suspend."""
    with pytest.raises(StopIteration):
        coroutine.send(None)


def prepared() -> tuple[FakePlant, MemoryLink]:
    plant = FakePlant()
    link = MemoryLink(line(N), plant)
    finish(link.open())
    finish(link.prepare())
    return plant, link


def test_it_is_a_link() -> None:
    link: Link = MemoryLink(line(N), FakePlant())
    assert link.name == "memory"


def test_a_cycle_without_suspending() -> None:
    plant, link = prepared()
    inputs, outputs = Inputs(N), Outputs(N)
    link.trigger(1.5)
    finish(link.collect(inputs, 1.6))
    assert inputs.tension.good() and inputs.speed.good() and inputs.torque.good() and inputs.unwind_speed.good()
    assert inputs.tension.value[0] == 20.0 and inputs.tension.time_s[0] == 1.5
    assert (inputs.plc.quality, inputs.plc.permissive, inputs.plc.emergency_stop) == (Quality.GOOD, True, False)
    assert set(inputs.drive_state) == {DriveState.ENABLED}
    outputs.torque_nm[:] = 3.0
    outputs.drive_request[:] = [DriveRequest.ENABLE, *DriveRequest]
    outputs.speed_request_m_per_s, outputs.run = 0.1, True
    link.write(outputs)
    [(torque_nm, enable, speed_m_per_s, run, now_s)] = plant.applied
    assert (torque_nm == 3.0).all() and (speed_m_per_s, run, now_s) == (0.1, True, 1.5)
    assert list(enable) == [True, False, False, True, False, False]


def test_a_silent_link_commands_nothing() -> None:
    plant = FakePlant()
    link = MemoryLink(line(N), plant)
    link.trigger(0.0)
    link.write(Outputs(N))
    finish(link.prepare())
    link.silence()
    link.write(Outputs(N))
    assert plant.applied == []


@pytest.mark.parametrize("value", [nan, inf, 100.5, -100.5])
def test_readings_are_checked_as_on_a_wire(value: float) -> None:
    plant, link = prepared()
    inputs = Inputs(N)
    link.trigger(0.0)
    finish(link.collect(inputs, 0.0))
    plant.tension_n = np.array([20.0, value, 20.0, 20.0, 20.0, 20.0])
    plant.speed_m_per_s = np.array([nan, 0.2, 0.2, 0.2, 0.2, 0.2])
    link.trigger(0.01)
    finish(link.collect(inputs, 0.01))
    assert list(inputs.tension.quality) == [0, Quality.BAD, 0, 0, 0, 0] and inputs.tension.value[1] == 20.0
    assert list(inputs.speed.quality) == [Quality.BAD, 0, 0, 0, 0, 0]
    assert list(inputs.speed.value) == [0.1, 0.2, 0.2, 0.2, 0.2, 0.2]


def test_a_span_without_a_load_cell_stays_missing() -> None:
    six = line(N)
    link = MemoryLink(six.model_copy(update={"load_cells": six.load_cells[1:]}), FakePlant())
    inputs = Inputs(N)
    link.trigger(0.0)
    finish(link.collect(inputs, 0.0))
    assert inputs.tension.quality[0] == Quality.MISSING and np.isnan(inputs.tension.value[0])


@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_what_is_not_finite_is_not_commanded(value: float) -> None:
    plant, link = prepared()
    outputs = Outputs(N)
    outputs.torque_nm[2] = value
    link.write(outputs)
    outputs = Outputs(N)
    outputs.speed_request_m_per_s = value
    link.write(outputs)
    assert plant.applied == [] and link.health.malformed == 2
