"""A loop in stepped time on a simulated line that differs from what its line file believes."""

import pytest

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, design_pid, task_of
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.states import Phase
from safety.tensioning import longest_tensioning_s
from sim_plant.plant import Plant, load_plant

S_REAL = "sim_plant/plants/s_real.toml"


def demo_line(spans: int = 6) -> Line:
    """The line of `init`, that starts without a warning: nobody is near."""
    line = load_line(line_template(spans, "line.toml"), "line.toml")
    return line.model_copy(update={"stages": line.stages.model_copy(update={"start_warning_s": 0.0})})


def real_plant(spans: int = 6) -> Plant:
    return load_plant(S_REAL).model_copy(update={"spans": spans})


def stepped(spans: int = 6, law: str = "lqi", seed: int = 1) -> SteppedLoop:
    line = demo_line(spans)
    config = {"lqi": design_lqi, "pid": design_pid}[law](task_of(line))
    return SteppedLoop(line, config, real_plant(spans), seed)


@pytest.fixture
def loop() -> SteppedLoop:
    """Still SILENT."""
    return stepped()


@pytest.fixture
def running(loop: SteppedLoop) -> SteppedLoop:
    """Armed, started, tensioned, at the first recipe's speed."""
    return start(loop)


def start(loop: SteppedLoop) -> SteppedLoop:
    from gateway.core.messages import Start

    loop.step(3)
    assert loop.arm().ok
    assert loop.step_until(Phase.READY, 1.0)
    assert loop.command(Start()).ok
    assert loop.step_until(Phase.RUNNING, longest_tensioning_s(loop.line)), loop.cycle.machine.reason
    loop.step(round(3.0 / loop.line.control.period_s))
    return loop
